import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import BLOCK, DT, block, random_control
from independent import assemble, tracking_cost

import jaxcontact as jc

STEPS = 5
ALPHA, GAMMA = 0.3, 0.7
# Sums of a few thousand products.
ROUNDING = 1e-12


@pytest.fixture(scope="module")
def stepper():
    return block(gap=100.0)


@pytest.fixture(scope="module")
def motion(stepper):
    return jc.simulate(stepper, random_control(STEPS))


def make_cost(stepper, target, **weights):
    return jc.TrackingCost(stepper.system, dt=DT, target=target, **weights)


def test_tracking_cost_equals_the_formula_of_the_paper(stepper, motion):
    control = random_control(STEPS, 1)
    target = 0.1 * random_control(STEPS + 1, 2)
    cost = make_cost(stepper, target, control_weight=ALPHA, final_weight=GAMMA)
    body = assemble(BLOCK.points, BLOCK.cells, [], [], young=1.0, poisson=0.0)
    expected = tracking_cost(
        body, DT, *(np.asarray(x) for x in (motion.displacement, target, control)), ALPHA, GAMMA
    )
    np.testing.assert_allclose(cost(motion, control), expected, rtol=ROUNDING)


def test_tracking_cost_of_the_target_without_control_is_zero(stepper, motion):
    cost = make_cost(stepper, motion.displacement, control_weight=ALPHA, final_weight=GAMMA)
    assert cost(motion, 0.0 * random_control(STEPS)) == 0.0


def test_tracking_cost_of_a_constant_error_is_trapezoid_plus_final_term(stepper, motion):
    # An error of one everywhere has the square L2 norm 2 (the area), 4 with two components.
    cost = make_cost(stepper, motion.displacement + 1.0, final_weight=GAMMA)
    np.testing.assert_allclose(cost(motion), 0.5 * STEPS * DT * 4.0 + GAMMA * 4.0, rtol=ROUNDING)


def test_tracking_cost_penalises_the_control_with_one_half(stepper, motion):
    cost = make_cost(stepper, motion.displacement, control_weight=ALPHA)
    ones = jnp.ones((STEPS, BLOCK.n_nodes, 2))
    np.testing.assert_allclose(cost(motion, ones), 0.5 * ALPHA * STEPS * DT * 4.0, rtol=ROUNDING)
    assert cost(motion) == 0.0


def test_tracking_cost_weighs_the_first_and_last_level_by_one_half(stepper, motion):
    for level, weight in ((0, 0.5), (2, 1.0), (STEPS, 0.5)):
        cost = make_cost(stepper, motion.displacement.at[level].add(1.0))
        np.testing.assert_allclose(cost(motion), weight * 0.5 * DT * 4.0, rtol=ROUNDING)


def test_tracking_cost_does_not_depend_on_the_density():
    heavy = block(jc.KelvinVoigt(young=1.0, poisson=0.0, density=7.0), gap=100.0)
    motion = jc.simulate(heavy, steps=STEPS)
    cost = make_cost(heavy, motion.displacement + 1.0)
    np.testing.assert_allclose(cost(motion), 0.5 * STEPS * DT * 4.0, rtol=ROUNDING)


def test_tracking_cost_is_differentiable_by_its_weights(stepper, motion):
    control = random_control(STEPS, 1)

    def value(weights):
        cost = make_cost(
            stepper, 0.0 * motion.displacement, control_weight=weights[0], final_weight=weights[1]
        )
        return cost(motion, control)

    base = value(jnp.zeros(2))
    by_alpha, by_gamma = jax.grad(value)(jnp.ones(2))
    # The value is linear in both.
    np.testing.assert_allclose(value(jnp.array([1.0, 0.0])) - base, by_alpha, rtol=1e-10)
    np.testing.assert_allclose(value(jnp.array([0.0, 1.0])) - base, by_gamma, rtol=1e-10)


def test_tracking_cost_rejects_a_target_of_the_wrong_shape(stepper):
    with pytest.raises(ValueError, match=r"target must have shape \(T\+1, N, d\).*15, 2"):
        make_cost(stepper, jnp.zeros((STEPS + 1, 14, 2)))


def test_tracking_cost_rejects_a_target_with_another_number_of_steps(stepper, motion):
    cost = make_cost(stepper, jnp.zeros((STEPS, 15, 2)))
    with pytest.raises(ValueError, match="the same T\\+1 time levels"):
        cost(motion)


def test_tracking_cost_rejects_a_control_of_the_wrong_shape(stepper, motion):
    cost = make_cost(stepper, motion.displacement)
    with pytest.raises(ValueError, match="control must have shape"):
        cost(motion, random_control(STEPS + 1))
