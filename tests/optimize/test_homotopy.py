import importlib
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from support.kinked import DT, START, WALL, Grazing, grazing, influence, minimizer

import jaxcontact as jc
from jaxcontact.control import problem as evaluation
from jaxcontact.optimize.interior import well_inside

#: The last kappa is 1e-17 of the first one; the error of the control is about its root.
LEVELS = 18
ACCURACY = 1e-8


def error(problem, result):
    best = minimizer(problem)
    return float(jnp.max(jnp.abs(result.control - best)) / jnp.max(jnp.abs(best)))


def run(problem, method, **options):
    return jc.optimize(problem.objective, START, method=method, **problem.options, **options)


def test_homotopy_finds_a_kinked_minimiser_where_steepest_descent_stalls():
    problem = grazing()
    descent = run(problem, jc.SteepestDescent(), iterations=1000)
    homotopy = run(problem, jc.Homotopy(levels=LEVELS, finish=None))
    assert error(problem, descent) > 0.01
    assert error(problem, homotopy) < ACCURACY
    assert homotopy.value < descent.value
    assert homotopy.stationarity.is_strong
    assert homotopy.stationarity.residual < ACCURACY * homotopy.history.gradient_norm[0]


def test_homotopy_value_is_the_exact_objective():
    problem = grazing()
    result = run(problem, jc.Homotopy(), iterations=3)
    assert result.value == float(problem.objective(result.control))


def test_homotopy_solves_every_relaxed_problem_to_its_tolerance():
    problem = grazing()
    for levels in (1, 2, 5):
        result = run(problem, jc.Homotopy(levels=levels, finish=None))
        assert result.state.level == levels
        assert result.status is jc.Ending.RELAXED
        relaxed = jc.with_contact(problem, jc.RelaxedContact(result.state.kappa))
        _, gradient = jc.l2_value_and_grad(
            relaxed.objective, problem.stepper.system, problem.options["dt"]
        )(result.state.point.parameters)
        norm = (
            jc.control_dot(problem.stepper.system, problem.options["dt"], gradient, gradient) ** 0.5
        )
        assert norm < 1e-9 * result.history.gradient_norm[0]


def test_homotopy_compiles_nothing_from_one_kappa_to_the_next():
    problem = grazing()
    run(problem, jc.Homotopy(levels=1))
    before = evaluation._evaluate_compiled._cache_size()
    run(problem, jc.Homotopy(levels=6, first_kappa=1e-3))
    assert evaluation._evaluate_compiled._cache_size() == before


def test_homotopy_continued_from_a_file_equals_an_uninterrupted_run(tmp_path):
    problem = grazing()
    whole = run(problem, jc.Homotopy(levels=6))
    run(problem, jc.Homotopy(levels=6), iterations=2).save(tmp_path / "half.npz")
    half = jc.load_result(tmp_path / "half.npz")
    rest = jc.optimize(problem.objective, half, method=jc.Homotopy(levels=6), **problem.options)
    np.testing.assert_array_equal(rest.control, whole.control)
    np.testing.assert_array_equal(rest.history.value, whole.history.value)


def test_homotopy_within_bounds_ends_at_the_bounded_minimiser():
    # The first load may not exceed half of what is best: the second one does the rest.
    problem = grazing()
    best = minimizer(problem)
    upper = jnp.full_like(best, jnp.inf).at[0].set(0.5 * best[0, 1, 0])
    result = run(problem, jc.Homotopy(), bounds=(-jnp.inf, upper))
    assert bool(jnp.all(result.control <= upper))
    final = problem.simulate(result.control)
    np.testing.assert_allclose(final.gap[-1], 0.0, atol=1e-12)
    assert result.control[0, 1, 0] == upper[0, 1, 0]
    assert result.status is jc.Ending.CERTIFIED
    assert result.stationarity.residual < 1e-11 * result.history.gradient_norm[0]


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_first_iterate_within_bounds_is_of_the_size_of_the_problem(size):
    low, high = size * jnp.array([0.0, -jnp.inf, 1.0]), size * jnp.array([jnp.inf, 1.0, 1.0])
    inside = well_inside((low, high), size * jnp.array([0.0, 2.0, 5.0]))
    np.testing.assert_allclose(inside, size * jnp.array([0.05, 0.95, 1.0]), rtol=1e-12)


def test_homotopy_within_bounds_continues_from_a_file(tmp_path):
    problem = grazing()
    bounds = (-jnp.inf, 0.5 * minimizer(problem)[0, 1, 0])
    whole = run(problem, jc.Homotopy(levels=4), bounds=bounds)
    run(problem, jc.Homotopy(levels=4), bounds=bounds, iterations=2).save(tmp_path / "half.npz")
    half = jc.load_result(tmp_path / "half.npz")
    rest = jc.optimize(
        problem.objective, half, method=jc.Homotopy(levels=4), bounds=bounds, **problem.options
    )
    np.testing.assert_array_equal(rest.control, whole.control)


