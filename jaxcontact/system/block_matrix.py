"""Sparse matrices of d x d blocks, one per pair of nodes, for building matrices once.

Patterns are concrete; blocks may be traced, and are NumPy where they are concrete, since dozens of
small operations that run once are not worth compiling. Only what the construction of a singular
mass matrix needs: product, transpose, sum, and the way from and to `SymmetricMatrix`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.system.sparse import SymmetricMatrix


class BlockMatrix(NamedTuple):
    """Entries of a sparse block matrix; each position occurs once or more and entries add up."""

    rows: np.ndarray
    """Node of the row of each entry, (Z,) int."""

    columns: np.ndarray
    """Node of the column of each entry, (Z,) int."""

    blocks: Array | np.ndarray
    """Entries, (Z, d, d)."""

    def transpose(self) -> BlockMatrix:
        """Return the transpose."""
        return BlockMatrix(self.columns, self.rows, self.blocks.swapaxes(1, 2))

    def __matmul__(self, other: BlockMatrix) -> BlockMatrix:
        """Return the product, each position once."""
        by_row = np.argsort(other.rows, kind="stable")
        first = np.searchsorted(other.rows[by_row], self.columns, side="left")
        last = np.searchsorted(other.rows[by_row], self.columns, side="right")
        left = np.repeat(np.arange(self.rows.size), last - first)
        starts = np.cumsum(last - first) - (last - first)
        right = by_row[np.arange(left.size) - np.repeat(starts - first, last - first)]
        blocks = on_host(self.blocks)[left] @ on_host(other.blocks)[right]
        return _sum_duplicates(self.rows[left], other.columns[right], blocks)

    def plus(self, other: BlockMatrix) -> BlockMatrix:
        """Return the sum, each position once."""
        return _sum_duplicates(
            np.concatenate([self.rows, other.rows]),
            np.concatenate([self.columns, other.columns]),
            concatenate(self.blocks, other.blocks),
        )

    def scaled(self, factor: Array | float) -> BlockMatrix:
        """Return the matrix times a number."""
        return self._replace(blocks=on_host(factor * self.blocks))

    def to_symmetric(self, n_nodes: int) -> SymmetricMatrix:
        """Return the matrix, which must be symmetric with each position once, in ELL layout."""
        order = np.argsort(self.rows, kind="stable")
        rows, columns = self.rows[order], self.columns[order]
        slots = np.arange(rows.size) - np.searchsorted(rows, rows, side="left")
        width, d = int(slots.max(initial=0)) + 1, self.blocks.shape[-1]
        nodes = np.tile(np.arange(n_nodes), (width, 1))
        nodes[slots, rows] = columns
        blocks = scatter(self.blocks[order], slots * n_nodes + rows, width * n_nodes)
        blocks = blocks.reshape(width, n_nodes, d, d)  # (slot, row, i, j)
        values = blocks.transpose(0, 3, 1, 2).reshape(width * d, n_nodes * d)
        return SymmetricMatrix(jnp.asarray(values), nodes.astype(np.int32))


def from_symmetric(matrix: SymmetricMatrix, dimension: int) -> BlockMatrix:
    """Return a matrix that was assembled from nodal blocks (d, d) as a block matrix."""
    d, n_nodes = dimension, matrix.size // dimension
    nodes = np.asarray(matrix.columns)
    width = nodes.shape[0]
    blocks = (
        on_host(matrix.values).reshape(width, d, n_nodes, d).transpose(0, 2, 3, 1)
    )  # (slot, row, i, j)
    rows = np.broadcast_to(np.arange(n_nodes), (width, n_nodes))
    # Padded slots name their own row and hold zeros, so they only add zeros to the diagonal.
    return _sum_duplicates(rows.ravel(), nodes.ravel(), blocks.reshape(-1, d, d))


def on_host(values: Array | np.ndarray) -> Array | np.ndarray:
    """Return a NumPy array if the values are concrete."""
    return values if isinstance(values, Tracer) else np.asarray(values)


def concatenate(*parts: Array | np.ndarray, axis: int = 0) -> Array | np.ndarray:
    """Return the parts one after the other."""
    is_traced = any(isinstance(part, Tracer) for part in parts)
    return jnp.concatenate(parts, axis) if is_traced else np.concatenate(parts, axis)


def scatter(blocks: Array | np.ndarray, positions: np.ndarray, count: int) -> Array | np.ndarray:
    """Return (count, ...), the sums of the blocks (B, ...) that share a position."""
    if isinstance(blocks, Tracer):
        return jnp.zeros((count, *blocks.shape[1:]), blocks.dtype).at[positions].add(blocks)
    sums = np.zeros((count, *blocks.shape[1:]), blocks.dtype)
    np.add.at(sums, positions, blocks)
    return sums


def _sum_duplicates(
    rows: np.ndarray, columns: np.ndarray, blocks: Array | np.ndarray
) -> BlockMatrix:
    keys = rows.astype(np.int64) * (columns.max(initial=0) + 1) + columns
    unique, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return BlockMatrix(rows[first], columns[first], scatter(blocks, inverse, unique.size))
