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
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact.adjoint import solve_with_adjoint
from jaxcontact.contact.complementarity import ContactSolver, Guess, Solution, Status
from jaxcontact.contact.form import ContactForm, contact_form
from jaxcontact.contact.pair_compliance import pair_compliance
from jaxcontact.contact.saddle_point import Fixed
from jaxcontact.contact.tangent import solve_forward
from jaxcontact.contact.weak import WeakContact
from jaxcontact.linear import Factor
from jaxcontact.system.rollers import hold
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix


class Bound(NamedTuple):
    """The admissible normal velocity of C pairs."""

    value: Array
    """b, (C,) [m/s]."""

    resolution: Array
    """Its rounding error, (C,) [m/s]; smaller gaps count as closed."""


class Perturbation(NamedTuple):
    """A change of one contact problem, zero but to be differentiated by; None is no change.

    In weak contact a pair has two neighbours: an open one, where the gap is free, and a closed
    one, where the impulse is free. To judge a motion from both sides, its derivative is taken with
    the weak pairs open while z stands for the multiplier that they could have:

        D w + N^T (p + z) = r,    N w <= b + e,    p . (b + e - N w) = 0,    z = e = 0.
    """

    bound: Array | None = None
    """e, added to the admissible velocity, (C,) [m/s]."""

    push: Array | None = None
    """z, (C,) [N s]; positive pushes the body away from the obstacle."""

    is_open: Array | None = None
    """Pairs that are open in the derivative, whatever their state, (C,) bool."""

    closed: Array | None = None
    """The pairs that keep contact, whatever the signs, (C,) bool: they are closed and all others
    are open, so that the solution is affine in r and b. None lets the solver find them."""


#: The contact problem itself.
NO_PERTURBATION = Perturbation()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactProblem:
    """One SPD matrix with the contact normals: all that is constant in a step's VI."""

    matrix: SymmetricMatrix
    """D, (n, n) SPD; with rollers P D P + s (I - P)."""

    normals: ContactNormals
    """N, (C, n); with rollers N P."""

    form: ContactForm
    """Factor of D and contact solver, in the form that the factor allows."""

    rollers: ContactNormals | None = None
    """Directions in which nodes are held, R of P = I - R^T R, (H, n); None is P = I."""

    perturbation: Perturbation = NO_PERTURBATION
    """What the VI is perturbed by."""

    compliance: Array | None = None
    """d = diag(N D^-1 N^T), (C,) [1/kg], differentiable; None if the law does not use it."""

    weak_contact: WeakContact | None = field(default=None, metadata={"static": True})
    """What the derivative means where a pair is in weak contact. None is Algorithm 1, by the
    `jax.custom_vjp` of the step: reverse mode. A named treatment has forward mode too."""

    @property
    def contact_solver(self) -> ContactSolver:
        """How the contact problem is solved."""
        return self.form.contact_solver

    def solve(self, rhs: Array, bound: Bound, guess: Guess) -> tuple[Array, Solution]:
        """Solve the VI.

        Args:
            rhs: r, (n,).
            bound: b with its rounding error.
            guess: where to start: `form.first_guess` or the guess of the last step's solution.

        Returns:
            w (n,), in the range of P, NaN if the problem was not solved, and the solution on the
            contact pairs.

        Derivative: reverse mode of every order, with respect to the values of the matrix and the
        normals, r and b; forward mode if `weak_contact` names a treatment. The iteration itself
        is never differentiated. A step keeps one boolean per pair for its backward pass, and w
        and p only if matrix or normals are differentiated.
        """
        rhs = hold(self.rollers, rhs)
        if self.normals.count == 0:
            return self._solve_without_contact(rhs, bound, guess)
        shift, push, is_open, closed = self.perturbation
        value = bound.value if shift is None else bound.value + shift
        if push is not None:
            rhs = rhs - self.normals.transposed_product(push, rhs.shape[0])
        fixed = Fixed(
            self.matrix.columns,
            self.normals.unknowns,
            self.form,
            bound.resolution,
            guess,
            is_open,
            closed,
        )
        data = (self.matrix.values, self.normals.weights, rhs, value, self.compliance, fixed)
        if self.weak_contact is None:
            velocity, solution = solve_with_adjoint(*data)
        else:
            velocity, solution = solve_forward(self.weak_contact, *data)
        # Multiplication poisons value and gradient alike; a `where` would leave a zero gradient.
        poison = jnp.where(solution.status <= Status.FALLBACK, 1.0, jnp.nan).astype(velocity.dtype)
        multiplier = solution.multiplier if push is None else solution.multiplier + push
        # Once more, for the error of an iterative linear solver.
        velocity = hold(self.rollers, velocity)
        return velocity * poison, solution._replace(
            multiplier=multiplier * poison,
            workspace=jax.lax.stop_gradient(solution.workspace),
            separation=value - self.normals @ velocity,
        )

    def _solve_without_contact(
        self, rhs: Array, bound: Bound, guess: Guess
    ) -> tuple[Array, Solution]:
        """Return D^-1 rhs and the solution of no pairs."""
        factor = jax.lax.stop_gradient(self.form.factor)
        velocity = jax.lax.custom_linear_solve(
            lambda w: self.matrix @ w, rhs, lambda _, r: factor.solve(r), symmetric=True
        )
        velocity = hold(self.rollers, velocity)
        is_finite = jnp.all(jnp.isfinite(velocity))
        status = jnp.where(is_finite, Status.CONVERGED, Status.NON_FINITE).astype(jnp.int32)
        zero = jnp.zeros((), rhs.dtype)
        nothing = bound.value
        return velocity, Solution(
            nothing, guess.active, jnp.int32(0), status, zero, separation=nothing
        )


def contact_problem(
    matrix: SymmetricMatrix,
    normals: ContactNormals,
    factor: Factor,
    contact_solver: ContactSolver,
    rollers: ContactNormals | None = None,
) -> ContactProblem:
    """Return the contact problem of a factorised matrix, both already of the range of P.

    Raises:
        ValueError: as `contact_form`.
    """
    form = contact_form(factor, contact_solver)
    uses_compliance = contact_solver.uses_compliance and normals.count > 0
    compliance = pair_compliance(matrix, normals, factor) if uses_compliance else None
    return ContactProblem(matrix, normals, form, rollers, compliance=compliance)
