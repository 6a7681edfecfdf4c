"""Sparse operators of the discretised scene: symmetric matrices and contact normals.

A symmetric matrix is stored in padded ELL layout, column-major: `values[j, i]` sits in row `i`
and column `columns[j, i]`; rows with fewer entries are padded by their own index and the value
zero. The product is then a short sum of gathers, without a scatter, and because the matrix is
symmetric its transpose is the same gather.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import Array
from jax.custom_derivatives import SymbolicZero


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SymmetricMatrix:
    """A sparse symmetric matrix of shape (n, n) in padded ELL layout.

    Derivative: of any order, with respect to the entries (on the sparsity pattern) and the vector.
    """

    values: Array
    """Entries, (width, n); padded entries are zero."""

    columns: Array | np.ndarray
    """Column of each entry, (width, n) int32; padded entries name their own row."""

    @property
    def size(self) -> int:
        """Number of rows, n."""
        return self.values.shape[-1]

    def __matmul__(self, x: Array) -> Array:
        """Return the product with a vector (n,) or with the columns of a matrix (n, r)."""
        return _symmetric_product(self.values, self.columns, x)

    def __add__(self, other: SymmetricMatrix) -> SymmetricMatrix:
        """Return the sum; both matrices must share one sparsity pattern."""
        return SymmetricMatrix(self.values + other.values, self.columns)

    def __rmul__(self, factor: Array | float) -> SymmetricMatrix:
        """Return the matrix scaled by a number."""
        return SymmetricMatrix(factor * self.values, self.columns)

    def diagonal(self) -> Array:
        """Return the diagonal, (n,)."""
        on_diagonal = self.columns == jnp.arange(self.size, dtype=jnp.int32)[None, :]
        return jnp.sum(jnp.where(on_diagonal, self.values, 0.0), axis=0)

    def to_scipy(self) -> scipy.sparse.csr_array:
        """Return a SciPy CSR copy (concrete matrices only)."""
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


def take(x: Array, index: Array | np.ndarray) -> Array:
    """Return x[index] along the first axis for an index that is known to be in bounds."""
    return x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _gathered_product(values: Array, columns: Array | np.ndarray, x: Array) -> Array:
    """Return sum_j values[j] * x[columns[j]]; the loop over the short rows is unrolled."""
    if x.ndim == 2:
        values = values[:, :, None]
    # Without the barrier XLA recomputes the producer of x inside every one of the gathers.
    x = jax.lax.optimization_barrier(x)
    product = values[0] * take(x, columns[0])
    for j in range(1, columns.shape[0]):
        product = product + values[j] * take(x, columns[j])
    return product


def _linear_product(values: Array, columns: Array | np.ndarray, x: Array) -> Array:
    """Return the product as a linear map of x that is declared to be its own transpose.

    `custom_linear_solve` is the one construct of JAX that lets a linear map state its transpose
    and still supports vmap and every order of differentiation. `matvec` would be the inverse of
    the matrix; it is never evaluated, because the entries are not differentiated through here.
    """
    return jax.lax.custom_linear_solve(
        matvec=lambda y: y,
        b=x,
        solve=lambda _, b: _gathered_product(values, columns, b),
        symmetric=True,
    )


@jax.custom_jvp
def _symmetric_product(values: Array, columns: Array | np.ndarray, x: Array) -> Array:
    return _gathered_product(values, columns, x)


@partial(_symmetric_product.defjvp, symbolic_zeros=True)
def _symmetric_product_jvp(primals, tangents):
    values, columns, x = primals
    values_dot, _, x_dot = tangents
    product = _linear_product(values, columns, x)
    product_dot = jnp.zeros_like(product)
    if not isinstance(x_dot, SymbolicZero):
        product_dot = product_dot + _linear_product(values, columns, x_dot)
    if not isinstance(values_dot, SymbolicZero):
        product_dot = product_dot + _gathered_product(values_dot, columns, x)
    return product, product_dot
