"""Index maps of the sparse coupling between the leaves and the rest (host, NumPy).

Leaves, the fronts of the lowest stage, are coupled to later unknowns by entries of the matrix
itself. Both sides are numbered by position (see `layout.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxcontact.linear.dissection.layout import Stage, Unknowns, int32


class CouplingPlan(NamedTuple):
    """Index maps (int32) of the matrix entries that couple P positions to the other side.

    The positions are those of the leaves or those of the rest, each with up to w entries.
    """

    entries: np.ndarray
    """Place of each entry in the matrix values, (w, P); one behind them if there is none."""
    columns: np.ndarray
    """Position of its column, counted from the first of the other side, (w, P)."""


def couple_leaves(
    stages: Sequence[Stage], unknowns: Unknowns, position: np.ndarray, columns: np.ndarray
) -> tuple[CouplingPlan, CouplingPlan]:
    """Return the matrix entries in rows of the rest and columns of the leaves, and the transpose.

    Args:
        stages: stages from the root to the lowest, the leaves.
        unknowns: where each unknown is eliminated.
        position: position of each unknown, (n,).
        columns: (width, n) columns of the matrix.
    """
    n_rest, n_positions = stages[-2].n_positions, stages[-1].n_positions
    is_leaf = unknowns.stage == len(stages) - 1

    def coupling(
        is_row: np.ndarray, first_row: int, n_rows: int, first_column: int
    ) -> CouplingPlan:
        """Take the entries in rows of one side, (n,) bool, and columns of the other.

        Both sides are ranges of positions; positions of padding keep no entry.
        """
        width, n = columns.shape
        is_entry = is_row & ~is_row[columns]
        rows = np.flatnonzero(is_row)
        count = is_entry[:, rows].sum(0)
        # The slots of the entries first, in every row; then as many rows of slots as any needs.
        slot = np.argsort(~is_entry[:, rows], axis=0, kind="stable")[: count.max(initial=1)]
        is_filled = np.arange(len(slot))[:, None] < count
        entries = np.full((len(slot), n_rows), width * n)
        entries[:, position[rows] - first_row] = np.where(is_filled, slot * n + rows, width * n)
        column = np.zeros_like(entries)
        other = position[columns[slot, rows]] - first_column
        column[:, position[rows] - first_row] = np.where(is_filled, other, 0)
        return CouplingPlan(int32(entries), int32(column))

    to_rest = coupling(~is_leaf, 0, n_rest, n_rest)
    to_leaves = coupling(is_leaf, n_rest, n_positions - n_rest, 0)
    return to_rest, to_leaves
