"""Weak contact: one-sided derivatives, and the linear branches between them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import SCHEMES
from support.thrown_bodies import DT, STEPS, cost, grazing, parameters, stepper_of

import jaxcontact as jc

#: One-sided difference quotients of a piecewise smooth motion, error per length of the step.
FIRST_ORDER = 1.0
#: Two ways to add the same numbers.
ROUNDING = 1e-10
DIMENSIONS = [1, 2, 3]
FIELDS = ("displacement", "velocity", "gap", "contact_impulse")


def direction_of(control, seed=5):
    return jnp.asarray(np.random.default_rng(seed).normal(size=control.shape))


def largest_error(first, second):
    """Largest difference of the fields of two trajectories relative to the largest value"""
    errors = []
    for name in FIELDS:
        a, b = np.asarray(getattr(first, name)), np.asarray(getattr(second, name))
        errors.append(np.max(np.abs(a - b)) / max(np.max(np.abs(b)), 1e-300))
    return max(errors)


def quotient(stepper, control, initial, direction, t):
    """One-sided difference quotient, a trajectory"""
    here = jc.simulate(stepper, control, initial=initial)
    there = jc.simulate(stepper, control + t * direction, initial=initial)
    return jax.tree.map(lambda a, b: (b.astype(float) - a.astype(float)) / t, here, there)


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_trajectory_shows_the_weak_contact(dimension):
    stepper, control, initial, place = grazing(dimension)
    trajectory = jc.simulate(stepper, control, initial=initial)
    np.testing.assert_array_equal(np.argwhere(trajectory.weak), [place])
    assert not np.any(trajectory.strong)
    assert np.all(np.asarray(trajectory.contact_impulse) == 0.0)


@pytest.mark.parametrize("dimension", DIMENSIONS)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_directional_derivative_is_the_one_sided_quotient_at_weak_contact(dimension, sign):
    stepper, control, initial, _ = grazing(dimension)
    direction = sign * direction_of(control)
    derivative = jc.directional_derivative(stepper, control, direction, initial=initial)
    t = 1e-6
    error = largest_error(quotient(stepper, control, initial, direction, t), derivative)
    assert error <= 1e-12 / t + FIRST_ORDER * t


def test_trajectory_shows_weak_contact_after_strong_contact_with_averaged_forces():
    # A mass at rest at a wall: under a constant load of excess f the forces are 2 f, 0, 2 f, 0, ...
    scene = jc.Scene(
        jc.meshes.interval(1.0, h=1.0),
        jc.KelvinVoigt(young=4.0, poisson=0.0, density=3.0),
        clamped=("right",),
        contact={"left": jc.HalfSpace(np.array([-0.1]), np.ones(1))},
    )
    stepper = jc.prepare(jc.discretize(scene), 0.2, scheme=jc.Trapezoidal())
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


def test_trajectory_shows_weak_contact_of_the_predictor():
    stepper, control, initial, place = grazing(1, jc.ContactStabilized())
    trajectory = jc.simulate(stepper, control, initial=initial)
    assert not np.any(trajectory.active)
    np.testing.assert_array_equal(np.argwhere(trajectory.weak), [place])


@pytest.mark.parametrize("dimension", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("scheme", SCHEMES[1:], ids=lambda s: type(s).__name__)
def test_directional_derivative_is_the_one_sided_quotient_for_every_scheme(scheme, dimension):
    stepper, control, initial, place = grazing(dimension, scheme)
    trajectory = jc.simulate(stepper, control, initial=initial)
    np.testing.assert_array_equal(np.argwhere(trajectory.weak), [place])
    velocities = []
    for sign in (1.0, -1.0):
        direction = sign * direction_of(control)
        derivative = jc.directional_derivative(stepper, control, direction, initial=initial)
        t = 1e-6
        error = largest_error(quotient(stepper, control, initial, direction, t), derivative)
        assert error <= 1e-11 / t + FIRST_ORDER * t, sign
        velocities.append(derivative.velocity)
    assert np.max(np.abs(sum(velocities))) > 1e-3 * np.max(np.abs(velocities[0])), "no kink"


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


def test_directional_derivative_is_not_linear_at_weak_contact():
    stepper, control, initial, _ = grazing(2)
    direction = direction_of(control)
    right, left = (
        jc.directional_derivative(stepper, control, s * direction, initial=initial)
        for s in (1.0, -1.0)
    )
    kink = np.max(np.abs(right.velocity + left.velocity)) / np.max(np.abs(right.velocity))
    assert kink > 0.1


def test_directional_derivative_is_linear_without_weak_contact():
    values = parameters(2)
    stepper = stepper_of(2, values)
    initial = jc.State(values["displacement"], values["velocity"])
    control = values["control"]
    first, second = direction_of(control, 1), direction_of(control, 2)

    def derivative(direction):
        return jc.directional_derivative(stepper, control, direction, initial=initial)

    trajectory = jc.simulate(stepper, control, initial=initial)
    assert np.any(trajectory.strong)
    assert not np.any(trajectory.weak)
    total = jax.tree.map(lambda a, b: a - 2.0 * b, derivative(first), derivative(second))
    assert largest_error(derivative(first - 2.0 * second), total) <= ROUNDING


def test_directional_derivative_by_initial_state_and_stepper_is_the_quotient():
    values = parameters(2)
    start = jc.State(values["displacement"], values["velocity"])
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

    central = jax.tree.map(
        lambda a, b: (a.astype(float) - b.astype(float)) / (2 * t), moved(t), moved(-t)
    )
    assert largest_error(central, derivative) <= 1e-6


@pytest.mark.parametrize("dimension", DIMENSIONS)
@pytest.mark.parametrize("seed", [5, 6])
def test_gradients_of_the_branches_are_the_one_sided_derivatives(dimension, seed):
    stepper, control, initial, place = grazing(dimension)
    direction = direction_of(control, seed)

    def gradient(choice):
        def value(u):
            return cost(jc.simulate(stepper, u, initial=initial, weak_contact=choice))

        return jax.grad(value)(control)

    strong, inactive = gradient(jc.ClosedBranch()), gradient(jc.OpenBranch())
    for sign in (1.0, -1.0):
        towards = sign * direction
        tangent = jc.directional_derivative(stepper, control, towards, initial=initial)
        trajectory = jc.simulate(stepper, control, initial=initial)
        _, exact = jax.jvp(
            lambda u, towards=towards: cost(
                jc.simulate(stepper, u, initial=initial, weak_contact=jc.CriticalCone())
            ),
            (control,),
            (towards,),
        )
        is_pressed = float(tangent.contact_impulse[place]) > 0.0
        branch = strong if is_pressed else inactive
        other = inactive if is_pressed else strong
        scale = float(jnp.linalg.norm(branch) * jnp.linalg.norm(towards))
        assert abs(float(jnp.vdot(branch, towards)) - float(exact)) <= ROUNDING * scale
        assert abs(float(jnp.vdot(other, towards)) - float(exact)) > 1e-5 * scale
        along = gradient(jc.AlongDirection(towards))
        np.testing.assert_allclose(along, branch, atol=ROUNDING * float(jnp.max(jnp.abs(branch))))
        t = 1e-6
        there = jc.simulate(stepper, control + t * towards, initial=initial)
        one_sided = float(cost(there) - cost(trajectory)) / t
        assert abs(one_sided - float(exact)) <= 1e-5 * scale


@pytest.mark.parametrize("scheme", SCHEMES[1:], ids=lambda s: type(s).__name__)
def test_gradient_along_a_direction_is_the_one_sided_derivative_for_every_scheme(scheme):
    stepper, control, initial, _ = grazing(2, scheme)
    for sign in (1.0, -1.0):
        direction = sign * direction_of(control)

        def value(u, choice):
            return cost(jc.simulate(stepper, u, initial=initial, weak_contact=choice))

        along = jax.grad(value)(control, jc.AlongDirection(direction))
        _, exact = jax.jvp(
            lambda u, value=value: value(u, jc.CriticalCone()), (control,), (direction,)
        )
        scale = float(jnp.linalg.norm(along) * jnp.linalg.norm(direction))
        assert abs(float(jnp.vdot(along, direction)) - float(exact)) <= ROUNDING * scale


def test_gradient_along_a_direction_of_the_initial_state_chooses_the_branch():
    stepper, control, initial, _ = grazing(2)
    towards = jc.State(jnp.zeros_like(initial.displacement), initial.velocity)

    def value(velocity, choice):
        start = jc.State(initial.displacement, velocity)
        return cost(jc.simulate(stepper, control, initial=start, weak_contact=choice))

    along = jax.grad(value)(initial.velocity, jc.AlongDirection(initial=towards))
    # A faster fall presses the pair.
    strong = jax.grad(value)(initial.velocity, jc.ClosedBranch())
    np.testing.assert_allclose(along, strong, rtol=1e-10)


def test_critical_cone_has_no_reverse_mode_and_says_so():
    stepper, control, initial, _ = grazing(1)

    def value(u):
        motion = jc.simulate(stepper, u, initial=initial, weak_contact=jc.CriticalCone())
        return jnp.sum(motion.displacement)

    with pytest.raises(TypeError, match="one-sided derivative"):
        jax.grad(value)(control)


def test_weak_contact_choice_must_be_an_object():
    stepper, control, initial, _ = grazing(1)
    with pytest.raises(ValueError, match=r"jc\.ClosedBranch\(\)"):
        jc.simulate(stepper, control, initial=initial, weak_contact="strong")
    with pytest.raises(ValueError, match="control"):
        jc.simulate(stepper, steps=STEPS, initial=initial, weak_contact=jc.AlongDirection(control))


def test_directional_derivative_many_weak_pairs_solve_the_complementarity_problem():
    # A flat bottom that grazes with every node: the sign of each pair is found.
    mesh = jc.meshes.rectangle((2.0, 1.0), h=0.25)
    scene = jc.Scene(
        mesh,
        jc.KelvinVoigt(young=100.0, poisson=0.3),
        contact={"bottom": jc.HalfSpace(np.zeros(2), np.array([0.0, 1.0]))},
    )
    stepper = jc.prepare(jc.discretize(scene), DT)
    control = jnp.zeros((1, mesh.n_nodes, 2))
    trajectory = jc.simulate(stepper, control)
    assert np.all(trajectory.weak)
    for seed in range(5):
        direction = direction_of(control, seed)
        derivative = jc.directional_derivative(stepper, control, direction)
        gap, impulse = np.asarray(derivative.gap[1]), np.asarray(derivative.contact_impulse[0])
        assert 0 < np.count_nonzero(impulse) < impulse.size
        assert np.all(impulse >= -ROUNDING * impulse.max())
        assert np.all(gap >= -ROUNDING * np.abs(gap).max())
        assert np.all(gap * impulse <= ROUNDING * gap.max() * impulse.max())
