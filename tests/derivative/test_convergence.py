"""Gradients of the bar against those of its exact solution.

A free bar hits a wall. In one simulation of `ContactImplicit` the loss of energy depends on the
fraction of the step at which it touches, and its derivative by that fraction does not tend to zero;
the mean over impact phases does, so the first claim is about means over eight phases.
"""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from common import bars

import jaxcontact as jc

EXACT = jc.reference.FreeBar()
PHASES = (np.arange(8) + 0.5) / 8
CELLS = (20, 80)


def exact_outcome(parameters):
    """Rebound velocity and impulse of the exact solution, (2,)"""
    speed, density, young, gap = parameters
    solution = jc.reference.FreeBar(impact_speed=speed, density=density, young=young, gap=gap)
    return jnp.stack([solution.rebound_velocity(), solution.impulse()])


@cache
def discrete_jacobian(n_cells):
    """Outcome (2,) of the simulation and its jacobian (2, 4), means over the phases"""
    length = float(EXACT.length)
    dt = length / n_cells / float(EXACT.wave_speed())
    mesh = jc.meshes.interval(length, h=length / n_cells)
    steps = 2 * n_cells + n_cells // 2

    def outcome(parameters, phase):
        speed, density, young, gap = parameters
        # The start is moved, so that the touch comes after 2 + phase steps.
        shift = float(EXACT.gap) - float(EXACT.impact_speed) * dt * (2.0 + phase)
        obstacle = jc.HalfSpace(-jnp.stack([gap - shift]), np.array([1.0]))
        scene = jc.Scene(
            mesh,
            jc.KelvinVoigt(young=young, poisson=0.0, density=density),
            contact={"left": obstacle},
        )
        stepper = jc.prepare(jc.discretize(scene), dt, linear_solver=jc.Dense())
        fall = jnp.full(mesh.points.shape, -1.0) * speed
        initial = jc.State(jnp.zeros_like(fall), fall)
        trajectory = jc.simulate(stepper, steps=steps, initial=initial)
        mass = stepper.system.nodal_mass @ jnp.ones(mesh.n_nodes)
        mean = jnp.sum(mass * trajectory.velocity[-1, :, 0]) / length
        return jnp.stack([mean, jnp.sum(trajectory.contact_impulse)])

    def both(parameters, phase):
        return outcome(parameters, phase), jax.jacrev(outcome)(parameters, phase)

    values, jacobians = jax.jit(jax.vmap(both, in_axes=(None, 0)))(
        jnp.array([float(x) for x in (EXACT.impact_speed, EXACT.density, EXACT.young, EXACT.gap)]),
        PHASES,
    )
    return values.mean(axis=0), jacobians.mean(axis=0)


PARAMETERS = ("velocity", "density", "stiffness", "gap")


@pytest.mark.parametrize("row", [0, 1], ids=["rebound", "impulse"])
@pytest.mark.parametrize("column", range(4), ids=PARAMETERS)
def test_gradient_of_the_bar_converges_to_the_exact_one(row, column):
    point = jnp.array(
        [float(x) for x in (EXACT.impact_speed, EXACT.density, EXACT.young, EXACT.gap)]
    )
    exact = np.asarray(jax.jacrev(exact_outcome)(point))[row, column]
    # Elasticities: derivative times parameter over outcome.
    scale = float(point[column]) / float(exact_outcome(point)[row])
    errors = [abs(float(discrete_jacobian(n)[1][row, column]) - exact) * scale for n in CELLS]
    assert errors[-1] <= 0.05
    assert errors[-1] <= 0.6 * errors[0] or errors[0] <= 1e-3


@cache
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

    @jax.jit
    @jax.grad
    def exact(p, gap):
        thrown = replace(bar.exact, gap=gap, impact_speed=10.0 * p)
        return jnp.mean(thrown.displacement(x, t))

    gaps = [jnp.asarray(gap) for gap in bars.phases(bar, dt, 4)]
    return np.array([float(slope(1.0, gap) / exact(1.0, gap)) - 1.0 for gap in gaps])


def test_contact_implicit_gradient_of_a_rebound_does_not_converge_phase_by_phase():
    # The loss 4 theta (1 - theta) O(h) of a touch, and theta changes by 1 over a change of O(h).
    for n in (50, 200):
        errors = rebound_gradient_errors(jc.ContactImplicit(), n)
        assert np.abs(errors).max() > 0.3
        assert abs(errors.mean()) < 0.2


def test_contact_stabilized_gradient_of_a_rebound_converges():
    coarse, fine = (rebound_gradient_errors(jc.ContactStabilized(), n) for n in (50, 200))
    assert np.abs(coarse).max() < 0.25
    assert np.abs(fine).max() < 0.02
