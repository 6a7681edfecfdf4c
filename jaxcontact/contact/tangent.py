"""The solve of one step with its forward-mode derivative on the critical cone.

With the active set A of the solution held fixed, (w, p) is linear in the data,

    D dw + N^T dp = dr - dD w - dN^T p,    (N dw - s dp)_i = (db - dN w)_i on A,    dp_i = 0 else.

A smooth law g(d p), d = diag W, has all pairs in A, s = -dg/dp, and s p dd / d beside db.
`weak.py` names the choices of A at weak contact, `critical_cone.py` solves for the one-sided
derivative. Source: paper, Theorem 4.20.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from jaxcontact.contact import critical_cone
from jaxcontact.contact.complementarity import Guess, Solution, Status
from jaxcontact.contact.saddle_point import Fixed, solve_on_cone
from jaxcontact.contact.weak import WeakContact
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix
from jaxcontact.transforms.forward_only import forward_only
from jaxcontact.transforms.lasting_jvp import lasting_jvp
from jaxcontact.transforms.tangents import instantiate

#: What reverse mode of the one-sided derivative ends with.
NO_GRADIENT = (
    "weak_contact=CriticalCone() is the one-sided derivative, which is not linear in the "
    "direction: it has no gradient. Use jax.jvp or directional_derivative with it, and for "
    "jax.grad choose a linear branch: ClosedBranch(), OpenBranch() or AlongDirection(direction)"
)


def _solve_forward(
    weak_contact: WeakContact,
    values: Array,
    weights: Array,
    rhs: Array,
    bound: Array,
    compliance: Array | None,
    fixed: Fixed,
) -> tuple[Array, Solution]:
    """Solve the VI; see `ContactProblem.solve`."""
    del weak_contact, compliance
    assert fixed.resolution is not None
    assert fixed.guess is not None
    if fixed.closed is not None:
        w, p = solve_on_cone(values, weights, fixed, fixed.closed, None, rhs, bound)
        return w, _on_pattern(fixed.closed, fixed.guess, p)
    return fixed.form.solve(rhs, bound, fixed.resolution, fixed.guess)


def _solve_forward_jvp(arguments, tangents):
    weak_contact, *primals = arguments
    _, *tangents = tangents
    values, weights, _, _, compliance, fixed = primals
    w, solution = solve_forward(weak_contact, *primals)
    data_dot = _linearized_data(fixed, w, solution.multiplier, tangents)
    if weak_contact.is_linear or not fixed.form.contact_solver.is_exact:
        pairs, softness = linear_contact(weak_contact, compliance, fixed, solution)
        compliance_dot = tangents[4]
        if softness is not None and not isinstance(compliance_dot, SymbolicZero | None):
            rate = by_compliance(compliance, softness, solution.multiplier)
            data_dot = data_dot[0], data_dot[1] + rate * compliance_dot
        w_dot, p_dot = solve_on_cone(values, weights, fixed, pairs, softness, *data_dot)
    else:
        w_dot, p_dot = _solve_critical_cone(values, weights, fixed, solution, *data_dot)
        w_dot, p_dot = forward_only(w_dot, NO_GRADIENT), forward_only(p_dot, NO_GRADIENT)
    return (w, solution), (w_dot, _tangent(solution, p_dot))


#: The VI of a step with its derivative, of every order and in any order of transformations.
solve_forward = lasting_jvp(_solve_forward, _solve_forward_jvp)


def linear_contact(
    weak_contact: WeakContact, compliance: Array | None, fixed: Fixed, solution: Solution
) -> tuple[Array, Array | None]:
    """Return the pairs (C,) bool and the softness (C,) or None of the linearised contact law."""
    contact_solver = fixed.form.contact_solver
    if fixed.closed is not None:
        return _not_open(fixed, fixed.closed), None
    if contact_solver.is_exact:
        return _not_open(fixed, weak_contact.equality_set(solution)), None
    softness = contact_solver.softness(compliance, solution.multiplier)
    # Infinitely soft pairs are open; a product with infinity would be NaN.
    pairs = _not_open(fixed, jnp.isfinite(softness))
    return pairs, jnp.where(pairs, softness, 0.0)


def by_compliance(compliance: Array, softness: Array, multiplier: Array) -> Array:
    """Return -dg/dd of a law g(d p), (C,), from s = -dg/dp: s p / d."""
    return softness * multiplier / compliance


def _on_pattern(closed: Array, guess: Guess, multiplier: Array) -> Solution:
    """Return the solution for given closed pairs; nothing is iterated, no sign is asked for."""
    is_finite = jnp.all(jnp.isfinite(multiplier))
    status = jnp.where(is_finite, Status.CONVERGED, Status.NON_FINITE).astype(jnp.int32)
    nothing = jnp.zeros((), multiplier.dtype)
    return Solution(multiplier, closed, jnp.int32(0), status, nothing, guess.workspace)


def _not_open(fixed: Fixed, pairs: Array) -> Array:
    return pairs if fixed.is_open is None else pairs & ~fixed.is_open


def _linearized_data(
    fixed: Fixed, w: Array, multiplier: Array, tangents: Sequence
) -> tuple[Array, Array]:
    """Return dr - dD w - dN^T p, (n,), and db - dN w, (C,)."""
    values_dot, weights_dot, rhs_dot, bound_dot, *_ = tangents
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
    active = _not_open(fixed, solution.active)
    strong = active & (solution.multiplier > 0.0)

    def solve_with(pairs: Array) -> tuple[Array, Array, Array]:
        w, p = solve_on_cone(values, weights, fixed, pairs, None, rhs, bound)
        return w, p, bound - normals @ w

    return critical_cone.solve(solve_with, strong, active & ~strong, fixed.form.compliance_scale)


def _tangent(solution: Solution, multiplier_dot: Array) -> Solution:
    """Return the tangent of a solution: only the multiplier has one."""

    def nothing(leaf: Array) -> np.ndarray:
        is_float = jnp.issubdtype(leaf.dtype, jnp.floating)
        return np.zeros(leaf.shape, leaf.dtype if is_float else jax.dtypes.float0)

    return jax.tree.map(nothing, solution)._replace(multiplier=multiplier_dot)
