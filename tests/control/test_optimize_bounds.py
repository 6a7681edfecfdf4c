"""Box bounds: the Karush-Kuhn-Tucker conditions, with every method."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support.optimize_problems import quadratic

import jaxcontact as jc

METHODS = [jc.SteepestDescent(), jc.LBFGS(), jc.NewtonCG(), jc.Optax(optax.adam(0.05))]
LOWER, UPPER = -2.0, 2.5


@pytest.fixture(scope="module")
def problem():
    return quadratic()


@pytest.mark.parametrize("method", METHODS, ids=lambda method: type(method).__name__)
def test_bounded_minimiser_satisfies_the_kkt_conditions(problem, method):
    objective, start, space, _ = problem
    result = jc.optimize(
        objective, start, method=method, bounds=(LOWER, UPPER), iterations=300, **space
    )
    u = result.control
    # Derivatives of nodal values, independent of any inner product.
    derivative = jax.grad(objective)(u)
    size = float(jnp.max(jnp.abs(jax.grad(objective)(start))))
    # Adam with a constant learning rate only comes near.
    tolerance = (3e-2 if isinstance(method, jc.Optax) else 1e-6) * size
    at_lower, at_upper = u == LOWER, u == UPPER
    assert 0 < int(jnp.sum(at_lower))
    assert 0 < int(jnp.sum(at_upper))
    assert 0 < int(jnp.sum(~at_lower & ~at_upper))
    assert float(jnp.min(u)) >= LOWER
    assert float(jnp.max(u)) <= UPPER
    assert float(jnp.min(jnp.where(at_lower, derivative, 0.0))) > -tolerance
    assert float(jnp.max(jnp.where(at_upper, derivative, 0.0))) < tolerance
    assert float(jnp.max(jnp.abs(jnp.where(at_lower | at_upper, 0.0, derivative)))) < tolerance


@pytest.mark.parametrize("method", METHODS[:3], ids=lambda method: type(method).__name__)
def test_bounded_stationarity_measure_goes_to_zero_where_the_gradient_does_not(problem, method):
    objective, start, space, _ = problem
    result = jc.optimize(
        objective, start, method=method, bounds=(LOWER, UPPER), tolerance=1e-6, **space
    )
    assert result.status is jc.Ending.CONVERGED
    _, gradient = jc.l2_value_and_grad(objective, **space)(result.control)
    assert float(jnp.max(jnp.abs(gradient))) > 0.01


def test_bounds_that_hold_nothing_change_nothing(problem):
    objective, start, space, minimiser = problem
    result = jc.optimize(objective, start, bounds=(-np.inf, np.inf), iterations=60, **space)
    np.testing.assert_allclose(result.control, minimiser, atol=1e-6)


def test_bounds_fix_what_they_pinch(problem):
    objective, start, space, _ = problem
    lower = jnp.full_like(start, -np.inf).at[:3].set(0.2)
    upper = jnp.full_like(start, np.inf).at[:3].set(0.2)
    result = jc.optimize(objective, start, bounds=(lower, upper), iterations=20, **space)
    np.testing.assert_array_equal(result.control[:3], 0.2)
    assert result.value < result.history.value[0]


def test_bounds_that_cross_are_refused(problem):
    objective, start, space, _ = problem
    with pytest.raises(ValueError, match="above their upper bounds"):
        jc.optimize(objective, start, bounds=(1.0, -1.0), **space)
