"""The primal-dual active set method without a condensed compliance.

The same iteration as `SemismoothNewton`, A <- {i: p_i / d_i - g_i > 0} with g = b - N w, but each
active set costs one iterative solve with the whole matrix, and d_i = (N D N^T)_ii stands for the
inverse of the compliance. For systems too large to factorise.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact.complementarity import (
    RELATIVE_TOLERANCE,
    Solution,
    Status,
)
from jaxcontact.linear import ConstrainedFactor
from jaxcontact.system.sparse import ContactNormals


def solve_contact(
    factor: ConstrainedFactor,
    max_steps: int,
    rhs: Array,
    bound: Array,
    resolution: Array,
    guess: Array,
) -> tuple[Array, Solution]:
    """Solve the VI of a step by active sets and conjugate gradients.

    Args:
        factor: the matrix with its preconditioner.
        max_steps: number of active sets before the step counts as not converged.
        rhs: r, (n,).
        bound: b, (C,).
        resolution: rounding error of the bound, (C,).
        guess: active set to start from, (C,) bool.

    Returns:
        w (n,) and the solution on the contact pairs; the iterations count active sets.
    """
    normals = factor.normals
    # Approximate compliance, for scaling only: it does not enter the solution.
    compliance = factor.approximate_compliance

    def violation(w: Array) -> Array:
        return normals @ w - bound

    def is_unfinished(carry):
        _, _, _, is_repeated, steps = carry
        return ~is_repeated & (steps < max_steps)

    # The solver stops at a relative error, so gaps below it do not move a pair in or out.
    def advance(carry):
        active, _, _, _, steps = carry
        w, p = factor.solve_constrained(active, rhs, bound)
        noise = resolution + RELATIVE_TOLERANCE[str(rhs.dtype)] * _magnitude(normals, w)
        stays = active & (compliance * p >= -noise)
        enters = ~active & (violation(w) > noise)
        following = stays | enters
        return following, w, p, jnp.all(following == active), steps + 1

    start = (guess, jnp.zeros_like(rhs), jnp.zeros_like(bound), jnp.bool_(False), jnp.int32(0))
    active, w, p, is_repeated, steps = jax.lax.while_loop(is_unfinished, advance, start)

    relative_tolerance = RELATIVE_TOLERANCE[str(rhs.dtype)]
    scale = _magnitude(normals, w) + resolution / relative_tolerance
    # Clipping a multiplier within the noise changes the balance of forces by as little.
    clipped = jnp.maximum(p, 0.0)
    error = jnp.abs(jnp.minimum(compliance * clipped, -violation(w)))
    residual = jnp.max(error / jnp.maximum(scale, jnp.finfo(rhs.dtype).tiny))
    is_finite = jnp.all(jnp.isfinite(w)) & jnp.all(jnp.isfinite(p))
    is_solved = is_repeated & (residual <= 4.0 * relative_tolerance)
    status = jnp.where(is_solved, Status.CONVERGED, Status.NOT_CONVERGED)
    status = jnp.where(is_finite, status, Status.NON_FINITE).astype(jnp.int32)
    is_closed = active | (-violation(w) <= relative_tolerance * scale)
    return w, Solution(clipped, is_closed, steps, status, residual)


def _magnitude(normals: ContactNormals, w: Array) -> Array:
    """Return the size of the terms of N w, a scalar: its rounding error is relative to it."""
    return jnp.max(jnp.sum(jnp.abs(normals.weights * w[normals.unknowns]), axis=1))
