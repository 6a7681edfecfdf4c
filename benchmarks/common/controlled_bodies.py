"""Full models under controls, with the tracking cost of the paper: what reduced models replace.

Two loads: A, 0.7 times the uniform reference control, and B, smooth in space and time, not
symmetric and stronger.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc

SCALE, WEIGHT, FINAL, DT = 1e6, 1e-2, 7.5e-4, 5e-5


class Body(NamedTuple):
    """A full model with its problem."""

    name: str
    stepper: jc.Stepper
    cost: jc.TrackingCost
    target: jax.Array
    loads: dict[str, jax.Array]
    """Controls before scaling, (T, N, d)."""


def make_body(name: str, scene: jc.Scene, steps: int, dtype: Any) -> Body:
    """Return the full model and the two loads."""
    system = jc.discretize(scene, dtype=dtype)
    stepper = jc.prepare(system, DT)
    down = np.broadcast_to(-np.eye(system.dimension)[-1], (steps, *system.points.shape))
    reference = jnp.asarray(down, dtype)
    loads = {"A": 0.7 * reference, "B": jnp.asarray(smooth(system, steps), dtype)}
    target = jc.simulate(stepper, SCALE * reference).displacement
    return Body(name, stepper, tracking(system, target), target, loads)


def half_disc(rings: int, steps: int, dtype: Any) -> Body:
    """Return the half disc of the paper."""
    return make_body("half disc", jc.scenes.half_disc(h=15.0 / rings), steps, dtype)


def tracking(system: jc.System, target: jax.Array) -> jc.TrackingCost:
    """Return the paper's cost."""
    return jc.TrackingCost(system, dt=DT, target=target, control_weight=WEIGHT, final_weight=FINAL)


def smooth(system: jc.System, steps: int, n_waves: int = 4, seed: int = 0) -> np.ndarray:
    """Return a control that is smooth in space and time, (T, N, d), about one downwards."""
    rng = np.random.default_rng(seed)
    x = np.asarray(system.points) / np.max(np.abs(system.points))
    time = np.arange(steps) / steps
    d = system.dimension
    control = np.zeros((steps, *x.shape))
    for _ in range(n_waves):
        place = np.cos(x @ rng.normal(size=d) * 3.0 + rng.uniform(0.0, 6.0))
        course = np.cos(2.0 * np.pi * rng.uniform(0.0, 2.0) * time + rng.uniform(0.0, 6.0))
        control += course[:, None, None] * place[None, :, None] * rng.normal(size=d)
    control[..., -1] -= 2.0
    return control


def objective(stepper: jc.Stepper, cost: jc.TrackingCost, u: jax.Array) -> jax.Array:
    """Return the cost of a control (T, N, d) or (T, n), before scaling."""
    return cost(jc.simulate(stepper, SCALE * u), u)


def motion_part(stepper: jc.Stepper, cost: jc.TrackingCost, u: jax.Array) -> jax.Array:
    """Return the cost without the control's own part."""
    return cost(jc.simulate(stepper, SCALE * u))


value_and_grad = jax.jit(jax.value_and_grad(objective, argnums=2))
motion_gradient = jax.jit(jax.grad(motion_part, argnums=2))
