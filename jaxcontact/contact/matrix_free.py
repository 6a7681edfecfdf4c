"""The primal-dual active set method without a condensed compliance.

The same iteration as `SemismoothNewton`, A <- {i: p_i / d_i - g_i > 0} with g = b - N w, but each
active set costs one iterative solve with the whole matrix, and d_i = (N D N^T)_ii stands for the
inverse of the compliance. For systems too large to factorise. Where the sets cycle, Murty's rule
goes on from the last one, as in `newton.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact.complementarity import (
    RELATIVE_TOLERANCE,
    ContactSolver,
    Guess,
    Solution,
    Status,
    last_of,
)
from jaxcontact.contact.newton import SETS_OF_SAFEGUARD
from jaxcontact.linear import ConstrainedFactor
from jaxcontact.system.sparse import ContactNormals


class _Search(NamedTuple):
    """The iteration over active sets."""

    active: Array
    """The next active set, (C,) bool."""

    w: Array
    """Solution on the last active set, (n,)."""

    multiplier: Array
    """Its multiplier, (C,)."""

    fewest: Array
    """Least number of pairs on the wrong side in the safeguard so far, int32."""

    is_repeated: Array
    """Whether the last active set was found again, bool."""

    steps: Array
    """Active sets so far, int32."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MatrixFreeContact:
    """A matrix that is solved with by iteration, with exact contact; see `ContactForm`."""

    factor: ConstrainedFactor
    """The matrix with its preconditioner."""

    contact_solver: ContactSolver
    """The option that was chosen."""

    max_active_sets: int = field(metadata={"static": True})
    """Active sets before a step counts as not converged."""

    @property
    def compliance_scale(self) -> Array:
        """Approximate diagonal of the compliance, (C,)."""
        return self.factor.approximate_compliance

    def first_guess(self) -> Guess:
        """Return no pair in contact."""
        return Guess(jnp.zeros(self.factor.normals.count, bool))

    def solve(
        self, rhs: Array, bound: Array, resolution: Array, guess: Guess
    ) -> tuple[Array, Solution]:
        """Solve the VI of a step; the iterations of the solution count active sets."""
        normals, compliance = self.factor.normals, self.compliance_scale
        limit = self.max_active_sets + SETS_OF_SAFEGUARD[0] + SETS_OF_SAFEGUARD[1] * bound.shape[0]
        relative_tolerance = RELATIVE_TOLERANCE[str(rhs.dtype)]

        def violation(w: Array) -> Array:
            return normals @ w - bound

        def size(w: Array, p: Array) -> Array:
            # Of N w and of what the pressure takes from it: N w of closed pairs is rounding.
            return _magnitude(normals, w) + jnp.max(compliance * jnp.abs(p), initial=0.0)

        def is_unfinished(search: _Search) -> Array:
            return ~search.is_repeated & (search.steps < limit)

        # The solver stops at a relative error, so gaps below it do not move a pair in or out.
        def advance(search: _Search) -> _Search:
            active = search.active
            w, p = self.factor.solve_constrained(active, rhs, bound)
            noise = resolution + relative_tolerance * size(w, p)
            beyond = violation(w)
            # Of pairs that depend on each other, the farther ones cannot be closed.
            stays = active & (compliance * p >= -noise) & (beyond >= -noise)
            enters = ~active & (beyond > noise)
            wrong = (stays | enters) ^ active
            steps, count = search.steps + 1, jnp.sum(wrong, dtype=jnp.int32)
            is_newton = steps < self.max_active_sets
            moved = jnp.where(is_newton | (count < search.fewest), wrong, last_of(wrong))
            fewest = jnp.where(is_newton, search.fewest, jnp.minimum(search.fewest, count))
            return _Search(active ^ moved, w, p, fewest, count == 0, steps)

        start = _Search(
            active=guess.active,
            w=jnp.zeros_like(rhs),
            multiplier=jnp.zeros_like(bound),
            fewest=jnp.int32(bound.shape[0] + 1),
            is_repeated=jnp.bool_(False),
            steps=jnp.int32(0),
        )
        active, w, p, _, is_repeated, steps = jax.lax.while_loop(is_unfinished, advance, start)

        scale = size(w, p) + resolution / relative_tolerance
        # Clipping a multiplier within the noise changes the balance of forces by as little.
        clipped = jnp.maximum(p, 0.0)
        error = jnp.abs(jnp.minimum(compliance * clipped, -violation(w)))
        residual = jnp.max(error / jnp.maximum(scale, jnp.finfo(rhs.dtype).tiny))
        is_finite = jnp.all(jnp.isfinite(w)) & jnp.all(jnp.isfinite(p))
        is_solved = is_repeated & (residual <= 4.0 * relative_tolerance)
        status = jnp.where(steps > self.max_active_sets, Status.FALLBACK, Status.CONVERGED)
        status = jnp.where(is_solved, status, Status.NOT_CONVERGED)
        status = jnp.where(is_finite, status, Status.NON_FINITE).astype(jnp.int32)
        is_closed = active | (-violation(w) <= relative_tolerance * scale)
        return w, Solution(clipped, is_closed, steps, status, residual)

    def solve_on_set(
        self, pairs: Array, softness: Array | None, rhs: Array, bound: Array
    ) -> tuple[Array, Array]:
        """Solve the linear problem of known pairs; the contact is exact, softness is not read."""
        del softness
        w, p = self.factor.solve_constrained(pairs, rhs, bound)
        return w, jnp.where(pairs, p, bound)


def _magnitude(normals: ContactNormals, w: Array) -> Array:
    """Return the size of the terms of N w, a scalar: its rounding error is relative to it."""
    return jnp.max(jnp.sum(jnp.abs(normals.weights * w[normals.unknowns]), axis=1))
