"""The contact variational inequality of one step, and its derivative on the critical cone.

Find the velocity w and the multiplier p >= 0 with

    D w + N^T p = r,    N w <= b,    p . (b - N w) = 0,

which is the minimum of w.Dw/2 - r.w over {N w <= b}; every time-stepping scheme is made of such
problems. With the active set A held fixed the solution is linear in (r, b), so that both the
derivative and its transpose are the same symmetric saddle-point problem (4.40)-(4.41),

    D dw + N^T dp = dr,    (N dw - s dp)_i = db_i on A,    dp_i = 0 elsewhere,

with s = 0 for exact contact. It is solved by the factor of the forward step: `adjoint.py` makes
it the backward pass of a `jax.custom_vjp`, `tangent.py` the forward mode. Where weak contact is
present the problem is not differentiable, and `weak.py` names the choices of A.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact.adjoint import solve_with_adjoint
from jaxcontact.contact.complementarity import ContactSolver, Guess, Solution, Status
from jaxcontact.contact.saddle_point import Fixed
from jaxcontact.contact.tangent import solve_forward
from jaxcontact.contact.weak import WeakContact
from jaxcontact.linear import can_condense
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactProblem:
    """One SPD matrix with the contact normals: all that is constant in a step's VI."""

    matrix: SymmetricMatrix
    """D, (n, n) SPD."""

    normals: ContactNormals
    """N, (C, n)."""

    factor: Any
    """Factor of D, see `linear.Factor`."""

    contact_solver: ContactSolver
    """How the condensed problem is solved."""

    weak_contact: WeakContact | None = field(default=None, metadata={"static": True})
    """What the derivative means where a pair is in weak contact. None is Algorithm 1, by the
    `jax.custom_vjp` of the step: reverse mode. A named treatment has forward mode too."""

    def first_guess(self) -> Guess:
        """Return where the first step starts: no pair is in contact."""
        nothing = jnp.zeros(self.normals.count, bool)
        if self.normals.count == 0 or not can_condense(self.factor):
            return Guess(nothing)
        return Guess(nothing, self.contact_solver.first_memory(self.factor.compliance))

    def solve(
        self, rhs: Array, bound: Array, resolution: Array, guess: Guess
    ) -> tuple[Array, Solution]:
        """Solve the VI.

        Args:
            rhs: r, (n,).
            bound: b, (C,); the admissible normal velocity.
            resolution: rounding error of the bound, (C,); smaller gaps count as closed.
            guess: where to start: `first_guess` or the guess of the last step's solution.

        Returns:
            w (n,), NaN if the problem was not solved, and the solution on the contact pairs.

        Derivative: reverse mode of every order, with respect to the values of the matrix and the
        normals, r and b; forward mode if `weak_contact` names a treatment. The iteration itself
        is never differentiated. A step keeps one boolean per pair for its backward pass, and w
        and p only if matrix or normals are differentiated.
        """
        if self.normals.count == 0:
            velocity = _solve_linear(self, rhs)
            is_finite = jnp.all(jnp.isfinite(velocity))
            status = jnp.where(is_finite, Status.CONVERGED, Status.NON_FINITE).astype(jnp.int32)
            zero = jnp.zeros((), rhs.dtype)
            return velocity, Solution(bound, guess.active, jnp.int32(0), status, zero)
        fixed = Fixed(
            self.matrix.columns,
            self.normals.unknowns,
            self.factor,
            resolution,
            guess,
            self.contact_solver,
        )
        data = (self.matrix.values, self.normals.weights, rhs, bound, fixed)
        if self.weak_contact is None:
            velocity, solution = solve_with_adjoint(*data)
        else:
            velocity, solution = solve_forward(self.weak_contact, *data)
        # Multiplication poisons value and gradient alike; a `where` would leave a zero gradient.
        poison = jnp.where(solution.status <= Status.FALLBACK, 1.0, jnp.nan).astype(velocity.dtype)
        return velocity * poison, solution._replace(
            multiplier=solution.multiplier * poison,
            memory=jax.lax.stop_gradient(solution.memory),
        )


def _solve_linear(problem: ContactProblem, rhs: Array) -> Array:
    """Return D^-1 rhs for a body without contact pairs."""
    factor = jax.lax.stop_gradient(problem.factor)
    return jax.lax.custom_linear_solve(
        lambda w: problem.matrix @ w, rhs, lambda _, r: factor.solve(r), symmetric=True
    )
