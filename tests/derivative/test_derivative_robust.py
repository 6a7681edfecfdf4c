"""Gradients where gradients of contact usually break, and on random scenes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.thrown_bodies import DT, MESHES, SIDES, up

import jaxcontact as jc

#: Central differences with the step 1e-6.
DIFFERENCE = 1e-6
ROUNDING = 1e-10


def thrown(dimension, gap, speed, *, force=0.0, material=None, dtype=jnp.float64, dt=DT):
    """Stepper and initial state of an unloaded body at the given gap and speed of approach"""
    mesh, e = MESHES[dimension], up(dimension)
    scene = jc.Scene(
        mesh,
        jc.KelvinVoigt(young=100.0, poisson=0.3) if material is None else material,
        contact={SIDES[dimension][0]: jc.HalfSpace(-gap * e, e)},
        body_force=-force * e,
    )
    shape = (mesh.n_nodes, dimension)
    rng = np.random.default_rng(7)
    velocity = jnp.asarray(-speed * e + 0.01 * rng.normal(size=shape), dtype)
    stepper = jc.prepare(jc.discretize(scene, dtype=dtype), dt)
    return stepper, jc.State(jnp.zeros(shape, dtype), velocity)


def run(stepper, initial, steps):
    """Value and gradient of a cost by the initial velocity, and the trajectory"""

    def value(velocity):
        trajectory = jc.simulate(
            stepper, steps=steps, initial=jc.State(initial.displacement, velocity)
        )
        final = trajectory.velocity[-1]
        weight = jnp.linspace(1.0, 2.0, final.size, dtype=final.dtype).reshape(final.shape)
        return jnp.sum(weight * final), trajectory

    return jax.jit(lambda v: jax.value_and_grad(value, has_aux=True)(v))(initial.velocity), value


PHASES = {
    "free flight": dict(gap=1.0, speed=0.5, steps=5),
    "one step": dict(gap=0.005, speed=1.0, steps=1),
    "impact": dict(gap=0.03, speed=1.0, steps=8),
    "lift-off": dict(gap=0.03, speed=1.0, steps=30),
    "all pairs pressed": dict(gap=0.0, speed=0.5, force=5.0, steps=4),
    "bounces that come to rest": dict(gap=0.0, speed=0.0, force=5.0, steps=200),
}


@pytest.mark.parametrize("phase", PHASES)
def test_gradient_is_finite_and_right_in_every_phase(phase):
    options = dict(PHASES[phase])
    steps = options.pop("steps")
    viscous = jc.KelvinVoigt(young=100.0, poisson=0.3, bulk_viscosity=1.0, shear_viscosity=1.0)
    material = viscous if phase.startswith("bounces") else None
    stepper, initial = thrown(2, material=material, **options)
    ((value, trajectory), gradient), function = run(stepper, initial, steps)
    strong = np.asarray(trajectory.strong)
    expected = {
        "free flight": not strong.any(),
        "lift-off": strong.any() and not strong[-1].any(),
        "all pairs pressed": strong[0].all(),
        "bounces that come to rest": strong[-1].all(),
    }
    assert expected.get(phase, strong.any()), phase
    assert np.all(np.isfinite(gradient))
    direction = jnp.asarray(np.random.default_rng(1).normal(size=gradient.shape))
    h = 1e-7
    ahead, behind = (function(initial.velocity + s * h * direction)[0] for s in (1.0, -1.0))
    derivative = float(jnp.vdot(gradient, direction))
    bound = DIFFERENCE * abs(derivative) + 1e-13 * abs(float(value)) / h + 1e-14 / h
    assert abs(float(ahead - behind) / (2 * h) - derivative) <= bound


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_gradient_in_single_precision_is_that_of_double_precision(dimension):
    double = run(*thrown(dimension, 0.03, 1.0), 12)[0][1]
    single = run(*thrown(dimension, 0.03, 1.0, dtype=jnp.float32), 12)[0][1]
    assert single.dtype == jnp.float32
    # Twelve steps with condition number about 100: five digits remain of seven.
    np.testing.assert_allclose(single, double, atol=1e-4 * float(jnp.max(jnp.abs(double))))


def test_gradient_at_traced_zero_viscosity_is_the_elastic_one_and_one_sided_in_viscosity():
    def value(viscosity):
        material = jc.KelvinVoigt(young=100.0, poisson=0.3, shear_viscosity=viscosity)
        stepper, initial = thrown(2, 0.03, 1.0, material=material)
        return jnp.sum(jc.simulate(stepper, steps=12, initial=initial).velocity[-1] ** 2)

    slope = jax.grad(value)(0.0)
    h = 1e-6
    assert abs(float(value(h) - value(0.0)) / h - float(slope)) <= 1e-4 * abs(float(slope))


@pytest.mark.slow
def test_gradient_through_ten_thousand_steps_is_right():
    material = jc.KelvinVoigt(young=100.0, poisson=0.3, bulk_viscosity=1.0, shear_viscosity=1.0)
    stepper, initial = thrown(1, 0.03, 1.0, force=2.0, material=material)
    (_, gradient), function = run(stepper, initial, 10_000)
    assert np.all(np.isfinite(gradient))
    direction = jnp.ones_like(gradient)
    h = 1e-6
    ahead, behind = (function(initial.velocity + s * h * direction)[0] for s in (1.0, -1.0))
    # At rest after many bounces: the end forgets the start, up to rounding.
    scale = 1e-9 / h
    assert abs(float(ahead - behind) / (2 * h) - float(jnp.vdot(gradient, direction))) <= scale


def test_gradient_of_a_failed_step_is_nan_and_never_zero():
    # One sweep is not enough where pairs are coupled.
    stepper, initial = thrown(2, 0.0, 0.5, force=5.0)
    stepper = jc.with_contact(stepper, jc.ProjectedGaussSeidel(max_sweeps=1))
    ((value, trajectory), gradient), _ = run(stepper, initial, 3)
    assert np.any(np.asarray(trajectory.status) > jc.Status.FALLBACK)
    assert np.isnan(value)
    assert np.all(np.isnan(gradient) | (np.asarray(gradient) != 0.0))
    assert np.any(np.isnan(gradient))


def test_gradient_of_a_nan_control_is_nan():
    stepper, initial = thrown(1, 0.03, 1.0)
    control = jnp.zeros((8, MESHES[1].n_nodes, 1)).at[3, 2, 0].set(jnp.nan)

    def value(control):
        return jnp.sum(jc.simulate(stepper, control, initial=initial).velocity[-1] ** 2)

    gradient = jax.jit(jax.grad(value))(control)
    assert np.all(np.isnan(gradient[:3]))


BLOCK = jc.meshes.rectangle((1.0, 0.5), h=0.25)


@jax.jit
def products(young, viscosity, height, tilt, control, direction, weight):
    """<J' du, w> and <du, J'* w> of the end of a motion, relative, and the number of contacts"""
    scene = jc.Scene(
        BLOCK,
        jc.KelvinVoigt(young=young, poisson=0.3, shear_viscosity=viscosity),
        contact={
            "bottom": jc.HalfSpace(jnp.stack([0.0, -0.12 * (1.0 + height)]), jnp.stack([tilt, 1.0]))
        },
    )
    fall = jnp.zeros(BLOCK.points.shape).at[:, 1].set(-2.0)
    initial = jc.State(jnp.zeros_like(fall), fall)
    stepper = jc.prepare(jc.discretize(scene), DT)

    def end(u, choice=None):
        trajectory = jc.simulate(stepper, u, initial=initial, weak_contact=choice)
        return jnp.concatenate(
            [
                trajectory.velocity[-1].ravel(),
                trajectory.displacement.ravel(),
                trajectory.contact_impulse.ravel(),
            ]
        ), jnp.sum(trajectory.active)

    _, tangent, count = jax.jvp(
        lambda u: end(u, jc.ClosedBranch()), (control,), (direction,), has_aux=True
    )
    cotangent = jnp.resize(weight, tangent.shape)
    _, pull, _ = jax.vjp(end, control, has_aux=True)
    pulled = pull(cotangent)[0]
    first, second = jnp.vdot(tangent, cotangent), jnp.vdot(direction, pulled)
    return (first - second) / (jnp.linalg.norm(tangent) * jnp.linalg.norm(cotangent)), count


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31),
    young=st.floats(10.0, 1e4),
    viscosity=st.floats(0.0, 1.0),
    height=st.floats(0.0, 1.0),
    tilt=st.floats(-0.1, 0.1),
)
def test_adjoint_of_a_random_scene_is_the_transpose_of_its_derivative(
    seed, young, viscosity, height, tilt
):
    rng = np.random.default_rng(seed)
    control, direction = jnp.asarray(rng.normal(size=(2, 20, BLOCK.n_nodes, 2)))
    weight = jnp.asarray(rng.normal(size=97))
    error, _ = products(young, viscosity, height, tilt, 5.0 * control, direction, weight)
    assert abs(float(error)) <= ROUNDING


def test_random_scenes_of_the_transpose_test_have_contact():
    control = jnp.zeros((20, BLOCK.n_nodes, 2))
    ones = jnp.ones_like(control)
    _, count = products(100.0, 0.1, 0.5, 0.05, control, ones, jnp.ones(97))
    assert int(count) > 5
