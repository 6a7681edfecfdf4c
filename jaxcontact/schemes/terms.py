"""Terms that the schemes share: the viscous loss of a step and the rounding error of a gap."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.system.system import System


def viscous_loss(system: System, dt: Array, increment: Array) -> Array:
    """Return tau w.Bw, the energy [J] that the viscosity takes from the increment tau w (n,)."""
    if system.viscosity is None:
        return jnp.zeros((), increment.dtype)
    return jnp.dot(increment, system.viscosity @ increment) / dt


def gap_resolution(system: System, y: Array) -> Array:
    """Return the rounding error of the gap psi - N y, (C,) [m]: a smaller gap is closed."""
    normal_displacement = jnp.abs(system.normals.weights * y[system.normals.unknowns]).sum(axis=1)
    magnitude = jnp.abs(system.gap) + normal_displacement
    return jax.lax.stop_gradient(4.0 * jnp.finfo(y.dtype).eps * magnitude)
