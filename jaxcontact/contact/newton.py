"""Semismooth Newton for the contact problem of one step: the primal-dual active set method.

On the active set A:  (W p + q)_A = 0,  p = 0 elsewhere;   A <- {i: W_ii p_i - (W p + q)_i > 0},
until A repeats. Finite on every problem seen in time stepping, but it may cycle for a general SPD
compliance; projected Gauss-Seidel then takes over. Source: Hintermueller, Ito, Kunisch, SIAM J.
Optim. 13 (2003).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import complementarity, gauss_seidel, pivoting
from jaxcontact.contact.complementarity import Guess, Solution, separation
from jaxcontact.contact.pivoting import PivotedCompliance


@jax.tree_util.register_static
@dataclass(frozen=True)
class SemismoothNewton:
    """Primal-dual active set method, warm-started with active set and factor of the last step."""

    max_steps: int = 30
    """Number of active sets before the safeguard takes over."""

    max_sweeps: int = 20_000
    """Gauss-Seidel sweeps of the safeguard before a step ends as not converged."""

    def first_memory(self, compliance: Array) -> PivotedCompliance:
        """Return the compliance, which each step solves for its active set and hands on."""
        return pivoting.unpivoted(compliance)

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Guess) -> Solution:
        """Solve the complementarity problem; see `ContactSolver.solve`."""
        diagonal = jnp.diagonal(compliance)

        def next_set(active, p):
            # Values below the rounding error of the gap do not move a pair in or out: otherwise
            # a pair at rest would flip for ever.
            g = separation(compliance, offset, p)
            stays = active & (diagonal * p >= -resolution)
            enters = ~active & (g < -resolution)
            return stays | enters

        def is_unfinished(carry):
            _, _, _, is_repeated, steps = carry
            return ~is_repeated & (steps < self.max_steps)

        def advance(carry):
            active, pivoted, _, _, steps = carry
            pivoted = pivoting.pivot(pivoted, compliance, active)
            p, pivoted = pivoting.solve(pivoted, compliance, offset)
            following = next_set(active, p)
            is_repeated = jnp.all(following == active) & (pivoted.exchanges < pivoting.WORN)
            return following, pivoted, p, is_repeated, steps + 1

        active, pivoted = guess
        pivoted = pivoted if pivoted else self.first_memory(compliance)
        start = (active, pivoted, jnp.zeros_like(offset), jnp.bool_(False), jnp.int32(0))
        _, pivoted, p, is_repeated, steps = jax.lax.while_loop(is_unfinished, advance, start)
        p = jnp.maximum(p, 0.0)

        # Without a cycle the budget of sweeps is zero and the safeguard costs nothing.
        goal = 0.01 * complementarity.tolerance(offset, resolution) + 0.1 * resolution
        budget = jnp.where(is_repeated, 0, self.max_sweeps)
        p, _ = gauss_seidel.iterate(compliance, offset, p, goal, budget)
        solution = complementarity.finish(compliance, offset, resolution, p, steps, ~is_repeated)
        return solution._replace(memory=pivoted)

    def softness(self, solution_multiplier: Array, separation: Array) -> None:
        """Return None: contact is exact."""
