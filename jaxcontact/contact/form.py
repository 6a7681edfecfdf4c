"""The two forms in which a contact problem is solved, and which of them a factor allows.

Condensed: the factor gives the compliance W = N D^-1 N^T, and the contact solver works on C pairs.
Matrix-free: nothing is factorised, and every active set costs one iterative solve with D.
"""

from __future__ import annotations

from typing import Protocol

from jax import Array

from jaxcontact.contact.complementarity import ContactSolver, Guess, Solution
from jaxcontact.contact.condensed import CondensedContact
from jaxcontact.contact.matrix_free import MatrixFreeContact
from jaxcontact.linear import Factor, can_condense


class ContactForm(Protocol):
    """A factor with a contact solver, a pytree: solves the VI of a step and its linearisation."""

    @property
    def factor(self) -> Factor:
        """The factor of D."""
        ...

    @property
    def contact_solver(self) -> ContactSolver:
        """The law of contact and how it is solved."""
        ...

    @property
    def compliance_scale(self) -> Array:
        """Size of the compliance of each pair, (C,); a scale, it enters no solution."""
        ...

    def first_guess(self) -> Guess:
        """Return where the first step starts: no pair is in contact."""
        ...

    def solve(
        self, rhs: Array, bound: Array, resolution: Array, guess: Guess
    ) -> tuple[Array, Solution]:
        """Solve the VI of a step, see `ContactProblem.solve`; w (n,) and the solution."""
        ...

    def solve_on_set(
        self, pairs: Array, softness: Array | None, rhs: Array, bound: Array
    ) -> tuple[Array, Array]:
        """Solve with (N w - softness p)_i = bound_i on the pairs and p_i = bound_i elsewhere.

        Args:
            pairs: (C,) bool.
            softness: (C,), or None for zero.
            rhs: r, (n,).
            bound: b, (C,).

        Returns:
            w (n,) with D w + N^T p = r for the p of the pairs, and p (C,).
        """
        ...


def contact_form(factor: Factor, contact_solver: ContactSolver) -> ContactForm:
    """Return the form that a factor allows.

    Raises:
        ValueError: if the contact cannot be condensed and the contact solver needs that, or a
            number of the contact solver is out of its range.
    """
    contact_solver.check()
    if can_condense(factor):
        return CondensedContact(factor, contact_solver)
    max_active_sets = contact_solver.max_active_sets
    if max_active_sets is None:
        raise ValueError(
            f"contact_solver={contact_solver!r} works on the condensed compliance, which conjugate "
            "gradients do not form; prepare with contact_solver=jc.SemismoothNewton() or with "
            "linear_solver=jc.NestedDissection()"
        )
    return MatrixFreeContact(factor, contact_solver, max_active_sets)
