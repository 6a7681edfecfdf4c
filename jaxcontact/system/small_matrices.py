"""Rotations in two and three dimensions: products, skew matrices, Cayley transform.

Sums of products instead of calls of a library, which for matrices of this size cost more than all
else in a step. Skew matrices are [w] = sum_k w_k E_k, s = d (d - 1) / 2 of them; in three
dimensions [w] x is the cross product.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

#: E_k by the dimension, (s, d, d).
UNITS = {
    2: np.array([[[0.0, -1.0], [1.0, 0.0]]]),
    3: -np.array(
        [
            [[np.linalg.det(np.eye(3)[[k, i, j]]) for j in range(3)] for i in range(3)]
            for k in range(3)
        ]
    ),
}


def product(left: Array, right: Array) -> Array:
    """Return the matrix products (F, i, j)."""
    return jnp.sum(left[:, :, :, None] * right[:, None, :, :], axis=2)


def skew(vector: Array) -> Array:
    """Return [w], (F, d, d), for axial vectors (F, s)."""
    units = jnp.asarray(UNITS[2 if vector.shape[-1] == 1 else 3], vector.dtype)
    return jnp.sum(vector[:, :, None, None] * units[None], axis=1)


def axial(matrix: Array) -> Array:
    """Return <E_k, H>, (F, s): twice the axial vector of the skew part of H (F, d, d)."""
    units = jnp.asarray(UNITS[matrix.shape[-1]], matrix.dtype)
    return jnp.sum(matrix[:, None] * units[None], axis=(2, 3))


def half_cayley(vector: Array) -> Array:
    """Return (I - W/2)^-1, (F, d, d), for W = [w]."""
    A = skew(0.5 * vector)
    square = product(A, A)
    size = -0.5 * jnp.trace(square, axis1=1, axis2=2)[:, None, None]
    return jnp.eye(A.shape[-1], dtype=A.dtype)[None] + (A + square) / (1.0 + size)


def cayley(vector: Array) -> Array:
    """Return the rotation (I - W/2)^-1 (I + W/2), (F, d, d), for W = [w]."""
    half = half_cayley(vector)
    return 2.0 * half - jnp.eye(half.shape[-1], dtype=half.dtype)[None]


def solve_small(matrix: Array, rhs: Array) -> Array:
    """Return the solutions (F, s) of systems (F, s, s) with s = 1 or 3 (Cramer's rule)."""
    if rhs.shape[-1] == 1:
        return rhs / matrix[:, 0]
    a, b, c = (matrix[:, :, k] for k in range(3))
    bc, ca, ab = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    numerators = jnp.stack([jnp.sum(rhs * x, axis=1) for x in (bc, ca, ab)], axis=1)
    return numerators / jnp.sum(a * bc, axis=1)[:, None]
