"""The adjoint of one contact step: the VI as a `jax.custom_vjp`.

With the active set A of the step and the saddle-point matrix of `saddle_point.py`, which is
symmetric, the transpose of (dr, db) -> (dw, dp) is the same problem,

    D r* + N^T b* = w*,    (N r* - s b*)_i = p*_i on A,    b*_i = 0 elsewhere,

one step of (4.40)-(4.41). The cotangents of D and N follow on their sparsity patterns,

    D* = -r* w^T,    N* = -(p r*^T + b* w^T),

and of a smooth law g(d p) that by d = diag W is d* = s p b* / d. The iteration of the solver is
never differentiated. A step keeps one boolean per contact pair;
w and p are kept only if the matrix or the normals are differentiated.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import custom_vjp_primal_tree_values

from jaxcontact.contact.complementarity import Solution
from jaxcontact.contact.saddle_point import Fixed, solve_on_cone
from jaxcontact.contact.tangent import by_compliance, linear_contact, solve_forward
from jaxcontact.contact.weak import ClosedBranch
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.symmetric_product import outer_on_pattern
from jaxcontact.transforms.tangents import instantiate


class Residuals(NamedTuple):
    """What a step keeps for its backward pass; empty arrays where nothing asks for it.

    Not None: JAX unflattens the residuals of one compiled program by the tree of the gradient that
    was traced last, so a second gradient, by other data, must not have another tree.
    """

    pairs: Array
    """A, (C,) bool: all that the gradient by loads, states, gaps and bounds needs."""

    softness: Array | None
    """dg/dp of a relaxed contact law, (C,); None if contact is exact."""

    velocity: Array
    """w, (n,), if matrix or normals are differentiated, else (0,)."""

    multiplier: Array
    """p, (C,), if the normals or d are differentiated, else (0,)."""

    values: Array
    """Entries of D (the same in every step, stored once)."""

    weights: Array
    """Entries of N (the same in every step, stored once)."""

    compliance: Array | None
    """d, (C,), if the law uses it (the same in every step, stored once)."""

    fixed: Fixed
    """Patterns, factor and contact solver (the same in every step, stored once)."""


#: Algorithm 1 of the paper: the whole active set counts as strong contact.
ALGORITHM_1 = ClosedBranch()


@jax.custom_vjp
def solve_with_adjoint(
    values: Array,
    weights: Array,
    rhs: Array,
    bound: Array,
    compliance: Array | None,
    fixed: Fixed,
) -> tuple[Array, Solution]:
    """Solve the VI; see `ContactProblem.solve`."""
    return solve_forward(ALGORITHM_1, values, weights, rhs, bound, compliance, fixed)


# Invariant: the backward pass solves the transpose of the linear problem that `solve_forward` has
# as its forward-mode rule, with the same pairs. Both call `solve_on_cone`.
def _solve_fwd(*arguments):
    values, weights, rhs, bound, compliance, fixed = custom_vjp_primal_tree_values(arguments)
    is_matrix_asked, is_normals_asked = arguments[0].perturbed, arguments[1].perturbed
    is_multiplier_kept = is_normals_asked or (compliance is not None and arguments[4].perturbed)
    w, solution = solve_forward(ALGORITHM_1, values, weights, rhs, bound, compliance, fixed)
    pairs, softness = linear_contact(ALGORITHM_1, compliance, fixed, solution)
    nothing = jnp.zeros(0, w.dtype)
    residuals = Residuals(
        pairs=pairs,
        softness=softness,
        velocity=w if is_matrix_asked or is_normals_asked else nothing,
        multiplier=solution.multiplier if is_multiplier_kept else nothing,
        values=values,
        weights=weights,
        compliance=compliance,
        # What changes from step to step and is not needed again.
        fixed=fixed._replace(resolution=None, guess=None, is_open=None, closed=None),
    )
    return (w, solution), residuals


@in_full_precision
def _solve_bwd(residuals, cotangents):
    w_bar, solution_bar = cotangents
    pairs, softness, velocity, multiplier, values, weights, compliance, fixed = residuals
    rhs_bar, bound_bar = solve_on_cone(
        values,
        weights,
        fixed,
        pairs,
        softness,
        instantiate(w_bar),
        instantiate(solution_bar.multiplier),
    )
    values_bar = weights_bar = compliance_bar = None
    if velocity.size:
        values_bar = -outer_on_pattern(fixed.columns, rhs_bar, velocity)
    if multiplier.size and compliance is not None:
        compliance_bar = bound_bar * by_compliance(compliance, softness, multiplier)
    if multiplier.size and velocity.size:
        weights_bar = -(
            multiplier[:, None] * rhs_bar[fixed.unknowns]
            + bound_bar[:, None] * velocity[fixed.unknowns]
        )
    return values_bar, weights_bar, rhs_bar, bound_bar, compliance_bar, None


solve_with_adjoint.defvjp(_solve_fwd, _solve_bwd, symbolic_zeros=True)
