import importlib

import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from support.kinked import DT, WALL, Grazing, grazing, minimizer, multipliers

import jaxcontact as jc

#: Rounding of the multipliers and of gradients of size one.
ROUNDING = 1e-10


def test_stationarity_without_weak_contact_is_the_gradient_norm():
    problem = grazing()
    u = 0.5 * minimizer(problem)
    certificate = jc.stationarity(problem.objective, u, **problem.options)
    _, gradient = jc.l2_value_and_grad(problem.objective, problem.stepper.system, DT)(u)
    norm = jc.control_dot(problem.stepper.system, DT, gradient, gradient) ** 0.5
    assert len(certificate.weak_pairs) == 0
    np.testing.assert_allclose(certificate.residual, norm, rtol=ROUNDING)
    np.testing.assert_allclose(certificate.gradient_norm, norm, rtol=ROUNDING)


def test_stationarity_at_the_kinked_minimiser_holds_with_the_multipliers_by_hand():
    problem = grazing()
    certificate = jc.stationarity(problem.objective, minimizer(problem), **problem.options)
    np.testing.assert_array_equal(certificate.weak_pairs, [[1, 0]])
    nu, pi = multipliers(problem)
    np.testing.assert_allclose(certificate.gap_multiplier, [nu], rtol=ROUNDING)
    np.testing.assert_allclose(certificate.impulse_multiplier, [pi], rtol=ROUNDING)
    assert certificate.residual < ROUNDING < 0.05 < certificate.gradient_norm
    assert certificate.is_strong
    assert "0 with a wrong sign" in str(certificate)


def test_stationarity_counts_a_tiny_impulse_as_weak_contact():
    problem = grazing()
    u = 1.00001 * minimizer(problem)
    assert float(problem.simulate(u).contact_impulse[-1, 0]) > 0.0
    certificate = jc.stationarity(problem.objective, u, **problem.options)
    nu, pi = multipliers(problem)
    # The control is off by a relative 1e-5, and so are its multipliers in their common share.
    np.testing.assert_allclose(certificate.gap_multiplier, [nu], rtol=1e-4)
    np.testing.assert_allclose(certificate.impulse_multiplier, [pi], rtol=1e-4)
    assert certificate.residual < 1e-4 * certificate.gradient_norm


def test_stationarity_reports_the_wrong_sign_where_release_is_better():
    # A target before the wall: at grazing it would pay to stay away.
    problem = grazing(target=0.05)
    u = minimizer(problem)
    certificate = jc.stationarity(problem.objective, u, **problem.options)
    assert certificate.wrong_signs == 1
    assert not certificate.is_strong
    # At least the gradient of the open side remains, along which the value falls.
    _, gradient = jc.l2_value_and_grad(problem.objective, problem.stepper.system, DT)(0.999 * u)
    norm = jc.control_dot(problem.stepper.system, DT, gradient, gradient) ** 0.5
    np.testing.assert_array_equal(certificate.gap_multiplier, [0.0])
    assert certificate.residual > 0.99 * norm


def test_stationarity_on_the_kink_away_from_the_minimiser_is_the_tangential_gradient():
    problem = grazing()
    u = minimizer(problem)
    along = jnp.zeros_like(u).at[0, 1, 0].set(u[1, 1, 0]).at[1, 1, 0].set(-u[0, 1, 0])
    certificate = jc.stationarity(problem.objective, u + 0.1 * along, **problem.options)
    system = problem.stepper.system
    size = 0.1 * problem.alpha * jc.control_dot(system, DT, along, along) ** 0.5
    assert len(certificate.weak_pairs) == 1
    np.testing.assert_allclose(certificate.residual, size, rtol=1e-6)


def test_stationarity_with_an_active_bound_ignores_the_gradient_into_the_bound():
    problem = grazing()
    u = 0.5 * minimizer(problem)
    bounds = (-np.inf, u)
    free = jc.stationarity(problem.objective, u, **problem.options)
    held = jc.stationarity(problem.objective, u, bounds=bounds, **problem.options)
    assert free.residual > 0.1
    assert held.residual < ROUNDING


