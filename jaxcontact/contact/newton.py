"""Semismooth Newton for the contact problem of one step: the primal-dual active set method.

On the active set A:  (W p + q)_A = 0,  p = 0 elsewhere;   A <- {i: W_ii p_i - (W p + q)_i > 0},
until A repeats. Source: Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2003). Finite on every
problem seen in time stepping, but it may cycle for a general SPD compliance; projected
Gauss-Seidel then takes over.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import complementarity, gauss_seidel
from jaxcontact.contact.complementarity import Solution, separation, solve_on_set


@jax.tree_util.register_static
@dataclass(frozen=True)
class SemismoothNewton:
    """Primal-dual active set method, warm-started with the active set of the last step."""

    max_steps: int = 30
    """Number of active sets before the safeguard takes over."""

    max_sweeps: int = 20_000
    """Gauss-Seidel sweeps of the safeguard before a step ends as not converged."""

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Array) -> Solution:
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
            _, _, is_repeated, steps = carry
            return ~is_repeated & (steps < self.max_steps)

        def advance(carry):
            active, _, _, steps = carry
            p = solve_on_set(compliance, active, None, jnp.where(active, -offset, 0.0))
            following = next_set(active, p)
            return following, p, jnp.all(following == active), steps + 1

        start = (guess, jnp.zeros_like(offset), jnp.bool_(False), jnp.int32(0))
        _, p, is_repeated, steps = jax.lax.while_loop(is_unfinished, advance, start)
        p = jnp.maximum(p, 0.0)

        # Without a cycle the budget of sweeps is zero and the safeguard costs nothing.
        goal = 0.01 * complementarity.tolerance(offset, resolution) + 0.1 * resolution
        budget = jnp.where(is_repeated, 0, self.max_sweeps)
        p, _ = gauss_seidel.iterate(compliance, offset, p, goal, budget)
        return complementarity.finish(compliance, offset, resolution, p, steps, ~is_repeated)

    def softness(self, solution_multiplier: Array, separation: Array) -> None:
        """Return None: contact is exact."""
