"""The contact variational inequality of one step, and its derivative on the critical cone.

Find the velocity w and the multiplier p >= 0 with

    D w + N^T p = r,    N w <= b,    p . (b - N w) = 0,

which is the minimum of w.Dw/2 - r.w over {N w <= b}; every time-stepping scheme is made of such
problems. With the active set A held fixed the solution is linear in (r, b), so that both the
derivative and its transpose are the same symmetric saddle-point problem (4.40)-(4.41),

    D dw + N^T dp = dr,    (N dw - s dp)_i = db_i on A,    dp_i = 0 elsewhere,

with s = 0 for exact contact. It is solved by the factor of the forward step. All of A counts as
strong contact (Algorithm 1 of the paper), so where weak contact is present the derivative is one
element of the generalised Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero, custom_vjp_primal_tree_values

from jaxcontact.contact import matrix_free
from jaxcontact.contact.complementarity import (
    ContactSolver,
    Solution,
    Status,
    solve_on_set,
)
from jaxcontact.linear import Factor
from jaxcontact.linear.conjugate_gradient import IterativeFactor
from jaxcontact.sparse import ContactNormals, SymmetricMatrix


class Fixed(NamedTuple):
    """What a step uses and never differentiates."""

    columns: Array | np.ndarray
    """Sparsity of D, (width, n) int32."""

    unknowns: Array | np.ndarray
    """Sparsity of N, (C, k) int32."""

    factor: Factor
    """Factor of D; the derivative by D enters through the values of the matrix instead."""

    resolution: Array
    """Rounding error of b, (C,)."""

    guess: Array
    """Active set to start from, (C,) bool."""


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

    contact_solver: ContactSolver = field(metadata={"static": True})
    """How the condensed problem is solved."""

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

        Derivative: reverse mode and its derivatives, with respect to the values of the matrix and
        the normals, r and b; the iteration itself is never differentiated.
        """
        if self.normals.count == 0:
            velocity = _solve_linear(self, rhs)
            is_finite = jnp.all(jnp.isfinite(velocity))
            status = jnp.where(is_finite, Status.CONVERGED, Status.NON_FINITE).astype(jnp.int32)
            return velocity, Solution(bound, guess, jnp.int32(0), status, jnp.zeros((), rhs.dtype))
        fixed = Fixed(self.matrix.columns, self.normals.unknowns, self.factor, resolution, guess)
        velocity, solution = _solve(
            self.contact_solver, self.matrix.values, self.normals.weights, rhs, bound, fixed
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


def solve_on_cone(
    values: Array,
    weights: Array,
    fixed: Fixed,
    active: Array,
    softness: Array | None,
    rhs: Array,
    bound: Array,
) -> tuple[Array, Array]:
    """Solve the saddle-point problem on a fixed active set; symmetric, hence its own transpose.

    Args:
        values: entries of D, (width, n).
        weights: entries of N, (C, k).
        fixed: patterns and the factor.
        active: A, (C,) bool.
        softness: s, (C,) or None for zero.
        rhs: dr, (n,).
        bound: db, (C,); read on A only.

    Returns:
        dw (n,) and dp (C,), zero outside A.

    Derivative: of every order, with respect to values, weights, softness, rhs and bound.
    """
    matrix = SymmetricMatrix(values, fixed.columns)
    normals = ContactNormals(weights, fixed.unknowns)

    n = rhs.shape[0]

    # One vector (w, p): custom_linear_solve fails where only one of two parts has a tangent.
    def saddle_point(unknowns):
        w, p = unknowns[:n], unknowns[n:]
        p_active = jnp.where(active, p, 0.0)
        stretch = normals @ w if softness is None else normals @ w - softness * p
        balance = matrix @ w + normals.transposed_product(p_active, n)
        return jnp.concatenate([balance, jnp.where(active, stretch, p)])

    factor, frozen_softness = jax.lax.stop_gradient((fixed.factor, softness))

    def solve(_, data):
        r, b = data[:n], data[n:]
        if isinstance(factor, IterativeFactor):
            return jnp.concatenate(factor.solve_on_set(active, r, b))
        partial_sweep, free = factor.condense(r)
        p = solve_on_set(factor.compliance, active, frozen_softness, jnp.where(active, free - b, b))
        return jnp.concatenate([factor.expand(partial_sweep, jnp.where(active, p, 0.0)), p])

    data = jnp.concatenate([rhs, jnp.where(active, bound, 0.0)])
    solution = jax.lax.custom_linear_solve(saddle_point, data, solve, symmetric=True)
    return solution[:n], solution[n:]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def solve_forward(
    contact_solver: ContactSolver,
    values: Array,
    weights: Array,
    rhs: Array,
    bound: Array,
    fixed: Fixed,
) -> tuple[Array, Solution]:
    """Solve the VI; forward-mode derivative on the active set. See `ContactProblem.solve`."""
    factor = fixed.factor
    if isinstance(factor, IterativeFactor):
        return matrix_free.solve_contact(
            factor, contact_solver.max_steps, rhs, bound, fixed.resolution, fixed.guess
        )
    partial_sweep, free = factor.condense(rhs)
    solution = contact_solver.solve(factor.compliance, bound - free, fixed.resolution, fixed.guess)
    return factor.expand(partial_sweep, solution.multiplier), solution


@partial(solve_forward.defjvp, symbolic_zeros=True)
def _solve_forward_jvp(contact_solver, primals, tangents):
    values, weights, _, bound, fixed = primals
    values_dot, weights_dot, rhs_dot, bound_dot, _ = tangents
    w, solution = solve_forward(contact_solver, *primals)
    normals = ContactNormals(weights, fixed.unknowns)
    softness = contact_solver.softness(solution.multiplier, bound - normals @ w)
    rhs_dot = _zero_if_symbolic(rhs_dot)
    bound_dot = _zero_if_symbolic(bound_dot)
    if not isinstance(values_dot, SymbolicZero):
        rhs_dot = rhs_dot - SymmetricMatrix(values_dot, fixed.columns) @ w
    if not isinstance(weights_dot, SymbolicZero):
        normals_dot = ContactNormals(weights_dot, fixed.unknowns)
        rhs_dot = rhs_dot - normals_dot.transposed_product(solution.multiplier, w.shape[0])
        bound_dot = bound_dot - normals_dot @ w
    w_dot, p_dot = solve_on_cone(
        values, weights, fixed, solution.active, softness, rhs_dot, bound_dot
    )
    return (w, solution), (w_dot, _tangent(solution, p_dot))


def _zero_if_symbolic(tangent: Any) -> Array:
    if isinstance(tangent, SymbolicZero):
        return jnp.zeros(tangent.shape, tangent.dtype)
    return tangent


def _tangent(solution: Solution, multiplier_dot: Array) -> Solution:
    """Return the tangent of a solution: only the multiplier has one."""

    def nothing(leaf: Array) -> np.ndarray:
        is_float = jnp.issubdtype(leaf.dtype, jnp.floating)
        return np.zeros(leaf.shape, leaf.dtype if is_float else jax.dtypes.float0)

    return jax.tree.map(nothing, solution)._replace(multiplier=multiplier_dot)


class Residuals(NamedTuple):
    """What a step keeps for its backward pass; None where nothing asks for it."""

    active: Array
    """A, (C,) bool: all that the gradient by loads, states, gaps and bounds needs."""

    softness: Array | None
    """dg/dp of a relaxed contact law, (C,)."""

    velocity: Array | None
    """w, (n,), if matrix values or normals are differentiated."""

    multiplier: Array | None
    """p, (C,), if the normals are differentiated."""

    values: Array
    """Entries of D (loop-invariant, stored once)."""

    weights: Array
    """Entries of N (loop-invariant, stored once)."""

    fixed: Fixed
    """Patterns and the factor (loop-invariant, stored once)."""


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _solve(contact_solver, values, weights, rhs, bound, fixed):
    return solve_forward(contact_solver, values, weights, rhs, bound, fixed)


# Invariant: `_solve_bwd` solves the transpose of the linear problem that `_solve_forward_jvp`
# solves, with the same active set. It is symmetric, so both call `solve_on_cone`.
def _solve_fwd(contact_solver, *arguments):
    values, weights, rhs, bound, fixed = custom_vjp_primal_tree_values(arguments)
    is_matrix_asked, is_normals_asked = arguments[0].perturbed, arguments[1].perturbed
    w, solution = solve_forward(contact_solver, values, weights, rhs, bound, fixed)
    normals = ContactNormals(weights, fixed.unknowns)
    residuals = Residuals(
        active=solution.active,
        softness=contact_solver.softness(solution.multiplier, bound - normals @ w),
        velocity=w if is_matrix_asked or is_normals_asked else None,
        multiplier=solution.multiplier if is_normals_asked else None,
        values=values,
        weights=weights,
        # The guess and the resolution of a step are not needed again.
        fixed=fixed._replace(guess=None, resolution=None),
    )
    return (w, solution), residuals


def _solve_bwd(contact_solver, residuals, cotangents):
    del contact_solver
    w_bar, solution_bar = cotangents
    active, softness, velocity, multiplier, values, weights, fixed = residuals
    p_bar = _zero_if_symbolic(solution_bar.multiplier)
    w_bar = _zero_if_symbolic(w_bar)
    rhs_bar, bound_bar = solve_on_cone(values, weights, fixed, active, softness, w_bar, p_bar)
    values_bar = weights_bar = None
    if velocity is not None:
        values_bar = -rhs_bar[None, :] * velocity[fixed.columns]
    if velocity is not None and multiplier is not None:
        weights_bar = -(
            multiplier[:, None] * rhs_bar[fixed.unknowns]
            + bound_bar[:, None] * velocity[fixed.unknowns]
        )
    return values_bar, weights_bar, rhs_bar, bound_bar, None


_solve.defvjp(_solve_fwd, _solve_bwd, symbolic_zeros=True)