def test_homotopy_over_an_actuator_finds_the_best_admissible_push():
    # One constant push for both steps: it grazes the wall with u = psi / (L_11 (c_1 + c_2)).
    problem = grazing()
    system = problem.stepper.system
    push = jc.actuator(system, 2, nodes=[1], direction=[1.0], intervals=1)
    result = jc.optimize(
        problem.objective,
        push.zeros(),
        method=jc.Homotopy(levels=LEVELS),
        controls=push,
        system=system,
        dt=DT,
    )
    expected = 3.0 * WALL / np.sum(influence(problem))
    np.testing.assert_allclose(result.parameters, [[expected]], rtol=ACCURACY)
    assert result.stationarity.is_strong


def test_homotopy_needs_an_objective_that_holds_the_stepper():
    problem = grazing()
    with pytest.raises(ValueError, match="Partial"):
        jc.optimize(lambda u: problem.objective(u), START, method=jc.Homotopy(), **problem.options)


def test_homotopy_without_contact_asks_for_kappa():
    scene = jc.Scene(
        mesh=jc.meshes.interval(1.0, h=1.0),
        material=jc.KelvinVoigt(young=1.0, poisson=0.0, density=1.0),
        clamped=("left",),
    )
    problem = Grazing(jc.prepare(jc.discretize(scene), 0.1), 1.0)
    with pytest.raises(ValueError, match="first_kappa"):
        run(problem, jc.Homotopy())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rings", "gradients", "products"), [(6, 60, 500), (12, 80, 700), (16, 80, 700)]
)
def test_homotopy_is_certified_on_every_mesh(rings, gradients, products):
    problem = jc.scenes.half_disc_control(h=jc.scenes.RADIUS / rings)
    result = jc.optimize(
        problem.objective,
        jnp.zeros_like(problem.reference),
        method=jc.Homotopy(),
        system=problem.system,
        dt=problem.dt,
    )
    history, certificate = result.history, result.stationarity
    assert result.status is jc.Ending.CERTIFIED
    assert certificate.residual <= 1e-10 * history.gradient_norm[0]
    assert certificate.is_strong
    assert history.evaluations[-1] <= gradients
    assert history.hessian_products[-1] <= products


@pytest.mark.slow
def test_homotopy_within_bounds_is_certified_for_the_papers_problem():
    problem = jc.scenes.half_disc_control()
    result = jc.optimize(
        problem.objective,
        jnp.zeros_like(problem.reference),
        method=jc.Homotopy(),
        bounds=(-0.5, 0.5),
        system=problem.system,
        dt=problem.dt,
    )
    history, certificate = result.history, result.stationarity
    assert result.status is jc.Ending.CERTIFIED
    assert certificate.residual <= 1e-10 * history.gradient_norm[0]
    assert certificate.is_strong
    # Most of the control is at a bound.
    assert np.mean(np.abs(np.asarray(result.control)) == 0.5) > 0.6
    assert history.evaluations[-1] <= 60
    assert history.hessian_products[-1] <= 500


@pytest.mark.slow
def test_homotopy_reaches_strong_stationarity_of_the_papers_problem():
    problem = jc.scenes.half_disc_control()
    result = jc.optimize(
        problem.objective,
        jnp.zeros_like(problem.reference),
        method=jc.Homotopy(),
        system=problem.system,
        dt=problem.dt,
    )
    history, certificate = result.history, result.stationarity
    # Steepest descent stalls at 0.0099208 on this triangulation.
    below = int(np.argmax(history.value < 0.0099208))
    assert history.evaluations[below] <= 25
    assert history.hessian_products[below] <= 500
    assert certificate.residual <= 1e-10 * history.gradient_norm[0]
    assert history.evaluations[-1] <= 60
    assert history.hessian_products[-1] <= 500
    assert len(certificate.weak_pairs) == 8
    assert certificate.is_strong
    assert result.status is jc.Ending.CERTIFIED


@pytest.mark.slow
@pytest.mark.parametrize("name", ["optimizers", "mesh_independence"])
def test_optimisation_benchmark_runs_and_writes_its_result(name, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    rows = importlib.import_module(name).main(["--quick", "--out", str(tmp_path)])
    record = json.loads((tmp_path / f"{name}.json").read_text())
    assert len(record["rows"]) == len(rows)
    assert "jax" in record["machine"]
    assert (tmp_path / f"{name}.png").stat().st_size > 1000
    homotopy = [row for row in rows if "homotopy" in row.values()]
    assert homotopy
    assert all(row["value"] < 1.0 for row in homotopy)
