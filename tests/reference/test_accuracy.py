"""Rates and constants: smooth motions at second order, impacts at the rate of their jumps."""

import functools
import math

import against_getfem
import impact_table
import jax.numpy as jnp
import numpy as np
import pytest
import work_precision
from common import bars

import jaxcontact as jc

SECOND_ORDER = [jc.ContactImplicit(), jc.ContactStabilized(), jc.RedistributedMass()]
STABLE = [*SECOND_ORDER, jc.BackwardEuler()]
name_of = lambda scheme: type(scheme).__name__  # noqa: E731


def vibration(scheme, n, steps):
    """Displacement after 0.9 periods of a free bar in its first mode, and the exact one"""
    x = np.linspace(0.0, 1.0, n + 1)[:, None]
    wall = {"left": jc.HalfSpace(np.array([-10.0]), np.array([1.0]))}
    material = jc.KelvinVoigt(young=1.0, poisson=0.0)
    system = jc.discretize(jc.Scene(jc.meshes.interval(1.0, h=1.0 / n), material, contact=wall))
    dt = 1.8 / steps
    stepper = jc.prepare(system, dt, scheme=scheme)
    mode = jnp.asarray(np.cos(np.pi * x))
    start = mode
    if isinstance(scheme, jc.RedistributedMass):
        # Its contact node has no mass: it must start in balance, as its row demands.
        start = mode.at[0].set(mode[1])
    initial = jc.State(start, 0.5 * np.pi * mode)
    final = jc.simulate(stepper, steps=steps, initial=initial).final.displacement
    exact = mode * (math.cos(1.8 * np.pi) + 0.5 * math.sin(1.8 * np.pi))
    return final, exact


def vibration_error(scheme, n, steps):
    final, exact = vibration(scheme, n, steps)
    return float(jnp.max(jnp.abs(final - exact)))


@pytest.mark.parametrize("scheme", [*SECOND_ORDER, jc.Trapezoidal()], ids=name_of)
def test_scheme_is_of_second_order_in_the_time_step(scheme):
    fine, _ = vibration(scheme, 50, 1600)
    errors = [
        float(jnp.max(jnp.abs(vibration(scheme, 50, steps)[0] - fine))) for steps in (20, 40, 80)
    ]
    orders = -np.diff(np.log2(errors))
    np.testing.assert_allclose(orders, 2.0, atol=0.15)
    assert errors[-1] < 4e-3


def test_backward_euler_is_of_first_order_in_the_time_step():
    errors = [vibration_error(jc.BackwardEuler(), 50, steps) for steps in (200, 400, 800)]
    np.testing.assert_allclose(-np.diff(np.log2(errors)), 1.0, atol=0.15)
    assert 5e-3 < errors[-1] < 5e-2


@pytest.mark.parametrize("scheme", SECOND_ORDER, ids=name_of)
def test_scheme_is_of_second_order_in_the_mesh_size(scheme):
    errors = [vibration_error(scheme, n, 40 * n) for n in (10, 20, 40)]
    np.testing.assert_allclose(-np.diff(np.log2(errors)), 2.0, atol=0.1)
    # Moving the mass of a contact node inside costs a factor of six in the constant.
    assert errors[-1] < (1e-2 if isinstance(scheme, jc.RedistributedMass) else 2e-3)


def shear_mode_error(cells):
    """Error of a free square after a fifth of a period of its Lame mode, dt = h/10

    u = (cos x sin y, -sin x cos y), with x and y in units of length/pi, has neither divergence nor
    traction on the sides, whatever Poisson's ratio.
    """
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1.0 / cells)
    system = jc.discretize(jc.Scene(mesh, jc.KelvinVoigt(young=2.6, poisson=0.3)))
    x, y = np.pi * mesh.points.T
    mode = np.column_stack([np.cos(x) * np.sin(y), -np.sin(x) * np.cos(y)])
    frequency = np.pi * np.sqrt(2.0)  # shear modulus and density are one
    end, steps = 0.2 * 2.0 * np.pi / frequency, 3 * cells
    initial = jc.State(jnp.asarray(mode), jnp.asarray(0.5 * frequency * mode))
    final = jc.simulate(jc.prepare(system, end / steps), steps=steps, initial=initial).final
    phase = frequency * end
    exact = mode * (math.cos(phase) + 0.5 * math.sin(phase))
    return float(np.abs(np.asarray(final.displacement) - exact).max())


@pytest.mark.slow
def test_shear_vibration_in_2d_is_of_second_order_in_mesh_and_step_together():
    # Right triangles of one direction are poor at shear: 1.8 from 12 to 24 cells, rising to 2.
    errors = [shear_mode_error(cells) for cells in (8, 16, 32)]
    np.testing.assert_allclose(-np.diff(np.log2(errors)), 2.0, atol=0.3)
    assert errors[-1] < 0.025


