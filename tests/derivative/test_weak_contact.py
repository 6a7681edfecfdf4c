"""Weak contact: one-sided derivatives, and the linear branches between them."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import SCHEMES
from support.thrown_bodies import (
    STEPS,
    cost,
    grazing,
    initial_of,
    parameters,
    stepper_of,
    thrown,
    unloaded,
    value_and_gradient,
)

import jaxcontact as jc

#: One-sided difference quotients of a piecewise smooth motion, error per length of the step.
FIRST_ORDER = 1.0
#: Two ways to add the same numbers.
ROUNDING = 1e-10
FIELDS = ("displacement", "velocity", "gap", "contact_impulse")
SLOW = pytest.mark.slow

#: A body that grazes: every scheme in the plane, the default one also in 1D, the rest is slow.
GRAZING = [
    (1, SCHEMES[0]),
    *((2, scheme) for scheme in SCHEMES),
    *(pytest.param(1, scheme, marks=SLOW) for scheme in SCHEMES[1:]),
    *(pytest.param(3, scheme, marks=SLOW) for scheme in SCHEMES),
]
each_grazing_body = pytest.mark.parametrize(("dimension", "scheme"), GRAZING, ids=str)


def direction_of(control, seed=5):
    return jnp.asarray(np.random.default_rng(seed).normal(size=control.shape))


def largest_error(first, second):
    """Largest difference of the fields of two trajectories relative to the largest value"""
    errors = []
    for name in FIELDS:
        a, b = np.asarray(getattr(first, name)), np.asarray(getattr(second, name))
        errors.append(np.max(np.abs(a - b)) / max(np.max(np.abs(b)), 1e-300))
    return max(errors)


def quotient(there, here, length):
    """The difference quotient of two trajectories, a trajectory"""
    return jax.tree.map(
        lambda a, b: (np.asarray(a, float) - np.asarray(b, float)) / length, there, here
    )


@jax.jit
def derivative_of_cost(trajectory, tangent):
    """The derivative of `cost` along the tangent of a trajectory"""
    names = [name for name in (*FIELDS, "nodal") if name not in ("displacement", "velocity")]
    fields, tangents = ({name: getattr(x, name) for name in names} for x in (trajectory, tangent))
    return jax.jvp(lambda fields: cost(replace(trajectory, **fields)), (fields,), (tangents,))[1]


@each_grazing_body
def test_trajectory_shows_the_weak_contact(dimension, scheme):
    stepper, control, initial, place = grazing(dimension, scheme)
    trajectory = jc.simulate(stepper, control, initial=initial)
    np.testing.assert_array_equal(np.argwhere(trajectory.weak), [place])
    assert not np.any(trajectory.strong)
    # With ContactStabilized it is the predictor that touches.
    assert np.any(trajectory.active) == (not isinstance(scheme, jc.ContactStabilized))
    assert np.all(np.asarray(trajectory.contact_impulse) == 0.0)


@each_grazing_body
def test_directional_derivative_is_the_one_sided_quotient_at_weak_contact(dimension, scheme):
    stepper, control, initial, _ = grazing(dimension, scheme)
    here = jc.simulate(stepper, control, initial=initial)
    velocities = []
    for sign in (1.0, -1.0):
        direction = sign * direction_of(control)
        derivative = jc.directional_derivative(stepper, control, direction, initial=initial)
        t = 1e-6
        there = jc.simulate(stepper, control + t * direction, initial=initial)
        rounding = 1e-12 if scheme == SCHEMES[0] else 1e-11
        error = largest_error(quotient(there, here, t), derivative)
        assert error <= rounding / t + FIRST_ORDER * t, sign
        velocities.append(derivative.velocity)
    # Positively homogeneous, but not linear.
    assert np.max(np.abs(sum(velocities))) > 1e-3 * np.max(np.abs(velocities[0])), "no kink"


@jax.jit
def gradient_along(stepper, control, initial, direction):
    """The gradient of the cost by the control on the side of a direction (control, initial)"""

    def value(control):
        side = jc.AlongDirection(*direction)
        return cost(jc.simulate(stepper, control, initial=initial, weak_contact=side))

    return jax.grad(value)(control)


@pytest.mark.parametrize("scheme", SCHEMES, ids=str)
def test_gradient_along_a_direction_is_the_one_sided_derivative_for_every_scheme(scheme):
    stepper, control, initial, _ = grazing(2, scheme)
    trajectory = jc.simulate(stepper, control, initial=initial)
    for sign in (1.0, -1.0):
        direction = sign * direction_of(control)
        along = gradient_along(stepper, control, initial, (direction, None))
        tangent = jc.directional_derivative(stepper, control, direction, initial=initial)
        exact = derivative_of_cost(trajectory, tangent)
        scale = float(jnp.linalg.norm(along) * jnp.linalg.norm(direction))
        assert abs(float(jnp.vdot(along, direction)) - float(exact)) <= ROUNDING * scale


def branches(stepper, control, initial):
    """Gradients by the control of the closed and of the open branch"""
    return (
        value_and_gradient(stepper, control, initial, choice)[1][0]
        for choice in (jc.ClosedBranch(), jc.OpenBranch())
    )


@pytest.mark.parametrize("seed", [5, 6])
@pytest.mark.parametrize("dimension", [2, pytest.param(1, marks=SLOW), pytest.param(3, marks=SLOW)])
def test_gradients_of_the_branches_are_the_one_sided_derivatives(dimension, seed):
    stepper, control, initial, place = grazing(dimension)
    direction = direction_of(control, seed)
    closed, opened = branches(stepper, control, initial)
    trajectory = jc.simulate(stepper, control, initial=initial)
    for sign in (1.0, -1.0):
        towards = sign * direction
        tangent = jc.directional_derivative(stepper, control, towards, initial=initial)
        exact = float(derivative_of_cost(trajectory, tangent))
        is_pressed = float(tangent.contact_impulse[place]) > 0.0
        branch, other = (closed, opened) if is_pressed else (opened, closed)
        scale = float(jnp.linalg.norm(branch) * jnp.linalg.norm(towards))
        assert abs(float(jnp.vdot(branch, towards)) - exact) <= ROUNDING * scale
        assert abs(float(jnp.vdot(other, towards)) - exact) > 1e-5 * scale
        along = gradient_along(stepper, control, initial, (towards, None))
        np.testing.assert_allclose(along, branch, atol=ROUNDING * float(jnp.max(jnp.abs(branch))))
        t = 1e-6
        there = jc.simulate(stepper, control + t * towards, initial=initial)
        one_sided = float(cost(there) - cost(trajectory)) / t
        assert abs(one_sided - exact) <= 1e-5 * scale


def test_gradient_without_a_named_treatment_is_that_of_the_closed_branch():
    stepper, control, initial, _ = grazing(2)
    closed, opened = branches(stepper, control, initial)
    gradient = value_and_gradient(stepper, control, initial)[1][0]
    scale = float(jnp.max(jnp.abs(gradient)))
    np.testing.assert_allclose(gradient, closed, atol=ROUNDING * scale)
    assert np.max(np.abs(gradient - opened)) > 1e-3 * scale


def test_gradient_along_a_direction_of_the_initial_state_chooses_the_branch():
    stepper, control, initial, _ = grazing(2)
    towards = jc.State(jnp.zeros_like(initial.displacement), initial.velocity)
    along = gradient_along(stepper, control, initial, (None, towards))
    # A faster fall presses the pair.
    closed, _ = branches(stepper, control, initial)
    np.testing.assert_allclose(along, closed, rtol=ROUNDING)


def test_directional_derivative_is_positively_homogeneous():
    stepper, control, initial, _ = grazing(2)
    direction = direction_of(control)
    for sign in (1.0, -1.0):
        once, thrice = (
            jc.directional_derivative(stepper, control, s * sign * direction, initial=initial)
            for s in (1.0, 3.0)
        )
        tripled = jax.tree.map(lambda x: 3.0 * x, once)
        assert largest_error(thrice, tripled) <= ROUNDING


def test_directional_derivative_is_linear_without_weak_contact():
    stepper, control, initial = thrown()
    first, second = direction_of(control, 1), direction_of(control, 2)
    derivative = partial(jc.directional_derivative, stepper, control, initial=initial)
    trajectory = jc.simulate(stepper, control, initial=initial)
    assert np.any(trajectory.strong)
    assert not np.any(trajectory.weak)
    total = jax.tree.map(lambda a, b: a - 2.0 * b, derivative(first), derivative(second))
    assert largest_error(derivative(first - 2.0 * second), total) <= ROUNDING


def test_directional_derivative_by_initial_state_and_stepper_is_the_quotient():
    values = parameters(2)
    start = initial_of(values)
    towards = jc.State(0.1 * values["velocity"], -0.3 * values["velocity"])

    def prepared(young):
        return stepper_of(2, values | {"material": values["material"] | {"young": young}})

    stepper, stepper_direction = jax.jvp(prepared, (jnp.array(100.0),), (jnp.array(10.0),))
    derivative = jc.directional_derivative(
        stepper,
        values["control"],
        initial=start,
        initial_direction=towards,
        stepper_direction=stepper_direction,
    )
    t = 1e-5

    def moved(t):
        state = jax.tree.map(lambda a, b: a + t * b, start, towards)
        return jc.simulate(prepared(jnp.array(100.0 + 10.0 * t)), values["control"], initial=state)

    assert largest_error(quotient(moved(t), moved(-t), 2 * t), derivative) <= 1e-6


def test_directional_derivative_of_many_weak_pairs_solves_the_complementarity_problem():
    # A flat bottom that grazes with every node: the sign of each pair is found.
    stepper, control = stepper_of(2, unloaded(2, gap=0.0)), jnp.zeros_like(thrown()[1])
    rest = jc.State(*jnp.zeros((2, *control.shape[1:])))
    trajectory = jc.simulate(stepper, control, initial=rest)
    assert np.all(trajectory.weak)
    for seed in range(5):
        direction = direction_of(control, seed)
        derivative = jc.directional_derivative(stepper, control, direction, initial=rest)
        gap, impulse = np.asarray(derivative.gap[1]), np.asarray(derivative.contact_impulse[0])
        assert 0 < np.count_nonzero(impulse) < impulse.size
        assert np.all(impulse >= -ROUNDING * impulse.max())
        assert np.all(gap >= -ROUNDING * np.abs(gap).max())
        assert np.all(gap * impulse <= ROUNDING * gap.max() * impulse.max())


def test_trajectory_shows_weak_contact_after_strong_contact_with_averaged_forces():
    # A mass at rest at a wall: under a constant load of excess f the forces are 2 f, 0, 2 f, 0, ...
    scene = jc.Scene(
        jc.meshes.interval(1.0, h=1.0),
        jc.KelvinVoigt(young=4.0, poisson=0.0, density=3.0),
        clamped=("right",),
        contact={"left": jc.HalfSpace(np.array([-0.1]), np.ones(1))},
    )
    stepper = jax.jit(lambda: jc.prepare(jc.discretize(scene), 0.2, scheme=jc.Trapezoidal()))()
    control = jnp.zeros((2, 2, 1)).at[:, 0, 0].set(-3.0)
    rest = jnp.zeros((2, 1))
    initial = jc.State(rest.at[0].set(-0.1), rest)
    trajectory = jc.simulate(stepper, control, initial=initial)
    assert np.all(trajectory.contact_impulse > 0.0)
    assert np.all(trajectory.active)
    np.testing.assert_array_equal(trajectory.weak, [[False], [True]])
    np.testing.assert_array_equal(trajectory.strong, [[True], [False]])
    pull = jnp.zeros_like(control).at[1, 0, 0].set(1.0)
    away, press = (
        jc.directional_derivative(stepper, control, s * pull, initial=initial).velocity[-1, 0, 0]
        for s in (1.0, -1.0)
    )
    assert float(away) > 0.0
    assert abs(float(press)) <= ROUNDING * float(away)


def test_critical_cone_has_no_reverse_mode_and_says_so():
    with pytest.raises(TypeError, match="one-sided derivative"):
        value_and_gradient(*thrown(), jc.CriticalCone())


def test_weak_contact_choice_must_be_an_object():
    stepper, control, initial = thrown()
    with pytest.raises(ValueError, match=r"jc\.ClosedBranch\(\)"):
        jc.simulate(stepper, control, initial=initial, weak_contact="strong")
    with pytest.raises(ValueError, match="control"):
        jc.simulate(stepper, steps=STEPS, initial=initial, weak_contact=jc.AlongDirection(control))
