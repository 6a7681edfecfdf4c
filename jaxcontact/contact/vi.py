"""The contact variational inequality of one step, and its derivative on the critical cone.

Find the velocity w and the multiplier p >= 0 with

    D w + N^T p = r,    N w <= b,    p . (b - N w) = 0,

which is the minimum of w.Dw/2 - r.w over {N w <= b}; every time-stepping scheme is made of such
problems. With the active set A held fixed the solution is linear in (r, b), so that both the
derivative and its transpose are the same symmetric saddle-point problem (4.40)-(4.41),

    D dw + N^T dp = dr,    (N dw - s dp)_i = db_i on A,    dp_i = 0 elsewhere,

with s = 0 for exact contact. It is solved by the factor of the forward step. Where weak contact is
present the problem is not differentiable: `weak.py` names the choices of A, and `critical_cone.py`
solves for the one-sided derivative.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from jaxcontact.contact import critical_cone, matrix_free
from jaxcontact.contact.complementarity import (
    ContactSolver,
    Solution,
    Status,
)
from jaxcontact.contact.forward_only import forward_only
from jaxcontact.contact.saddle_point import Fixed, solve_on_cone
from jaxcontact.contact.weak import CriticalCone, OnBranch, Strong, WeakContact
from jaxcontact.linear.conjugate_gradient import IterativeFactor
from jaxcontact.sparse import ContactNormals, SymmetricMatrix


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

    weak_contact: WeakContact = field(default=Strong(), metadata={"static": True})
    """What the derivative means where a pair is in weak contact."""

    def solve(
        self, rhs: Array, bound: Array, resolution: Array, guess: Array
    ) -> tuple[Array, Solution]:
        """Solve the VI.

        Args:
            rhs: r, (n,).
            bound: b, (C,); the admissible normal velocity.
            resolution: rounding error of the bound, (C,); smaller gaps count as closed.
            guess: active set to start from, (C,) bool.

        Returns:
            w (n,), NaN if the problem was not solved, and the solution on the contact pairs.

        Derivative: forward and reverse mode of every order, with respect to the values of the
        matrix and the normals, r and b; see `weak_contact`. The iteration itself is never
        differentiated. A step keeps one boolean per pair for its backward pass, and w and p only
        if matrix or normals are differentiated.
        """
        if self.normals.count == 0:
            velocity = _solve_linear(self, rhs)
            is_finite = jnp.all(jnp.isfinite(velocity))
            status = jnp.where(is_finite, Status.CONVERGED, Status.NON_FINITE).astype(jnp.int32)
            return velocity, Solution(bound, guess, jnp.int32(0), status, jnp.zeros((), rhs.dtype))
        fixed = Fixed(
            self.matrix.columns,
            self.normals.unknowns,
            self.factor,
            resolution,
            guess,
            self.contact_solver,
        )
        velocity, solution = _solve(
            self.weak_contact,
            self.matrix.values,
            self.normals.weights,
            rhs,
            bound,
            fixed,
        )
        # Multiplication poisons value and gradient alike; a `where` would leave a zero gradient.
        poison = jnp.where(solution.status <= Status.FALLBACK, 1.0, jnp.nan)
        return velocity * poison.astype(velocity.dtype), solution


def _solve_linear(problem: ContactProblem, rhs: Array) -> Array:
    """Return D^-1 rhs for a body without contact pairs."""
    factor = jax.lax.stop_gradient(problem.factor)
    return jax.lax.custom_linear_solve(
        lambda w: problem.matrix @ w, rhs, lambda _, r: factor.solve(r), symmetric=True
    )


# Invariant: the rule is linear in the tangents (but for CriticalCone), and the linear problem is
# symmetric, so that JAX transposes it to the adjoint (4.40)-(4.41) with the same factor.
@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(
    weak_contact: WeakContact,
    values: Array,
    weights: Array,
    rhs: Array,
    bound: Array,
    fixed: Fixed,
) -> tuple[Array, Solution]:
    """Solve the VI; see `ContactProblem.solve`."""
    del weak_contact
    contact_solver, factor = fixed.contact_solver, fixed.factor
    if isinstance(factor, IterativeFactor):
        if not _is_exact(contact_solver, bound):
            raise ValueError(
                f"ConjugateGradient cannot solve {type(contact_solver).__name__}; prepare with "
                "another linear_solver, such as jc.NestedDissection()"
            )
        return matrix_free.solve_contact(
            factor, contact_solver.max_steps, rhs, bound, fixed.resolution, fixed.guess
        )
    partial_sweep, free = factor.condense(rhs)
    solution = contact_solver.solve(factor.compliance, bound - free, fixed.resolution, fixed.guess)
    return factor.expand(partial_sweep, solution.multiplier), solution


@partial(_solve.defjvp, symbolic_zeros=True)
def _solve_jvp(weak_contact, primals, tangents):
    values, weights, _, bound, fixed = primals
    if isinstance(weak_contact, OnBranch) and _is_exact(fixed.contact_solver, bound):
        # AlongDirection moves loads and states, neither matrices nor normals.
        direction = jax.lax.stop_gradient((_instantiate(tangents[2]), _instantiate(tangents[3])))
        (w, solution), (w_dot, p_dot) = _solve_on_branch(*primals, direction)
        return (w, solution), (w_dot, _tangent(solution, p_dot))
    w, solution = _solve(weak_contact, *primals)
    softness = fixed.contact_solver.softness(
        solution.multiplier, bound - ContactNormals(weights, fixed.unknowns) @ w
    )
    data_dot = _linearized_data(fixed, w, solution.multiplier, tangents)
    if softness is None and isinstance(weak_contact, CriticalCone):
        w_dot, p_dot = _solve_critical_cone(values, weights, fixed, solution, *data_dot)
        w_dot, p_dot = forward_only(w_dot), forward_only(p_dot)
    else:
        pairs = solution.active
        if softness is not None:
            # Infinitely soft pairs are open; a product with infinity would be NaN.
            pairs = jnp.isfinite(softness)
            softness = jnp.where(pairs, softness, 0.0)
        elif not isinstance(weak_contact, CriticalCone):
            pairs = weak_contact.equality_set(solution)
        w_dot, p_dot = solve_on_cone(values, weights, fixed, pairs, softness, *data_dot)
    return (w, solution), (w_dot, _tangent(solution, p_dot))


def _linearized_data(fixed: Fixed, w: Array, multiplier: Array, tangents) -> tuple[Array, Array]:
    """Return dr - dD w - dN^T p, (n,), and db - dN w, (C,)."""
    values_dot, weights_dot, rhs_dot, bound_dot, _ = tangents
    rhs_dot, bound_dot = _instantiate(rhs_dot), _instantiate(bound_dot)
    if not isinstance(values_dot, SymbolicZero):
        rhs_dot = rhs_dot - SymmetricMatrix(values_dot, fixed.columns) @ w
    if not isinstance(weights_dot, SymbolicZero):
        normals_dot = ContactNormals(weights_dot, fixed.unknowns)
        rhs_dot = rhs_dot - normals_dot.transposed_product(multiplier, w.shape[0])
        bound_dot = bound_dot - normals_dot @ w
    return rhs_dot, bound_dot


def _solve_critical_cone(
    values: Array, weights: Array, fixed: Fixed, solution: Solution, rhs: Array, bound: Array
) -> tuple[Array, Array]:
    """Return dw (n,) and dp (C,) of the one-sided derivative; not linear in rhs and bound."""
    normals = ContactNormals(weights, fixed.unknowns)
    strong = solution.active & (solution.multiplier > 0.0)
    weak = solution.active & ~strong
    if isinstance(fixed.factor, IterativeFactor):
        compliance = jnp.mean(fixed.factor.preconditioner[fixed.unknowns], axis=1)
    else:
        compliance = jnp.diagonal(fixed.factor.compliance)

    def solve_on_set(pairs: Array) -> tuple[Array, Array, Array]:
        w, p = solve_on_cone(values, weights, fixed, pairs, None, rhs, bound)
        return w, p, bound - normals @ w

    return critical_cone.solve(solve_on_set, strong, weak, compliance)


@jax.custom_jvp
def _solve_on_branch(values, weights, rhs, bound, fixed, direction):
    """Solve the VI and its one-sided derivative along (dr, db).

    Derivative: linear, on the pairs that the direction keeps in contact; the one-sided derivative
    itself counts as constant.
    """
    w, solution = _solve(CriticalCone(), values, weights, rhs, bound, fixed)
    derivative = _solve_critical_cone(values, weights, fixed, solution, *direction)
    return (w, solution), derivative


@partial(_solve_on_branch.defjvp, symbolic_zeros=True)
def _solve_on_branch_jvp(primals, tangents):
    values, weights, _, _, fixed, _ = primals
    (w, solution), derivative = _solve_on_branch(*primals)
    pairs = solution.active & ((solution.multiplier > 0.0) | (derivative[1] > 0.0))
    data_dot = _linearized_data(fixed, w, solution.multiplier, tangents[:5])
    w_dot, p_dot = solve_on_cone(values, weights, fixed, pairs, None, *data_dot)
    constant = jax.tree.map(jnp.zeros_like, derivative)
    return ((w, solution), derivative), ((w_dot, _tangent(solution, p_dot)), constant)


def _is_exact(contact_solver: ContactSolver, pairs: Array) -> bool:
    """Return whether the contact law is rigid."""
    return contact_solver.softness(pairs, pairs) is None


def _instantiate(tangent: Any) -> Array:
    if isinstance(tangent, SymbolicZero):
        return jnp.zeros(tangent.shape, tangent.dtype)
    return tangent


def _tangent(solution: Solution, multiplier_dot: Array) -> Solution:
    """Return the tangent of a solution: only the multiplier has one."""

    def nothing(leaf: Array) -> np.ndarray:
        is_float = jnp.issubdtype(leaf.dtype, jnp.floating)
        return np.zeros(leaf.shape, leaf.dtype if is_float else jax.dtypes.float0)

    return jax.tree.map(nothing, solution)._replace(multiplier=multiplier_dot)
