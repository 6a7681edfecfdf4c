import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, DT, block, random_control
from support.independent import assemble, tracking_cost

import jaxcontact as jc

#: What is said of a force that chatters is in `test_chatter.py`.
pytestmark = pytest.mark.filterwarnings("ignore::jaxcontact.ChatterWarning")

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


def test_tracking_cost_of_some_of_the_states_is_refused(stepper):
    # It would take the time between two records for a step.
    motion = jc.simulate(stepper, random_control(4), save_every=2)
    with pytest.raises(ValueError, match=r"3 states of 4 steps.*simulate it with save_every=1"):
        make_cost(stepper, 0.0 * motion.displacement)(motion)


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


def test_trace_cost_of_a_constant_error_is_the_length_of_the_boundary(stepper, motion):
    # The top is 2 long: 4 for two components; errors elsewhere must not count.
    top = BLOCK.facets["top"]
    is_elsewhere = jnp.ones(BLOCK.n_nodes).at[np.unique(top)].set(0.0)
    target = motion.displacement + 1.0 + 5.0 * is_elsewhere[None, :, None]
    cost = make_cost(stepper, target, final_weight=GAMMA, facets=top)
    np.testing.assert_allclose(cost(motion), (0.5 * STEPS * DT + GAMMA) * 4.0, rtol=ROUNDING)


def test_node_cost_is_the_square_distance_of_the_nodes(stepper, motion):
    target = motion.displacement.at[-1, 3].add(jnp.array([3.0, 4.0])).at[:, 5].add(1.0)
    cost = make_cost(stepper, target, final_weight=GAMMA, nodes=[3, 7])
    np.testing.assert_allclose(cost(motion), (0.25 * DT + GAMMA) * 25.0, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"nodes": [15]}, "numbers from 0 to 14"),
        ({"nodes": []}, "numbers from 0 to 14"),
        ({"nodes": [1], "facets": [[0, 1]]}, "either facets or nodes"),
    ],
)
def test_tracking_cost_rejects_what_it_cannot_track(stepper, motion, options, message):
    with pytest.raises(ValueError, match=message):
        make_cost(stepper, motion.displacement, **options)


#: Long enough for contact, see `bodies.DT`.
FALL = 14


@pytest.fixture(scope="module")
def falling():
    return block()


@pytest.fixture(scope="module")
def bounce(falling):
    return jc.simulate(falling, random_control(FALL))


def test_contact_force_error_of_the_force_itself_is_zero(bounce):
    force = np.asarray(bounce.contact_impulse).sum(axis=1) / DT
    assert force.max() > 1.0
    rounding = (ROUNDING * force.max()) ** 2
    assert jc.contact_force_error(bounce, force, dt=DT) < 0.5 * FALL * DT * rounding
    off = jc.contact_force_error(bounce, force + 2.0, dt=DT)
    np.testing.assert_allclose(off, 0.5 * FALL * DT * 4.0, rtol=ROUNDING)


def test_contact_force_error_rejects_a_target_of_the_wrong_shape(bounce):
    with pytest.raises(ValueError, match=r"a number or have shape \(14,\)"):
        jc.contact_force_error(bounce, np.zeros(FALL + 1), dt=DT)


def test_contact_time_tends_to_the_time_under_force(bounce):
    n_steps = int(np.sum(np.any(np.asarray(bounce.contact_impulse) > 0.0, axis=1)))
    assert 0 < n_steps < FALL
    duration = jc.contact_time(bounce, dt=DT, force_scale=1e-9)
    np.testing.assert_allclose(duration, n_steps * DT, rtol=1e-6)


def objectives(stepper, target, u):
    """Every kind of objective, of one motion with contact"""
    motion = jc.simulate(stepper, u)

    def tracking(**options):
        return make_cost(stepper, target, **options)(motion, u)

    ledger = jc.energy(stepper, motion, u)
    return {
        "distributed": tracking(control_weight=ALPHA),
        "final": tracking(final_weight=GAMMA) - tracking(),
        "boundary trace": tracking(facets=BLOCK.facets["bottom"]),
        "chosen nodes": tracking(nodes=np.array([3, 7])),
        "contact force": jc.contact_force_error(motion, jnp.linspace(0.0, 5.0, FALL), dt=DT),
        "contact time": jc.contact_time(motion, dt=DT, force_scale=3.0),
        "energy": ledger.total[-1],
        "impact loss": jnp.sum(ledger.impact_loss),
        "any function": jnp.sum(motion.velocity[-1] ** 4),
    }


KINDS = ["distributed", "final", "boundary trace", "chosen nodes", "contact force"]
KINDS += ["contact time", "energy", "impact loss", "any function"]


@pytest.fixture(scope="module")
def slopes(falling, bounce):
    """Derivatives along a random direction: by the adjoint, and by central differences"""
    u, direction = random_control(FALL), random_control(FALL, 1)
    target = bounce.displacement + 0.05 * random_control(FALL + 1, 2, size=1.0)
    gradients = jax.jit(jax.jacrev(objectives, argnums=2))(falling, target, u)
    step = 1e-5
    ahead, behind = (jax.jit(objectives)(falling, target, u + s * direction) for s in (step, -step))
    return {
        kind: (jnp.vdot(gradients[kind], direction), (ahead[kind] - behind[kind]) / (2.0 * step))
        for kind in gradients
    }


@pytest.mark.parametrize("kind", KINDS)
def test_objective_has_the_gradient_of_its_differences(slopes, kind):
    exact, difference = slopes[kind]
    assert abs(exact) > 1e-6
    # The error of the force is 140 and its slope 0.05: 2e-16 of it is 6e-8 of the difference.
    np.testing.assert_allclose(exact, difference, rtol=1e-6)
