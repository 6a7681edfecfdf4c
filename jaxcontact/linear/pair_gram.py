"""Projection off the contact rows in the metric of a diagonal preconditioner P.

    x - N_A^T G_A^-1 N_A P x,    G = N P N^T,

is what is left of a force x without the rows of an active set A. G is diagonal if no two rows share
an unknown, as against obstacles; the rows of two bodies share those of the other one.

Source: Gould, Hribar, Nocedal, SIAM J. Sci. Comput. 23 (2001).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jax import Array

from jaxcontact.system.sparse import ContactNormals

#: What is added to the unit diagonal of the scaled G before it is inverted, as a power of the unit
#: roundoff: rows that depend on each other make G singular. An error e / s in a direction of
#: singular value s is left, and one of eps / e by rounding; a refinement squares them.
SHIFT = 1 / 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PairGram:
    """G = N P N^T of C contact rows; make it with `pair_gram`."""

    scaled: ContactNormals
    """N P, (C, n)."""

    diagonal: Array
    """Diagonal of G, (C,)."""

    matrix: Array | None
    """G, (C, C); None if it is diagonal."""

    def inverse_on(self, active: Array) -> Callable[[Array], Array]:
        """Return the product of a vector (C,) with the inverse of G on the active set (C,) bool.

        It is zero elsewhere. Rows that depend on each other share what they have in common.
        """
        if self.matrix is None:
            return lambda q: jnp.where(active, q / self.diagonal, 0.0)
        matrix, inverse = self.matrix, _inverse_on(self.matrix, active)

        def solve(q: Array) -> Array:
            first = jnp.matmul(inverse, q, precision="highest")
            rest = q - jnp.matmul(matrix, first, precision="highest")
            return first + jnp.matmul(inverse, rest, precision="highest")

        return solve


@jax.jit
def _inverse_on(matrix: Array, active: Array) -> Array:
    inside = active[:, None] & active[None, :]
    scale = jax.lax.rsqrt(jnp.where(active, jnp.diagonal(matrix), 1.0))
    identity = jnp.eye(active.size, dtype=matrix.dtype)
    unit = jnp.where(inside, matrix * scale[:, None] * scale[None, :], identity)
    shift = float(jnp.finfo(matrix.dtype).eps) ** SHIFT
    factor = jax.scipy.linalg.cho_factor(unit + shift * identity, lower=True)
    inverse = jax.scipy.linalg.cho_solve(factor, identity)
    return jnp.where(inside, scale[:, None] * inverse * scale[None, :], 0.0)


def pair_gram(normals: ContactNormals, preconditioner: Array) -> PairGram:
    """Return G of N (C, n), whose pattern is concrete, and the diagonal of P (n,)."""
    unknowns = np.asarray(normals.unknowns)
    weights = normals.weights * preconditioner[unknowns]
    scaled = ContactNormals(weights, normals.unknowns, normals.size)
    own, place = np.unique(unknowns, return_inverse=True)
    if own.size == unknowns.size:
        return PairGram(scaled, jnp.sum(weights * normals.weights, axis=1), None)
    rows, columns = np.arange(normals.count)[:, None], place.reshape(unknowns.shape)
    dense = jnp.zeros((normals.count, own.size), weights.dtype)
    matrix = jnp.matmul(
        dense.at[rows, columns].add(weights),
        dense.at[rows, columns].add(normals.weights).T,
        precision="highest",
    )
    return PairGram(scaled, jnp.diagonal(matrix), matrix)
