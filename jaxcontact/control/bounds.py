"""Box bounds: the free variables and the projected line.

The bounded problem  min J(p), l <= p <= u  is stationary where p = P(p - G). Methods work on the
variables that are free, i.e. not held at a bound by the sign of the gradient, and search along
the projected line t -> P(p + t d). Where d points out of the box at a bound although the gradient
points in, the projection only removes terms dJ_i d_i >= 0 from the slope, so d stays a direction
of descent. Source: Bertsekas, Projected Newton methods, SIAM J. Control Optim. 20 (1982).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

Bounds = tuple[Array, Array] | None


def free_variables(bounds: Bounds, parameters: Array, derivative: Array) -> Array | None:
    """Return where a variable may move, bool; None if there are no bounds."""
    return None if bounds is None else _free_variables(bounds, parameters, derivative)


@jax.jit
def _free_variables(bounds, parameters, derivative):
    lower, upper = bounds
    held = ((parameters <= lower) & (derivative > 0)) | ((parameters >= upper) & (derivative < 0))
    return ~held


def mask(free: Array | None, vector: Array) -> Array:
    """Return the vector with zeros on the variables that are held."""
    return vector if free is None else jnp.where(free, vector, 0.0)


@jax.jit
def move(
    bounds: Bounds, parameters: Array, direction: Array, step: float | Array
) -> tuple[Array, Array]:
    """Return P(p + t d) and the direction d where the projection does not hold it, for t > 0."""
    target = parameters + step * direction
    if bounds is None:
        return target, direction
    projected = jnp.clip(target, *bounds)
    return projected, jnp.where(projected == target, direction, 0.0)
