"""The solve of one step with its forward-mode derivative on the critical cone.

With the active set A of the solution held fixed, (w, p) is linear in the data,

    D dw + N^T dp = dr - dD w - dN^T p,    (N dw - s dp)_i = (db - dN w)_i on A,    dp_i = 0 else.

`weak.py` names the choices of A at weak contact, `critical_cone.py` solves for the one-sided
derivative. Source: paper, Theorem 4.20.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from jaxcontact.contact import critical_cone, matrix_free
from jaxcontact.contact.complementarity import ContactSolver, Solution
from jaxcontact.contact.saddle_point import Fixed, solve_on_cone
from jaxcontact.contact.weak import CriticalCone, OnBranch, WeakContact
from jaxcontact.linear import can_condense
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix
from jaxcontact.transforms.forward_only import forward_only
from jaxcontact.transforms.lasting_jvp import lasting_jvp


def _solve_forward(
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
    if not can_condense(factor):
        if not _is_exact(contact_solver, bound):
            raise ValueError(
                f"ConjugateGradient cannot solve {type(contact_solver).__name__}; prepare with "
                "another linear_solver, such as jc.NestedDissection()"
            )
        return matrix_free.solve_contact(
            factor,
            contact_solver.max_steps,  # type: ignore
            rhs,
            bound,
            fixed.resolution,
            fixed.guess.active,
        )
    partial_sweep, free = factor.condense(rhs)
    solution = contact_solver.solve(factor.compliance, bound - free, fixed.resolution, fixed.guess)
    return factor.expand(partial_sweep, solution.multiplier), solution


def _solve_forward_jvp(arguments, tangents):
    weak_contact, *primals = arguments
    _, *tangents = tangents
    values, weights, _, bound, fixed = primals
    if isinstance(weak_contact, OnBranch) and _is_exact(fixed.contact_solver, bound):
        # AlongDirection moves loads and states, neither matrices nor normals.
        direction = jax.lax.stop_gradient((instantiate(tangents[2]), instantiate(tangents[3])))
        (w, solution), (w_dot, p_dot) = _solve_on_branch(*primals, direction)
        return (w, solution), (w_dot, _tangent(solution, p_dot))
    w, solution = solve_forward(weak_contact, *primals)
    data_dot = _linearized_data(fixed, w, solution.multiplier, tangents)
    if isinstance(weak_contact, CriticalCone) and _is_exact(fixed.contact_solver, bound):
        w_dot, p_dot = _solve_critical_cone(values, weights, fixed, solution, *data_dot)
        w_dot, p_dot = forward_only(w_dot), forward_only(p_dot)
    else:
        pairs, softness = linear_contact(weak_contact, weights, bound, fixed, w, solution)
        w_dot, p_dot = solve_on_cone(values, weights, fixed, pairs, softness, *data_dot)
    return (w, solution), (w_dot, _tangent(solution, p_dot))


#: The VI of a step with its derivative, of every order and in any order of transformations.
solve_forward = lasting_jvp(_solve_forward, _solve_forward_jvp)


def linear_contact(
    weak_contact: WeakContact,
    weights: Array,
    bound: Array,
    fixed: Fixed,
    w: Array,
    solution: Solution,
) -> tuple[Array, Array | None]:
    """Return the pairs (C,) bool and the softness (C,) or None of the linearised contact law."""
    separation = bound - ContactNormals(weights, fixed.unknowns) @ w
    softness = fixed.contact_solver.softness(solution.multiplier, separation)
    if softness is None:
        if isinstance(weak_contact, CriticalCone | OnBranch):
            return solution.active, None
        return weak_contact.equality_set(solution), None
    # Infinitely soft pairs are open; a product with infinity would be NaN.
    pairs = jnp.isfinite(softness)
    return pairs, jnp.where(pairs, softness, 0.0)


def _linearized_data(fixed: Fixed, w: Array, multiplier: Array, tangents) -> tuple[Array, Array]:
    """Return dr - dD w - dN^T p, (n,), and db - dN w, (C,)."""
    values_dot, weights_dot, rhs_dot, bound_dot, _ = tangents
    rhs_dot, bound_dot = instantiate(rhs_dot), instantiate(bound_dot)
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
    if not can_condense(fixed.factor):
        compliance = fixed.factor.approximate_compliance
    else:
        compliance = jnp.diagonal(fixed.factor.compliance)

    def solve_on_set(pairs: Array) -> tuple[Array, Array, Array]:
        w, p = solve_on_cone(values, weights, fixed, pairs, None, rhs, bound)
        return w, p, bound - normals @ w

    return critical_cone.solve(solve_on_set, strong, weak, compliance)


def _solve_branch(values, weights, rhs, bound, fixed, direction):
    """Solve the VI and its one-sided derivative along (dr, db).

    Derivative: linear, on the pairs that the direction keeps in contact; the one-sided derivative
    itself counts as constant.
    """
    w, solution = solve_forward(CriticalCone(), values, weights, rhs, bound, fixed)
    derivative = _solve_critical_cone(values, weights, fixed, solution, *direction)
    return (w, solution), derivative


def _solve_branch_jvp(primals, tangents):
    values, weights, _, _, fixed, _ = primals
    (w, solution), derivative = _solve_on_branch(*primals)
    pairs = solution.active & ((solution.multiplier > 0.0) | (derivative[1] > 0.0))
    data_dot = _linearized_data(fixed, w, solution.multiplier, tangents[:5])
    w_dot, p_dot = solve_on_cone(values, weights, fixed, pairs, None, *data_dot)
    constant = jax.tree.map(jnp.zeros_like, derivative)
    return ((w, solution), derivative), ((w_dot, _tangent(solution, p_dot)), constant)


_solve_on_branch = lasting_jvp(_solve_branch, _solve_branch_jvp)


def _is_exact(contact_solver: ContactSolver, pairs: Array) -> bool:
    """Return whether the contact law is rigid."""
    return contact_solver.softness(pairs, pairs) is None


def instantiate(tangent: Any) -> Array:
    """Return a tangent or cotangent as an array, also if it is a symbolic zero."""
    if isinstance(tangent, SymbolicZero):
        return jnp.zeros(tangent.aval.shape, tangent.aval.dtype)  # type: ignore
    return tangent


def _tangent(solution: Solution, multiplier_dot: Array) -> Solution:
    """Return the tangent of a solution: only the multiplier has one."""

    def nothing(leaf: Array) -> np.ndarray:
        is_float = jnp.issubdtype(leaf.dtype, jnp.floating)
        return np.zeros(leaf.shape, leaf.dtype if is_float else jax.dtypes.float0)

    return jax.tree.map(nothing, solution)._replace(multiplier=multiplier_dot)
