"""Stages of a multifrontal factorisation and where everything lies in them (host, NumPy).

The elimination runs through stages. At each stage the unknowns eliminated together form *fronts*,
each with s own unknowns and b boundary unknowns (later unknowns coupled to them), and fronts of
similar size form a batch, padded to one size.

The updates (boundary values of all fronts) of one stage are stored one after the other with one
zero behind them, the place of every contribution that does not exist; so are its Schur complements.
The own values of all fronts are stored one after the other, from the root to the lowest stage: the
*positions*. `batches.py` makes the index maps of the sweeps from this.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Stage(NamedTuple):
    """The fronts of one stage: sizes, batches and offsets, (F,) each; and their boundaries."""

    n_own: np.ndarray
    n_boundary: np.ndarray
    batch: np.ndarray
    index: np.ndarray
    """Number of the front in its batch."""
    s: np.ndarray
    b: np.ndarray
    update: np.ndarray
    """Place of the first boundary value in the update of the stage."""
    n_updates: int
    schur: np.ndarray
    """Place of the Schur complement among those of the stage."""
    n_schur: int
    position: np.ndarray
    """Position of the first own unknown."""
    n_positions: int
    """Positions of this stage and of those nearer to the root."""
    keys: np.ndarray
    """front * n + rank of each boundary unknown, ascending."""
    unknowns: np.ndarray
    """The boundary unknowns in the order of the keys."""


class Unknowns(NamedTuple):
    """Where each unknown is eliminated, (n,) each; stages are numbered from the root."""

    stage: np.ndarray
    front: np.ndarray
    local: np.ndarray
    """Position among the own unknowns of its front."""
    rank: np.ndarray
    """Place in the order of elimination."""


def round_up(n_own: np.ndarray) -> np.ndarray:
    """Return the number of own unknowns that fronts are padded to, (F,).

    The product with V^T works on rows of that length: whole vector registers double its speed.
    """
    return -(-n_own // 4) * 4


def make_stage(
    n_own: np.ndarray,
    n_boundary: np.ndarray,
    batch: np.ndarray,
    keys: np.ndarray,
    unknowns: np.ndarray,
    first_position: int,
) -> Stage:
    """Lay out the fronts of one stage.

    Args:
        n_own: own unknowns of each front, (F,).
        n_boundary: boundary unknowns of each front, (F,).
        batch: batch of each front, (F,).
        keys: front * n + rank of each boundary unknown, ascending.
        unknowns: boundary unknowns in the same order.
        first_position: positions taken by the stages nearer to the root.
    """
    s_max = np.zeros(batch.max() + 1, np.int64)
    b_max = np.zeros(batch.max() + 1, np.int64)
    np.maximum.at(s_max, batch, n_own)
    np.maximum.at(b_max, batch, n_boundary)
    s, b = round_up(s_max)[batch], b_max[batch]
    order = np.argsort(batch, kind="stable")
    index = np.empty_like(batch)
    index[order] = np.arange(len(batch)) - np.searchsorted(batch[order], batch[order])

    # Batches lie one after the other, and so do the fronts of a batch.
    def offsets(length: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the place of each front, (F,), and the total length."""
        place = np.empty_like(length)
        ends = np.cumsum(length[order])
        place[order] = ends - length[order]
        return place, int(ends[-1])

    update, n_updates = offsets(b)
    schur, n_schur = offsets(b * b)
    position, n_positions = offsets(s)
    return Stage(
        n_own=n_own,
        n_boundary=n_boundary,
        batch=batch,
        index=index,
        s=s,
        b=b,
        update=update,
        n_updates=n_updates,
        schur=schur,
        n_schur=n_schur,
        position=position + first_position,
        n_positions=n_positions + first_position,
        keys=keys,
        unknowns=unknowns,
    )


def positions(stages: Sequence[Stage], unknowns: Unknowns) -> np.ndarray:
    """Return the position of each unknown, (n,)."""
    position = np.empty(len(unknowns.stage), np.int64)
    for number, stage in enumerate(stages):
        here = np.flatnonzero(unknowns.stage == number)
        position[here] = stage.position[unknowns.front[here]] + unknowns.local[here]
    return position


def int32(index: np.ndarray) -> np.ndarray:
    """Return an index as int32.

    Raises:
        ValueError: if it is too large.
    """
    if index.size and index.max() > np.iinfo(np.int32).max:
        raise ValueError(
            "the factor is too large for 32-bit indices; solve this problem by conjugate gradients"
        )
    return index.astype(np.int32)
