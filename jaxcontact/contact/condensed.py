"""The contact problem condensed to its pairs: one sweep over the factor, one small problem.

With W = N D^-1 N^T and the free velocity N D^-1 r, find p of 0 <= p _|_ W p + b - N D^-1 r >= 0
between the sweep up and the sweep down; w = D^-1 (r - N^T p). Source: MATH.md 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import complementarity
from jaxcontact.contact.complementarity import ContactSolver, Guess, Solution
from jaxcontact.linear import CondensingFactor


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CondensedContact:
    """A factor that knows its compliance, with any contact solver; see `ContactForm`."""

    factor: CondensingFactor
    """Factor of D with the contact rows condensed."""

    contact_solver: ContactSolver
    """Solves the problem of C pairs."""

    @property
    def compliance_scale(self) -> Array:
        """Diagonal of W, (C,)."""
        return jnp.diagonal(self.factor.compliance)

    def first_guess(self) -> Guess:
        """Return no pair in contact, and what the contact solver keeps between steps."""
        compliance = self.factor.compliance
        nothing = jnp.zeros(compliance.shape[0], bool)
        if nothing.size == 0:
            return Guess(nothing)
        return Guess(nothing, self.contact_solver.first_workspace(compliance))

    def solve(
        self, rhs: Array, bound: Array, resolution: Array, guess: Guess
    ) -> tuple[Array, Solution]:
        """Solve the VI of a step; see `ContactForm.solve`."""
        partial_sweep, free = self.factor.condense(rhs)
        solution = self.contact_solver.solve(
            self.factor.compliance, bound - free, resolution, guess
        )
        return self.factor.expand(partial_sweep, solution.multiplier), solution

    def solve_on_set(
        self, pairs: Array, softness: Array | None, rhs: Array, bound: Array
    ) -> tuple[Array, Array]:
        """Solve the linear problem of known pairs; see `ContactForm.solve_on_set`."""
        partial_sweep, free = self.factor.condense(rhs)
        p = complementarity.solve_compliance(
            self.factor.compliance, pairs, softness, jnp.where(pairs, free - bound, bound)
        )
        return self.factor.expand(partial_sweep, jnp.where(pairs, p, 0.0)), p