def test_stationarity_takes_the_motion_of_any_objective():
    problem = grazing()

    def objective(stepper, u):
        return Grazing(stepper, problem.target).objective(u)

    partial = Partial(objective, problem.stepper)
    u = minimizer(problem)
    with pytest.raises(ValueError, match="motion="):
        jc.stationarity(partial, u, **problem.options)
    certificate = jc.stationarity(partial, u, motion=problem.simulate, **problem.options)
    assert certificate.residual < ROUNDING


def test_stationarity_counts_impulses_in_the_cost():
    # J = lam = 2 p of the last step, and the multiplier belongs to p.
    problem = grazing()

    def impulse(problem, u):
        return jnp.sum(problem.simulate(u).contact_impulse[-1])

    certificate = jc.stationarity(
        Partial(impulse, problem), minimizer(problem), motion=problem.simulate, **problem.options
    )
    assert certificate.residual < ROUNDING
    np.testing.assert_allclose(certificate.impulse_multiplier, [2.0], rtol=ROUNDING)
    np.testing.assert_allclose(certificate.gap_multiplier, [0.0], atol=ROUNDING)


def touching():
    """A body that rests on the wall without a force."""
    scene = jc.Scene(
        mesh=jc.meshes.interval(1.0, h=1.0),
        material=jc.KelvinVoigt(young=1.0, poisson=0.0, density=1.0),
        clamped=("left",),
        contact={"right": jc.HalfSpace(point=np.array([1.0]), normal=np.array([-1.0]))},
    )
    return Grazing(jc.prepare(jc.discretize(scene), DT), WALL)


def test_stationarity_holds_hundreds_of_weak_pairs():
    # Never pressed and never away: at rest the distance to the target is the best possible one.
    problem = touching()
    rest = jnp.zeros((600, 2, 1))
    certificate = jc.stationarity(problem.objective, rest, **problem.options)
    assert len(certificate.weak_pairs) == certificate.rank == 600
    assert certificate.residual < 1e-12
    assert certificate.is_strong


def test_stationarity_whose_rows_do_not_fit_in_memory_raises(monkeypatch):
    rows = importlib.import_module("jaxcontact.optimize.weak_rows")
    monkeypatch.setattr(rows, "available_memory", lambda: 10**6)
    problem = touching()
    with pytest.raises(ValueError, match=r"600 node-steps .* need 0\.017 GB"):
        jc.stationarity(problem.objective, jnp.zeros((600, 2, 1)), **problem.options)


def test_optimize_reports_stationarity_where_the_objective_tells_its_motion():
    problem = grazing()
    u = minimizer(problem)
    known = jc.optimize(problem.objective, u, iterations=1, **problem.options)
    unknown = jc.optimize(lambda u: jnp.sum(u**2), u, iterations=1, **problem.options)
    assert known.stationarity.residual < ROUNDING
    assert known.uncertified == ""
    assert unknown.stationarity is None
    assert "the objective does not tell its motion; hand over a bound method" in repr(unknown)


def test_optimize_says_that_too_many_weak_pairs_have_no_certificate(monkeypatch):
    rows = importlib.import_module("jaxcontact.optimize.weak_rows")
    monkeypatch.setattr(rows, "available_memory", lambda: 10**6)
    problem = touching()
    result = jc.optimize(problem.objective, jnp.zeros((600, 2, 1)), iterations=0, **problem.options)
    assert result.stationarity is None
    assert "600 node-steps are in weak contact" in result.uncertified


def test_stationarity_of_a_motion_with_a_failed_step_raises():
    problem = grazing()
    with pytest.raises(jc.SolveError, match=r"step 1 of 2 .* ended as non finite"):
        jc.stationarity(problem.objective, jnp.full((2, 2, 1), jnp.inf), **problem.options)