@functools.cache
def table_row(name, courant):
    return impact_table.one_impact(name, 200, courant)


STABLE_ENTRIES = [key for key in impact_table.INDEPENDENT if key[0] != "Trapezoidal"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "courant"), [*STABLE_ENTRIES, ("Trapezoidal", 4.0)])
def test_impact_of_the_free_bar_has_the_figures_of_an_independent_program(name, courant):
    row = table_row(name, courant)
    eu, ef, osc, energy = impact_table.INDEPENDENT[name, courant][200]
    # The figures have two digits; 10 % covers their rounding.
    np.testing.assert_allclose(row["eu"], eu, rtol=0.1)
    np.testing.assert_allclose(row["ef"], ef, rtol=0.1)
    np.testing.assert_allclose(row["osc"], osc, rtol=0.1, atol=5e-4)
    np.testing.assert_allclose(1.0 - row["E_end"], 1.0 - energy, rtol=0.15)
    assert row["ledger"] < 1e-10
    assert row["deviation"] < 0.1


COARSE, FINE = 25, 100


@functools.cache
def mean_errors(problem, scheme, n):
    """Mean over four phases of displacement and force error, and of the energy that is missing"""
    found = bars.run(bars.PROBLEMS[problem](), scheme, n, 1.0, count=4)
    loss = np.abs(1.0 - found.final_energy).mean()
    return found.displacement.mean(), found.force.mean(), loss


@pytest.mark.slow
@pytest.mark.parametrize("problem", bars.PROBLEMS)
@pytest.mark.parametrize("scheme", STABLE, ids=name_of)
def test_scheme_converges_through_an_impact_in_the_mean_over_its_phases(scheme, problem):
    (u1, f1, e1), (u2, f2, e2) = (mean_errors(problem, scheme, n) for n in (COARSE, FINE))
    cells = math.log(FINE / COARSE)
    # The velocity jumps, so that rates are near 0.65 (displacement; 0.4 to 1.2 here),
    # 0.7 (force) and 1 (energy); implicit Euler has 0.5 in all of them.
    first_order = isinstance(scheme, jc.BackwardEuler)
    assert math.log(u1 / u2) / cells > 0.35
    assert u2 < (0.17 if first_order else 0.025)
    if isinstance(scheme, jc.ContactImplicit):
        assert f2 > 0.2  # its force does not converge
    else:
        assert math.log(f1 / f2) / cells > 0.4
        assert f2 < 0.12
    assert e2 < (0.36 if first_order else 0.015)
    assert e2 < 0.6 * e1


def test_contact_implicit_force_does_not_converge_at_fixed_courant_number():
    errors = [mean_errors("P2", jc.ContactImplicit(), n)[1] for n in (COARSE, FINE)]
    np.testing.assert_allclose(errors, 0.29, rtol=0.05)


@pytest.mark.slow
def test_impact_table_quick_mode_writes_rows_for_every_scheme(tmp_path):
    tables = impact_table.main(["--quick", "--out", str(tmp_path)])
    assert {row["scheme"] for row in tables["one_impact"]} == set(impact_table.SCHEMES)
    assert {row["scheme"] for row in tables["ten_impacts"]} == set(impact_table.SCHEMES)
    assert (tmp_path / "impact_table.json").stat().st_size > 0


@pytest.mark.slow
def test_work_precision_quick_mode_measures_and_draws_all_four_errors(tmp_path):
    rows = work_precision.main(["--quick", "--repeats", "2", "--out", str(tmp_path)])
    assert {row["problem"] for row in rows} == {"P2", "half disc"}
    for row in rows:
        assert all(0.0 < row[quantity] < 1.0 for quantity in work_precision.QUANTITIES), row
        assert row["run_s"] > 0.0
        assert row["gradient_s"] > 0.0
    assert (tmp_path / "work_precision.png").stat().st_size > 10_000


def test_work_precision_front_keeps_what_no_other_run_beats():
    runs = [(1.0, 0.5), (2.0, 0.6), (3.0, 0.1), (0.5, 0.9), (3.5, 0.1)]
    assert work_precision.pareto(runs) == [(0.5, 0.9), (1.0, 0.5), (3.0, 0.1)]


@pytest.mark.slow
def test_against_getfem_agrees_or_says_what_to_install(tmp_path, capsys):
    rows = against_getfem.main(["--quick", "--repeats", "2", "--out", str(tmp_path)])
    if rows is None:
        assert "python3-getfem" in capsys.readouterr().out
        return
    for row in rows:
        # Two programs, one scheme, 100 steps: rounding up to the first touch and after it.
        assert row["difference_first_touch"] < 1e-11
        assert row["difference"] < 1e-9 or row["scheme"] == "Trapezoidal"
        assert row["us_per_step"] < row["us_per_step_getfem"]
