"""Exact gradients of every scheme: Taylor remainders of second order on bar and half disc."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from common import bars
from support.bodies import SCHEMES

import jaxcontact as jc

by_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: type(s).__name__)
STEPS = 40


def assert_taylor(objective, x, direction, sizes):
    """Remainders |J(x + s d) - J(x) - s J'd| fall like s^2, and are not rounding"""
    value, derivative = jax.value_and_grad(objective)(x)
    slope = jnp.vdot(derivative, direction)
    values = jnp.array([objective(x + s * direction) for s in sizes])
    remainders = np.abs(values - value - np.asarray(sizes) * slope)
    assert np.abs(slope) * sizes[-1] > 100 * remainders[-1]
    orders = np.diff(np.log(remainders)) / np.diff(np.log(sizes))
    np.testing.assert_allclose(orders, 2.0, atol=0.1)


def bar(young=900.0, density=1.0, viscosity=0.5):
    """A bar of 12 cells that meets a wall in its third step"""
    scene = jc.Scene(
        jc.meshes.interval(10.0, h=10.0 / 12),
        jc.KelvinVoigt(young=young, poisson=0.0, density=density, bulk_viscosity=viscosity),
        contact={"left": jc.HalfSpace(np.array([-0.65]), np.array([1.0]))},
    )
    return jc.discretize(scene)


def final_square(stepper, speed=10.0, gap=None):
    """Square of the final displacement and velocity of a bar that is thrown at the wall"""
    system = stepper.system
    if gap is not None:
        system = dataclasses.replace(system, gap=jnp.reshape(gap, (1,)))
        stepper = dataclasses.replace(stepper, system=system)
    v = jnp.full((system.n_nodes, 1), -1.0) * speed
    trajectory = jc.simulate(stepper, steps=STEPS, initial=jc.State(0.0 * v, v))
    final = trajectory.final
    return jnp.sum(final.displacement**2) + 0.1 * jnp.sum(final.velocity**2)


PARAMETERS = {
    "impact speed": lambda scheme, p: final_square(prepared(scheme), speed=10.0 * p),
    "gap": lambda scheme, p: final_square(prepared(scheme), gap=0.65 * p),
    "young": lambda scheme, p: final_square(jc.prepare(bar(young=900.0 * p), 0.03, scheme=scheme)),
    "density": lambda scheme, p: final_square(jc.prepare(bar(density=p), 0.03, scheme=scheme)),
    "viscosity": lambda scheme, p: final_square(
        jc.prepare(bar(viscosity=0.5 * p), 0.03, scheme=scheme)
    ),
    "time step": lambda scheme, p: final_square(jc.prepare(bar(), 0.03 * p, scheme=scheme)),
}


def prepared(scheme):
    return jc.prepare(bar(), 0.03, scheme=scheme)


@pytest.mark.slow
@pytest.mark.parametrize("parameter", PARAMETERS)
@by_scheme
def test_scheme_gradient_of_a_thrown_bar_passes_the_taylor_test(scheme, parameter):
    objective = jax.jit(lambda p: PARAMETERS[parameter](scheme, p))
    # The motion depends little on the viscosity: smaller steps would show rounding only.
    size = 1e-4 if parameter == "viscosity" else 1e-6
    assert_taylor(objective, jnp.asarray(1.0), jnp.asarray(1.0), [4 * size, 2 * size, size])


@by_scheme
def test_scheme_gradient_on_the_half_disc_passes_the_taylor_test(scheme):
    system = jc.discretize(jc.scenes.half_disc(h=15 / 4, gap=0.05))
    stepper = jc.prepare(system, 5e-4, scheme=scheme)
    push = jnp.zeros((STEPS, system.n_nodes, 2)).at[:, :, 1].set(-2e6)
    assert jnp.any(jc.simulate(stepper, push).contact_impulse > 0.0)
    direction = jnp.asarray(np.random.default_rng(0).normal(size=push.shape)) * 1e6

    @jax.jit
    def objective(control):
        return jnp.sum(jc.simulate(stepper, control).displacement ** 2)

    assert_taylor(objective, push, direction, [4e-5, 2e-5, 1e-5])


@functools.cache
def rebound_gradient_errors(scheme, n):
    """Relative errors of d(mean final displacement)/d(impact speed) of P2, four phases"""
    bar = bars.free_bar()
    dt = bars.time_step(bar, n, 1.0)
    stepper = jc.prepare(bars.discretize(bar, n), dt, scheme=scheme)
    steps = round(bar.duration / dt)
    x, t = jnp.linspace(0.0, 10.0, n + 1), jnp.asarray(steps * dt)

    @jax.jit
    @jax.grad
    def slope(p, gap):
        _, placed, initial = bars.place(bar, stepper, gap)
        initial = jc.State(initial.displacement, p * initial.velocity)
        return jnp.mean(jc.simulate(placed, steps=steps, initial=initial).final.displacement)

    @jax.grad
    def exact(p, gap):
        thrown = dataclasses.replace(bar.exact, gap=gap, impact_speed=10.0 * p)
        return jnp.mean(thrown.displacement(x, t))

    gaps = [jnp.asarray(gap) for gap in bars.phases(bar, dt, 4)]
    return np.array([float(slope(1.0, gap) / exact(1.0, gap)) - 1.0 for gap in gaps])


def test_contact_implicit_gradient_of_a_rebound_does_not_converge_phase_by_phase():
    # The loss 4 theta (1 - theta) O(h) of a touch, and theta changes by 1 over a change of O(h).
    for n in (50, 100):
        errors = rebound_gradient_errors(jc.ContactImplicit(), n)
        assert np.abs(errors).max() > 0.3
        assert abs(errors.mean()) < 0.2


def test_contact_stabilized_gradient_of_a_rebound_converges():
    coarse, fine = (rebound_gradient_errors(jc.ContactStabilized(), n) for n in (50, 200))
    assert np.abs(coarse).max() < 0.25
    assert np.abs(fine).max() < 0.02


def test_trapezoidal_gradient_flows_through_the_force_of_the_last_step():
    # Two steps: the force of the first enters the second, so cutting that path shows.
    stepper = prepared(jc.Trapezoidal())

    def force(speed):
        v = jnp.full((13, 1), -1.0) * speed
        start = jc.State(jnp.zeros((13, 1)).at[0].set(-0.64), v)
        return jc.simulate(stepper, steps=2, initial=start).contact_impulse[1, 0]

    quotient = (force(10.001) - force(9.999)) / 2e-3
    np.testing.assert_allclose(jax.grad(force)(10.0), quotient, rtol=1e-8)
