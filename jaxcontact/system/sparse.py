"""Sparse operators of the discretised scene: symmetric matrices and contact normals.

A symmetric matrix is stored in padded ELL layout, column-major: `values[j, i]` sits in row `i`
and column `columns[j, i]`; rows with fewer entries are padded by their own index and the value
zero. With d components per node, rows and columns count nodes and entries are d x d blocks. The
product is then a short sum of gathers, without a scatter, and because the matrix is symmetric its
transpose is the same gather.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import Array

from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.symmetric_product import symmetric_product, take
from jaxcontact.transforms.traced import take_rows

__all__ = ["ComponentwiseMatrix", "ContactNormals", "SymmetricMatrix", "take", "unknown_columns"]


def unknown_columns(columns: Array | np.ndarray, size: int) -> Array | np.ndarray:
    """Return the column of each entry, (width d, n), from that of each block, (width, n/d)."""
    width, n_nodes = columns.shape
    d = size // n_nodes
    component = np.arange(d, dtype=np.int32)[None, :, None, None]
    spread = columns[:, None, :, None] * d + component + np.zeros((1, 1, 1, d), np.int32)
    return spread.reshape(width * d, size)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SymmetricMatrix:
    """A symmetric matrix of shape (n, n), sparse in padded ELL layout or dense.

    Derivative: of any order, with respect to the entries (on the sparsity pattern) and the vector.
    """

    values: Array
    """Entries, (width d, n): component j of a column and i of a row at (j, i) of each block;
    padded entries are zero. Dense: (n, n)."""

    columns: Array | np.ndarray | None
    """Column of each block, (width, n/d) int32; padded blocks name their own row. None is dense
    (a reduced model)."""

    @property
    def size(self) -> int:
        """Number of rows, n."""
        return self.values.shape[-1]

    @in_full_precision
    def __matmul__(self, x: Array) -> Array:
        """Return the product with a vector (n,) or with the columns of a matrix (n, r)."""
        if self.columns is None:
            return self.values @ x
        return symmetric_product(self.values, self.columns, x)

    def __add__(self, other: SymmetricMatrix) -> SymmetricMatrix:
        """Return the sum; both matrices must share one sparsity pattern."""
        return SymmetricMatrix(self.values + other.values, self.columns)

    def expand(self) -> SymmetricMatrix:
        """Return the matrix itself: every entry is there (see `ComponentwiseMatrix`)."""
        return self

    def __rmul__(self, factor: Array | float) -> SymmetricMatrix:
        """Return the matrix scaled by a number."""
        return SymmetricMatrix(factor * self.values, self.columns)

    def diagonal(self) -> Array:
        """Return the diagonal, (n,)."""
        if self.columns is None:
            return jnp.diagonal(self.values)
        columns = unknown_columns(self.columns, self.size)
        on_diagonal = columns == jnp.arange(self.size, dtype=jnp.int32)[None, :]
        return jnp.sum(jnp.where(on_diagonal, self.values, 0.0), axis=0)

    def to_dense(self) -> Array:
        """Return the dense matrix, (n, n)."""
        if self.columns is None:
            return self.values
        columns = unknown_columns(self.columns, self.size)
        rows = jnp.broadcast_to(jnp.arange(self.size, dtype=jnp.int32)[None, :], columns.shape)
        zeros = jnp.zeros((self.size, self.size), self.values.dtype)
        return zeros.at[rows, columns].add(self.values)

    def to_scipy(self) -> scipy.sparse.csr_array:
        """Return a SciPy CSR copy (concrete matrices only)."""
        if self.columns is None:
            return scipy.sparse.csr_array(np.asarray(self.values))
        values = np.asarray(self.values)
        columns = unknown_columns(np.asarray(self.columns), self.size)
        rows = np.broadcast_to(np.arange(self.size, dtype=np.int32), columns.shape)
        entries = (values.ravel(), (rows.ravel(), columns.ravel()))
        matrix = scipy.sparse.coo_array(entries, shape=(self.size, self.size)).tocsr()
        matrix.eliminate_zeros()
        return matrix


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ComponentwiseMatrix:
    """A symmetric matrix (n, n) that acts alike on each of d components and couples none.

    A mass matrix is one; it is stored and multiplied in n / d rows.
    """

    scalar: SymmetricMatrix
    """The action on one component, (n/d, n/d)."""

    dimension: int = field(metadata={"static": True})
    """Number of components, d."""

    @property
    def size(self) -> int:
        """Number of rows, n."""
        return self.scalar.size * self.dimension

    def __matmul__(self, x: Array) -> Array:
        """Return the product with a vector (n,) or with the columns of a matrix (n, r)."""
        return (self.scalar @ x.reshape(self.scalar.size, -1)).reshape(x.shape)

    def __add__(self, other: SymmetricMatrix) -> SymmetricMatrix:
        """Return the sum with a matrix of d x d blocks on the same nodes."""
        return self.expand() + other

    def expand(self) -> SymmetricMatrix:
        """Return the matrix with all entries of its blocks, those between components zero."""
        return SymmetricMatrix(_spread(self.scalar.values, self.dimension), self.scalar.columns)

    def diagonal(self) -> Array:
        """Return the diagonal, (n,)."""
        return jnp.repeat(self.scalar.diagonal(), self.dimension)

    def to_scipy(self) -> scipy.sparse.csr_array:
        """Return a SciPy CSR copy (concrete matrices only)."""
        return self.expand().to_scipy()


@partial(jax.jit, static_argnums=1)
def _spread(values: Array, d: int) -> Array:
    """Return the entries of d components that are not coupled, (width d, N d), of (width, N)."""
    blocks = values[:, None, :, None] * jnp.eye(d, dtype=values.dtype)[None, :, None, :]
    return blocks.reshape(-1, values.shape[1] * d)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactNormals:
    """The contact operator N of shape (C, n): row i maps y to the normal displacement of pair i.

    Each row touches k unknowns: the d components of one contact node, and of the nodes of another
    body that it may meet. In a reduced model it touches all of them, and N is dense.
    """

    weights: Array
    """Entries, (C, k); for a rigid obstacle the components of the unit normal nu_i, for another
    body followed by -m_ij nu_i (see `mortar.py`). Dense: (C, n)."""

    unknowns: Array | np.ndarray | None
    """Unknown of each entry, (C, k) int32; entries that are padded name their own with weight 0.
    None is dense (a reduced model)."""

    size: int | None = field(default=None, metadata={"static": True})
    """Number of all unknowns, n; None where it does not matter."""

    @property
    def count(self) -> int:
        """Number of contact pairs, C."""
        return self.weights.shape[-2]

    @in_full_precision
    @jax.jit
    def __matmul__(self, y: Array) -> Array:
        """Return N y, (C,), for y (n,)."""
        if self.unknowns is None:
            return self.weights @ y
        return jnp.sum(self.weights * y[self.unknowns], axis=1)

    def touched(self, y: Array) -> Array:
        """Return the entries of y (n,) that each row reads, (C, k); dense (1, n), all of them."""
        return y[None, :] if self.unknowns is None else y[self.unknowns]

    def absolute(self) -> ContactNormals:
        """Return the operator with the absolute values of its entries."""
        return ContactNormals(jnp.abs(self.weights), self.unknowns, self.size)

    def rows(self, pairs: np.ndarray) -> ContactNormals:
        """Return the operator of some of the pairs, their numbers (P,) int."""
        unknowns = None if self.unknowns is None else take_rows(self.unknowns, pairs)
        return ContactNormals(take_rows(self.weights, pairs), unknowns, self.size)

    @in_full_precision
    def transposed_product(self, multiplier: Array, size: int) -> Array:
        """Return N^T multiplier, (size,), for a multiplier (C,)."""
        if self.unknowns is None:
            return multiplier @ self.weights
        contributions = self.weights * multiplier[:, None]
        return jnp.zeros(size, contributions.dtype).at[self.unknowns].add(contributions)

    def to_scipy(self, size: int | None = None) -> scipy.sparse.csr_array:
        """Return a SciPy CSR copy of shape (C, size), of a system (C, n) (concrete operators only).

        Raises:
            ValueError: if the number of unknowns is given neither here nor in `size`.
        """
        if self.unknowns is None:
            return scipy.sparse.csr_array(np.asarray(self.weights))
        n_columns = self.size if size is None else size
        if n_columns is None:
            raise ValueError("this operator does not know its number of unknowns: pass to_scipy(n)")
        unknowns = np.asarray(self.unknowns)
        rows = np.broadcast_to(np.arange(self.count)[:, None], unknowns.shape)
        entries = (np.asarray(self.weights).ravel(), (rows.ravel(), unknowns.ravel()))
        return scipy.sparse.coo_array(entries, shape=(self.count, n_columns)).tocsr()
