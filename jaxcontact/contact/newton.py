"""Semismooth Newton for the contact problem of one step: the primal-dual active set method.

On the active set A:  (W p + q)_A = 0,  p = 0 elsewhere;   A <- {i: W_ii p_i - (W p + q)_i > 0},
until A repeats. Finite on every problem seen in time stepping, but it may cycle for a general SPD
compliance. Then pairs are moved one at a time, and all together again whenever fewer have a wrong
sign than ever before, which is finite; projected Gauss-Seidel takes over if rounding prevents even
that. Source: Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2003); Judice, Pires, Computers Ops
Res. 21 (1994) 587-596.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import complementarity, gauss_seidel, pivoting
from jaxcontact.contact.complementarity import Guess, Solution, last_of, separation
from jaxcontact.contact.pivoting import PivotedCompliance

#: Sets of the safeguard: so many, and so many more for each pair.
SETS_OF_SAFEGUARD = (50, 10)


class _Search(NamedTuple):
    """The iteration over active sets."""

    active: Array
    """The next active set, (C,) bool."""

    pivoted: PivotedCompliance
    """The compliance solved for the last one."""

    multiplier: Array
    """p on the last one, (C,)."""

    fewest: Array
    """Fewest pairs with a wrong sign since pairs are moved one at a time, int32."""

    is_repeated: Array
    """Whether the last active set was found again, bool."""

    steps: Array
    """Active sets so far, int32."""


@jax.tree_util.register_static
@dataclass(frozen=True)
class SemismoothNewton:
    """Primal-dual active set method, warm-started with active set and factor of the last step."""

    max_steps: int = 30
    """Number of active sets before pairs are moved one at a time."""

    max_sweeps: int = 20_000
    """Gauss-Seidel sweeps, if that did not help either, before a step ends as not converged."""

    is_exact: ClassVar[bool] = True
    uses_compliance: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check the options, which are never traced.

        Raises:
            ValueError: if no active set is allowed, or a negative number of sweeps.
        """
        if self.max_steps < 1:
            raise ValueError(
                f"SemismoothNewton.max_steps must be 1 or more, got {self.max_steps}; leave it out "
                "for 30"
            )
        if self.max_sweeps < 0:
            raise ValueError(
                f"SemismoothNewton.max_sweeps must not be negative, got {self.max_sweeps}; 0 is "
                "no sweeps, leave it out for 20000"
            )

    @property
    def max_active_sets(self) -> int:
        """The same number where contact cannot be condensed."""
        return self.max_steps

    def check(self) -> None:
        """Do nothing: what holds no array is checked when it is made."""

    def first_workspace(self, compliance: Array) -> PivotedCompliance:
        """Return the compliance, which each step solves for its active set and hands on."""
        return pivoting.unpivoted(compliance)

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Guess) -> Solution:
        """Solve the complementarity problem; see `ContactSolver.solve`."""
        diagonal = jnp.diagonal(compliance)

        def next_set(active: Array, p: Array) -> Array:
            # Values below the rounding error of the gap do not move a pair in or out: otherwise
            # a pair at rest would flip for ever.
            g = separation(compliance, offset, p)
            stays = active & (diagonal * p >= -resolution)
            enters = ~active & (g < -resolution)
            return stays | enters

        limit = self.max_steps + SETS_OF_SAFEGUARD[0] + SETS_OF_SAFEGUARD[1] * offset.shape[0]

        def is_unfinished(search: _Search) -> Array:
            return ~search.is_repeated & (search.steps < limit)

        def advance(search: _Search) -> _Search:
            active, steps = search.active, search.steps + 1
            pivoted = pivoting.pivot(search.pivoted, compliance, active)
            p, pivoted = pivoting.solve(pivoted, compliance, offset)
            # A worn transform says nothing: the same set once more, with a new one.
            is_worn = pivoted.exchanges >= pivoting.WORN
            wrong = (next_set(active, p) ^ active) & ~is_worn
            count = jnp.sum(wrong, dtype=jnp.int32)
            is_newton = steps < self.max_steps
            moved = jnp.where(is_newton | (count < search.fewest), wrong, last_of(wrong))
            fewest = jnp.where(
                is_newton | is_worn, search.fewest, jnp.minimum(search.fewest, count)
            )
            is_repeated = (count == 0) & ~is_worn
            return _Search(active ^ moved, pivoted, p, fewest, is_repeated, steps)

        active, pivoted = guess
        pivoted = pivoted if pivoted else self.first_workspace(compliance)
        start = _Search(
            active=active,
            pivoted=pivoted,
            multiplier=jnp.zeros_like(offset),
            fewest=jnp.int32(offset.shape[0] + 1),
            is_repeated=jnp.bool_(False),
            steps=jnp.int32(0),
        )
        _, pivoted, p, _, is_repeated, steps = jax.lax.while_loop(is_unfinished, advance, start)
        p = jnp.maximum(p, 0.0)

        # Where all is well no sweep is made, and the safeguard costs one residual.
        tolerance = complementarity.tolerance(offset, resolution)
        goal = jnp.where(is_repeated, tolerance, 0.01 * tolerance + 0.1 * resolution)
        clean = jnp.where(jnp.all(jnp.isfinite(p)), p, 0.0)
        p, sweeps = gauss_seidel.iterate(compliance, offset, clean, goal, self.max_sweeps)
        is_fallback = (sweeps > 0) | (steps > self.max_steps)
        solution = complementarity.finish(compliance, offset, resolution, p, steps, is_fallback)
        return solution._replace(workspace=pivoted)

    def softness(self, compliance: Array | None, multiplier: Array) -> Array:
        """Return zero: contact is rigid."""
        return jnp.zeros_like(multiplier)
