"""The linear problem of a step whose set of closed pairs is known.

    D dw + N^T dp = dr,    (N dw - s dp)_i = db_i on A,    dp_i = 0 elsewhere.

It is symmetric, so that derivative and adjoint (4.40)-(4.41) are the same solve, by the factor of
the step. Source: MATH.md 3.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.contact.complementarity import Guess
from jaxcontact.contact.form import ContactForm
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix


class Fixed(NamedTuple):
    """What a step uses and never differentiates."""

    columns: Array | np.ndarray | None
    """Sparsity of D, (width, n) int32; None is dense."""

    unknowns: Array | np.ndarray | None
    """Sparsity of N, (C, k) int32; None is dense."""

    form: ContactForm
    """Factor and contact solver. The derivative by D enters through the values of the matrix
    instead, and parameters of the contact solver count as constant."""

    resolution: Array | None
    """Rounding error of b, (C,); read by the forward solve only."""

    guess: Guess | None
    """Where the contact solver starts; read by the forward solve only."""

    is_open: Array | None
    """Pairs that are open in the derivative whatever their state, (C,) bool; None is none."""

    closed: Array | None = None
    """The pairs that are closed in motion and derivative, (C,) bool; None lets contact decide."""


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
        fixed: patterns, factor and contact solver.
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

    form, frozen_softness = jax.lax.stop_gradient((fixed.form, softness))

    def solve(_, data):
        return jnp.concatenate(form.solve_on_set(active, frozen_softness, data[:n], data[n:]))

    data = jnp.concatenate([rhs, jnp.where(active, bound, 0.0)])
    solution = jax.lax.custom_linear_solve(saddle_point, data, solve, symmetric=True)
    return solution[:n], solution[n:]
