"""Sparse operators of the discretised scene: symmetric matrices and contact normals.

A symmetric matrix is stored in padded ELL layout, column-major: `values[j, i]` sits in row `i`
and column `columns[j, i]`; rows with fewer entries are padded by their own index and the value
zero. The product is then a short sum of gathers, without a scatter, and because the matrix is
symmetric its transpose is the same gather.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import Array

from jaxcontact.symmetric_product import symmetric_product, take

__all__ = ["ContactNormals", "SymmetricMatrix", "take"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SymmetricMatrix:
    """A symmetric matrix of shape (n, n), sparse in padded ELL layout or dense.

    Derivative: of any order, with respect to the entries (on the sparsity pattern) and the vector.
    """

    values: Array
    """Entries, (width, n); padded entries are zero. Dense: (n, n)."""

    columns: Array | np.ndarray | None
    """Column of each entry, (width, n) int32; padded entries name their own row. None is dense
    (a reduced model)."""

    @property
    def size(self) -> int:
        """Number of rows, n."""
        return self.values.shape[-1]

    def __matmul__(self, x: Array) -> Array:
        """Return the product with a vector (n,) or with the columns of a matrix (n, r)."""
        if self.columns is None:
            return self.values @ x
        return symmetric_product(self.values, self.columns, x)

    def __add__(self, other: SymmetricMatrix) -> SymmetricMatrix:
        """Return the sum; both matrices must share one sparsity pattern."""
        return SymmetricMatrix(self.values + other.values, self.columns)

    def __rmul__(self, factor: Array | float) -> SymmetricMatrix:
        """Return the matrix scaled by a number."""
        return SymmetricMatrix(factor * self.values, self.columns)

    def diagonal(self) -> Array:
        """Return the diagonal, (n,)."""
        if self.columns is None:
            return jnp.diagonal(self.values)
        on_diagonal = self.columns == jnp.arange(self.size, dtype=jnp.int32)[None, :]
        return jnp.sum(jnp.where(on_diagonal, self.values, 0.0), axis=0)

    def to_dense(self) -> Array:
        """Return the dense matrix, (n, n)."""
        if self.columns is None:
            return self.values
        rows = jnp.broadcast_to(jnp.arange(self.size, dtype=jnp.int32)[None, :], self.columns.shape)
        zeros = jnp.zeros((self.size, self.size), self.values.dtype)
        return zeros.at[rows, self.columns].add(self.values)

    def to_scipy(self) -> scipy.sparse.csr_array:
        """Return a SciPy CSR copy (concrete matrices only)."""
        if self.columns is None:
            return scipy.sparse.csr_array(np.asarray(self.values))
        values, columns = np.asarray(self.values), np.asarray(self.columns)
        rows = np.broadcast_to(np.arange(self.size, dtype=np.int32), columns.shape)
        entries = (values.ravel(), (rows.ravel(), columns.ravel()))
        matrix = scipy.sparse.coo_array(entries, shape=(self.size, self.size)).tocsr()
        matrix.eliminate_zeros()
        return matrix


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactNormals:
    """The contact operator N of shape (C, n): row i maps y to the normal displacement of pair i.

    Each row touches k unknowns (the d components of one contact node, k = d).
    """

    weights: Array
    """Entries, (C, k); for a rigid obstacle the components of the unit normal nu_i."""

    unknowns: Array | np.ndarray
    """Unknown of each entry, (C, k) int32."""

    @property
    def count(self) -> int:
        """Number of contact pairs, C."""
        return self.unknowns.shape[0]

    def __matmul__(self, y: Array) -> Array:
        """Return N y, (C,), for y (n,)."""
        return jnp.sum(self.weights * y[self.unknowns], axis=1)

    def transposed_product(self, multiplier: Array, size: int) -> Array:
        """Return N^T multiplier, (size,), for a multiplier (C,)."""
        contributions = self.weights * multiplier[:, None]
        return jnp.zeros(size, contributions.dtype).at[self.unknowns].add(contributions)

    def to_scipy(self, size: int) -> scipy.sparse.csr_array:
        """Return a SciPy CSR copy of shape (C, size) (concrete operators only)."""
        unknowns = np.asarray(self.unknowns)
        rows = np.broadcast_to(np.arange(self.count)[:, None], unknowns.shape)
        entries = (np.asarray(self.weights).ravel(), (rows.ravel(), unknowns.ravel()))
        return scipy.sparse.coo_array(entries, shape=(self.count, size)).tocsr()
