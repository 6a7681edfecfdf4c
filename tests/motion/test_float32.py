"""Claims about float32: in increment form the scheme keeps its digits, end to end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

N_CELLS = 400
BAR = jc.reference.ClampedBar(amplitude=0.1)


def run_bar(dtype):
    """One period of the prestrained bar (release, contact, flight) at Courant number one"""
    mesh = jc.meshes.interval(1.0, h=(1.0 + 1e-9) / N_CELLS)
    wall = jc.HalfSpace(np.array([0.0]), np.array([1.0]))
    material = jc.KelvinVoigt(young=1.0, poisson=0.0)
    scene = jc.Scene(mesh, material, clamped=("right",), contact={"left": wall})
    stepper = jc.prepare(jc.discretize(scene, dtype=dtype), 1.0 / N_CELLS, linear_solver=jc.Dense())
    x = jnp.asarray(mesh.points, dtype)
    start = jnp.asarray(BAR.displacement(x, 0.0), dtype).at[-1].set(0.0)
    initial = jc.State(start, jnp.zeros_like(start))
    trajectory = jc.simulate(stepper, steps=3 * N_CELLS, initial=initial)
    return stepper, trajectory


@pytest.fixture(scope="module")
def bars():
    return {dtype: run_bar(dtype) for dtype in (jnp.float32, jnp.float64)}


def relative_error(actual, expected):
    actual, expected = np.asarray(actual, float), np.asarray(expected, float)
    return np.linalg.norm(actual - expected) / np.linalg.norm(expected)


def test_float32_bar_solves_every_step(bars):
    _, trajectory = bars[jnp.float32]
    assert trajectory.displacement.dtype == jnp.float32
    np.testing.assert_array_equal(trajectory.status, jc.Status.CONVERGED)
    assert np.mean(trajectory.iterations) < 1.2
    assert 0.2 < np.mean(trajectory.active) < 0.5  # a third of a period


def test_float32_bar_moves_as_in_float64(bars):
    single, double = (bars[dtype][1].displacement for dtype in (jnp.float32, jnp.float64))
    # Measured 2.6e-4 (7e-4 at n = 6400), far below the error of the mesh. The total form, which
    # loses eps |y| / tau in every step, has an error of one at n = 6400.
    assert relative_error(single, double) < 5e-4


def test_float32_bar_is_as_close_to_the_solution_as_float64(bars):
    x = np.linspace(0.0, 1.0, N_CELLS + 1)[None, :]
    errors = {}
    for dtype, (_, trajectory) in bars.items():
        t = np.arange(3 * N_CELLS + 1)[:, None] / N_CELLS
        with jax.numpy_rank_promotion("allow"):
            exact = BAR.displacement(x, t)
        errors[dtype] = relative_error(trajectory.displacement[..., 0], exact)
    assert errors[jnp.float64] < 7e-3
    assert errors[jnp.float32] < 1.05 * errors[jnp.float64]


def test_float32_bar_keeps_the_energy(bars):
    stepper, trajectory = bars[jnp.float32]
    ledger = jc.energy(stepper, trajectory)
    total = np.asarray(ledger.total, float)
    drift = total - total[0] + np.cumsum([0.0, *np.asarray(ledger.impact_loss, float)])
    assert np.max(np.abs(drift)) < 1e-3 * total[0]


@pytest.fixture(scope="module")
def half_discs():
    return {
        dtype: jc.scenes.half_disc_control(h=15 / 6, gap=0.1, steps=80, dtype=dtype)
        for dtype in (jnp.float32, jnp.float64)
    }


def test_float32_half_disc_moves_as_in_float64(half_discs):
    single, double = (p.simulate(p.reference) for p in half_discs.values())
    np.testing.assert_array_equal(single.status, jc.Status.CONVERGED)
    assert np.mean(single.iterations) < 1.5
    assert np.any(single.contact_impulse > 0.0)
    assert relative_error(single.displacement, double.displacement) < 1e-4
    assert relative_error(single.contact_impulse, double.contact_impulse) < 1e-2


def test_float32_half_disc_gradient_is_that_of_float64(half_discs):
    gradients = []
    for problem in half_discs.values():
        u = 0.9 * problem.reference
        assert np.any(problem.simulate(u).active)
        gradient = jax.grad(problem.objective)(u)
        assert gradient.dtype == u.dtype
        assert np.all(np.isfinite(gradient))
        gradients.append(gradient)
    assert relative_error(*gradients) < 1e-3
