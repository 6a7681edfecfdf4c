"""The half disc pressed on a plane by a constant force, on nested meshes, against a fine run.

Nodes of m rings are nodes of 2 m rings too, so displacements are compared at nodes.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial

import jaxcontact as jc

DURATION = 7.5e-3
PUSH = -1e6
GAP = 0.1


class Reference(NamedTuple):
    """A fine run."""

    points: np.ndarray
    times: np.ndarray
    displacement: np.ndarray
    """(T+1, N, 2) [m]."""
    impulse: np.ndarray
    """Impulse of all pairs from the start to each time level, (T+1,) [N s]."""
    energy: float
    gradient: float


def prepare(rings: int, dt: float, scheme: Any, dtype: Any = jnp.float64) -> jc.Stepper:
    """Return the stepper of the half disc of m rings under a body force."""
    scene = dataclasses.replace(
        jc.scenes.half_disc(h=15.0 / rings, gap=GAP), body_force=np.array([0.0, PUSH])
    )
    return jc.prepare(jc.discretize(scene, dtype=dtype), dt, scheme=scheme)


def run(
    stepper: jc.Stepper, push: jax.Array, count: jax.Array, steps: int
) -> tuple[jax.Array, jc.Trajectory]:
    """Return mean vertical displacement over space and time, and the trajectory.

    Args:
        stepper: from `prepare`.
        push: factor of the body force, scalar.
        count: number of steps of the mean, at most `steps`.
        steps: number of steps that are made.
    """
    system = dataclasses.replace(stepper.system, load=push * stepper.system.load)
    trajectory = jc.simulate(dataclasses.replace(stepper, system=system), steps=steps)
    nodal = trajectory.displacement[:, :, 1].T
    weighted = jnp.sum(stepper.system.nodal_mass @ nodal, axis=0)
    area = jnp.sum(stepper.system.nodal_mass @ jnp.ones((system.n_nodes, 1), system.dtype))
    middle = 0.5 * (weighted[1:] + weighted[:-1])
    return jnp.sum(middle, where=jnp.arange(steps) < count) / (area * count), trajectory


@partial(jax.jit, static_argnums=3)
def value(stepper: jc.Stepper, push: jax.Array, count: jax.Array, steps: int):
    """Run it."""
    return run(stepper, push, count, steps)


@partial(jax.jit, static_argnums=3)
def gradient(stepper: jc.Stepper, push: jax.Array, count: jax.Array, steps: int):
    """Return the derivative by the factor of the body force, and the trajectory."""
    derivative, trajectory = jax.grad(lambda p: run(stepper, p, count, steps), has_aux=True)(push)
    return derivative, trajectory


def slopes(
    stepper: jc.Stepper, trajectory: jc.Trajectory, count: int, steps: int, phases: int
) -> np.ndarray:
    """Return the derivatives at equally spaced phases of the touch, (phases,)."""
    system, one = stepper.system, jnp.ones((), stepper.system.dtype)
    step = trajectory.closing_speed * stepper.dt

    def moved(share: float) -> jc.Stepper:
        return dataclasses.replace(stepper, system=system.with_gap(system.gap + share * step))

    shares = np.arange(phases) / phases
    return np.array([float(gradient(moved(x), one, count, steps)[0]) for x in shares])


@jax.jit
def energy_at(stepper: jc.Stepper, displacement: jax.Array, velocity: jax.Array) -> jax.Array:
    """Return kinetic and elastic energy of a state (N, d), (N, d), scalar."""
    system = stepper.system
    y, v = system.restrict(displacement), system.restrict(velocity)
    elastic = jnp.dot(y, system.stiffness @ y)
    return 0.5 * (elastic + jnp.dot(v, stepper.operators.mass @ v))


def reference(rings: int, steps: int, scheme: Any, phases: int) -> Reference:
    """Return the fine run; its gradient is a mean over phases of the touch."""
    stepper = prepare(rings, DURATION / steps, scheme)
    one = jnp.asarray(1.0, stepper.system.dtype)
    _, trajectory = value(stepper, one, steps, steps)
    impulse = np.asarray(trajectory.contact_impulse).sum(axis=1)
    return Reference(
        np.asarray(stepper.system.points),
        np.asarray(trajectory.time),
        np.asarray(trajectory.displacement),
        np.concatenate([[0.0], np.cumsum(impulse)]),
        float(energy_at(stepper, trajectory.displacement[-1], trajectory.velocity[-1])),
        float(np.mean(slopes(stepper, trajectory, steps, steps, phases))),
    )


def errors(stepper: jc.Stepper, trajectory: jc.Trajectory, count: int, fine: Reference) -> dict:
    """Return the relative errors of the first steps of a run against a fine one."""
    _, nodes = scipy.spatial.cKDTree(fine.points).query(np.asarray(stepper.system.points))
    times = np.asarray(trajectory.time[: count + 1], float)
    levels = np.clip(np.searchsorted(fine.times, times - 1e-9), 0, len(fine.times) - 1)
    exact = fine.displacement[levels][:, nodes]
    impulse = np.asarray(trajectory.contact_impulse[:count], float).sum(axis=1)
    exact_impulse = np.diff(np.interp(times, fine.times, fine.impulse))
    end = trajectory.displacement[count], trajectory.velocity[count]
    total = float(energy_at(stepper, *end))
    difference = np.asarray(trajectory.displacement[: count + 1], float) - exact
    return {
        "displacement": float(np.linalg.norm(difference) / np.linalg.norm(exact)),
        "force": float(np.abs(impulse - exact_impulse).sum() / exact_impulse.sum()),
        "energy": abs(total / fine.energy - 1.0),
    }
