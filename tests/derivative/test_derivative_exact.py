"""Gradients of the bar against those of its exact solution.

A free bar hits a wall. In one simulation the loss of energy depends on the fraction of the step at
which it touches, and its derivative by that fraction does not tend to zero; the mean over impact
phases does, so the claim is about means over eight phases.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

EXACT = jc.reference.FreeBar()
PHASES = (jnp.arange(8) + 0.5) / 8
CELLS = (20, 40, 80)


def bar(parameters, n_cells):
    speed, density, young, gap = parameters
    return jc.reference.FreeBar(impact_speed=speed, density=density, young=young, gap=gap)


def exact_outcome(parameters):
    """Rebound velocity and impulse of the exact solution, (2,)"""
    solution = bar(parameters, 0)
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
