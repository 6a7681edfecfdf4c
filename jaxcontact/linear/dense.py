"""The dense inverse: for up to a few hundred unknowns and for reduced models."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jax import Array

from jaxcontact.linear.interface import Partial
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DenseFactor:
    """The explicit inverse of D with its contact columns."""

    inverse: Array
    """D^-1, (n, n)."""

    contact_response: Array
    """N D^-1, (C, n)."""

    compliance: Array
    """N D^-1 N^T, (C, C)."""

    @property
    @jax.jit
    def is_positive(self) -> Array:
        """True if D is positive definite, () bool: the Cholesky factor of another one is NaN."""
        return jnp.all(jnp.isfinite(self.inverse))

    def solve(self, rhs: Array) -> Array:
        """Return D^-1 rhs, (n,)."""
        return self.inverse @ rhs

    def condense(self, rhs: Array) -> tuple[Partial, Array]:
        """Return D^-1 rhs, (n,), as one front, and N D^-1 rhs, (C,)."""
        return Partial(None, (), self.inverse @ rhs), self.contact_response @ rhs

    def expand(self, partial: Partial, multiplier: Array) -> Array:
        """Return D^-1 (rhs - N^T multiplier), (n,)."""
        return partial.root - multiplier @ self.contact_response


@dataclass(frozen=True)
class Dense:
    """Invert the matrix once; a solve is one matrix-vector product.

    Memory and time of a solve grow with n^2: use it up to about n = 1000.
    """

    def factorize(
        self,
        matrix: SymmetricMatrix,
        normals: ContactNormals,
        coordinates: np.ndarray | None = None,
    ) -> DenseFactor:
        """Return the inverse; NaN everywhere if the matrix is not positive definite.

        Args:
            matrix: D, SPD, (n, n).
            normals: N, (C, n).
            coordinates: not used.
        """
        del coordinates
        return _invert(matrix, normals)

    def bytes_needed(self, size: int, dimension: int, itemsize: int) -> float:
        """Return the memory of the matrix, its Cholesky factor and its inverse, [bytes]."""
        del dimension
        return 3.0 * itemsize * size**2


@jax.jit
def _invert(matrix: SymmetricMatrix, normals: ContactNormals) -> DenseFactor:
    dense = matrix.to_dense()
    # Jacobi scaling first: it makes the inverse of a badly scaled matrix accurate.
    scale = 1.0 / jnp.sqrt(jnp.diagonal(dense))
    identity = jnp.eye(matrix.size, dtype=dense.dtype)
    factor = jax.scipy.linalg.cho_factor(scale[:, None] * dense * scale[None, :], lower=True)
    inverse = jax.scipy.linalg.cho_solve(factor, identity)
    inverse = scale[:, None] * (0.5 * (inverse + inverse.T)) * scale[None, :]
    response = jax.vmap(lambda column: normals @ column, 1, 1)(inverse)
    compliance = jax.vmap(lambda row: normals @ row)(response)
    return DenseFactor(inverse, response, 0.5 * (compliance + compliance.T))
