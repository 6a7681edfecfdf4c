"""The product with a sparse symmetric matrix, as a primitive that knows its own transpose.

    y_i = sum_j values[j, i] x[columns[j, i]],

each entry a block of d x d components, is bilinear in entries and vector. Its transpose by x is the
same product, because the matrix is symmetric, and its transpose by the entries is an outer product
on the sparsity pattern; plain autodiff would turn the gathers into scatter-adds. Being a primitive,
it has every order and mode of differentiation.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

MAX_UNROLLED = 4
"""Columns that are summed one by one: for a reduction over a few, XLA's CPU compiler calls a
library that is ten times slower."""

_product = Primitive("symmetric_product")


def symmetric_product(values: Array, columns: Array | np.ndarray, x: Array) -> Array:
    """Return the product of a symmetric matrix in padded ELL layout with a vector or a matrix.

    Args:
        values: entries, (width d, n): component j of a column and i of a row at (j, i) of a block.
        columns: column of each block, (width, n/d) int32; the quotient of the shapes gives d.
        x: vector (n,) or columns (n, r).

    Derivative: of any order, with respect to x and to the entries. Tangents of the entries must be
    symmetric; cotangents of entries (i, j) and (j, i) are apart, as if they were independent.
    """
    dtype = jnp.result_type(values, x)
    values, x = jnp.asarray(values, dtype), jnp.asarray(x, dtype)
    return _product.bind(values, columns, x, is_transposed=False)


def outer_on_pattern(columns: Array | np.ndarray | None, left: Array, right: Array) -> Array:
    """Return left_i right_j on a sparsity pattern, (width d, n): the cotangent of the entries.

    Args:
        columns: column of each block, (width, n/d) int32; None is dense.
        left: vector (n,) or columns (n, r), which are summed.
        right: like left.
    """
    if columns is None:
        return jnp.outer(left, right) if left.ndim == 1 else left @ right.T
    n, n_nodes = left.shape[0], columns.shape[1]
    left, right = (x.reshape(n_nodes, n // n_nodes, -1) for x in (left, right))
    right = jnp.swapaxes(take(right, columns), 1, 2)[:, :, :, None]
    left = left[None, None]  # (slot, column component, row, row component, r), as right
    r = left.shape[-1]
    if r <= MAX_UNROLLED:
        products = [right[..., k] * left[..., k] for k in range(r)]
        outer = sum(products[1:], products[0])
    else:
        outer = jnp.sum(right * left, axis=-1)
    return outer.reshape(-1, n)


def take(x: Array, index: Array | np.ndarray) -> Array:
    """Return x[index] along the first axis for an index that is known to be in bounds."""
    return x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def materialize(x: Array, zero: Array) -> Array:
    """Return x as a buffer of its own.

    XLA fuses the producer of a vector into every gather from it, some thirty scattered reads per
    entry. It drops optimization barriers on CPUs; an update at an index that it does not know
    stops it.

    Args:
        x: vector (n,) or columns (n, r).
        zero: 0, () int32, as a number that the compiler cannot know.
    """
    return jax.lax.dynamic_update_slice_in_dim(x, x[:1], zero, axis=0)


def _gathered_product(values: Array, columns: Array | np.ndarray, x: Array) -> Array:
    """Return sum_j values[j] * x[columns[j]]; the loop over the short rows is unrolled."""
    width, n_nodes = columns.shape
    d = values.shape[1] // n_nodes
    # Without the barrier XLA recomputes the producer of x inside every one of the gathers.
    x = jax.lax.optimization_barrier(x)
    product = jnp.zeros((), x.dtype)
    if x.ndim == 1 and d > 1:
        # One loop over all unknowns, on CPUs faster than one over d x d blocks.
        for j in range(width):
            first = jnp.broadcast_to(columns[j][:, None] * d, (n_nodes, d)).reshape(-1)
            for component in range(d):
                product = product + values[j * d + component] * take(x, first + component)
        return product
    nodal = x.reshape(n_nodes, d, *x.shape[1:])
    blocks = values.reshape(width, d, n_nodes, d, *(1 for _ in x.shape[1:]))
    for j in range(width):
        neighbour = take(nodal, columns[j])
        for component in range(d):
            product = product + blocks[j, component] * neighbour[:, component : component + 1]
    return product.reshape(x.shape)


def _jvp(primals, tangents, *, is_transposed):
    values, columns, x = primals
    values_dot, _, x_dot = tangents
    product = partial(_product.bind, is_transposed=is_transposed)
    terms = []
    if not isinstance(x_dot, ad.Zero):
        terms.append(product(values, columns, x_dot))
    if not isinstance(values_dot, ad.Zero):
        terms.append(product(values_dot, columns, x))
    return product(values, columns, x), sum(terms[1:], terms[0])


def _transpose(cotangent, values, columns, x, *, is_transposed):
    if isinstance(cotangent, ad.Zero):
        return None, None, None
    if ad.is_undefined_primal(x):
        product = _product.bind(values, columns, cotangent, is_transposed=not is_transposed)
        return None, None, product
    # Not fused into the gathers, see `_gathered_product`.
    left, right = jax.lax.optimization_barrier((cotangent, x))
    if is_transposed:
        left, right = right, left
    return outer_on_pattern(columns, left, right), None, None


def _batch(arguments, axes, *, is_transposed):
    values, columns, x = arguments
    values_axis, columns_axis, x_axis = axes
    if values_axis is None and columns_axis is None:
        # One product with more columns, which reads the entries once.
        x = jnp.moveaxis(x, x_axis, -1)
        zero = jnp.minimum(columns[0, 0], 0)
        x_columns = materialize(x.reshape(x.shape[0], -1), zero)
        product = _product.bind(values, columns, x_columns, is_transposed=is_transposed)
        return product.reshape(x.shape), x.ndim - 1
    return jax.vmap(_gathered_product, in_axes=axes)(values, columns, x), 0


def _evaluate(values, columns, x, *, is_transposed):
    # Entries of a symmetric matrix: its transpose is the same product.
    del is_transposed
    return _gathered_product(values, columns, x)


_product.def_impl(jax.jit(_evaluate, static_argnames="is_transposed"))
_product.def_abstract_eval(lambda values, columns, x, **_: ShapedArray(x.shape, x.dtype))
ad.primitive_jvps[_product] = _jvp
ad.primitive_transposes[_product] = _transpose
batching.primitive_batchers[_product] = _batch
mlir.register_lowering(_product, mlir.lower_fun(_evaluate, multiple_results=False))
