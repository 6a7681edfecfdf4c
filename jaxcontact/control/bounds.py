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
import numpy as np
from jax import Array
from jax.core import Tracer
from numpy.typing import ArrayLike

#: Lower and upper bound as a user gives them: numbers or arrays that broadcast.
BoundsLike = tuple[ArrayLike, ArrayLike]

#: Both bounds in the shape of the parameters, or None.
Bounds = tuple[Array, Array] | None


def make_bounds(bounds: BoundsLike | None, start: Array) -> Bounds:
    """Return both bounds in shape and type of the start.

    Raises:
        ValueError: if the bounds are no pair, do not fit the start, or cross.
    """
    if bounds is None:
        return None
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError("bounds must be a pair (lower, upper) of numbers or arrays")
    for bound in bounds:
        shape = np.shape(bound)
        fits = all(n in (1, m) for n, m in zip(shape[::-1], start.shape[::-1], strict=False))
        if len(shape) > start.ndim or not fits:
            raise ValueError(
                f"a bound of shape {shape} does not fit what is optimised, {start.shape}"
            )
    if not any(isinstance(bound, Tracer) for bound in bounds):
        n_crossed = int(np.sum(~(np.asarray(bounds[0]) <= np.asarray(bounds[1]))))
        if n_crossed:
            raise ValueError(f"{n_crossed} lower bounds are above their upper bounds or NaN")
    lower, upper = (jnp.broadcast_to(jnp.asarray(b, start.dtype), start.shape) for b in bounds)
    return lower, upper


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
