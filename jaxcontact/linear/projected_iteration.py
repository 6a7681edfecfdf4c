"""Preconditioned conjugate gradients in the range of a projection, with the sizes of all terms.

Solves P D z = rest, z in the range of P^T, for an SPD matrix D and a projection P that is
orthogonal in the norm of the diagonal preconditioner M^-1. The M-norms of z and of the direction
follow from running scalars, because the scaled residual is M-orthogonal to z and to the old
direction.

Source: Hestenes, Stiefel (1952); Gould, Hribar, Nocedal, SIAM J. Sci. Comput. 23 (2001); running
norms: Steihaug, SIAM J. Numer. Anal. 20 (1983).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class Iterate(NamedTuple):
    """The solution so far, and where it moves next."""

    z: Array
    """Solution so far, (n,), in the range of P^T."""

    residual: Array
    """P (rest - D z) by recurrence, (n,)."""

    direction: Array
    """Next direction d, conjugate to all before, (n,)."""

    residual_square: Array
    """residual^T M^-1 residual, scalar."""

    size_square: Array
    """z^T M z, scalar."""

    overlap: Array
    """z^T M d, scalar; never negative, so that z grows."""

    direction_square: Array
    """d^T M d, scalar."""

    steps: Array
    """Iterations so far, () int32."""


def iterate(
    multiply: Callable[[Array], Array],
    preconditioner: Array,
    rest: Array,
    goal: Callable[[Array], Array],
    max_iterations: int,
) -> tuple[Array, Array]:
    """Run the iteration from zero until the residual is below the goal.

    Args:
        multiply: maps x (n,) to P D x.
        preconditioner: diagonal of M^-1, (n,).
        rest: right-hand side, (n,), in the range of P.
        goal: maps sqrt(z^T M z) to the sqrt(residual^T M^-1 residual) that is small enough.
        max_iterations: iterations after which it gives up.

    Returns:
        z (n,), and whether the residual is below the goal, () bool; False if D is not SPD.
    """

    def is_small(now: Iterate) -> Array:
        return now.residual_square <= goal(jnp.sqrt(now.size_square)) ** 2

    def is_unfinished(now: Iterate) -> Array:
        is_finite = jnp.isfinite(now.residual_square)
        return ~is_small(now) & is_finite & (now.steps < max_iterations)

    def advance(now: Iterate) -> Iterate:
        image = multiply(now.direction)
        curvature = jnp.vdot(now.direction, image)
        # Without positive curvature D is not positive definite: NaN ends the iteration.
        step = jnp.where(curvature > 0.0, now.residual_square / curvature, jnp.nan)
        residual = now.residual - step * image
        scaled = preconditioner * residual
        residual_square = jnp.vdot(residual, scaled)
        turn = residual_square / now.residual_square
        overlap = now.overlap + step * now.direction_square  # of the new z and the old direction
        return Iterate(
            z=now.z + step * now.direction,
            residual=residual,
            direction=scaled + turn * now.direction,
            residual_square=residual_square,
            size_square=now.size_square + step * (now.overlap + overlap),
            overlap=turn * overlap,
            direction_square=residual_square + turn**2 * now.direction_square,
            steps=now.steps + 1,
        )

    scaled = preconditioner * rest
    square = jnp.vdot(rest, scaled)
    zero = jnp.zeros_like(square)
    start = Iterate(jnp.zeros_like(rest), rest, scaled, square, zero, zero, square, jnp.int32(0))
    end = jax.lax.while_loop(is_unfinished, advance, start)
    return end.z, is_small(end)
