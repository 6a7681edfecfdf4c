"""The Courant number: how many cells a wave passes in a time step."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from jaxcontact.system.system import System


def courant_number(system: System, dt: float | Array) -> Array:
    """Return the largest c dt / h of the cells, scalar; exact for a uniform bar.

    From the diagonals of stiffness and mass, 2 E / h and 2 rho h / 3 in a bar.

    Args:
        system: the discretised scene, not a reduced one.
        dt: length of a time step, [s].
    """
    return dt * jnp.sqrt(jnp.max(system.stiffness.diagonal() / system.mass.diagonal()) / 3.0)
