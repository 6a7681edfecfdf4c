"""Index maps of a multifrontal factorisation (host, NumPy).

The elimination runs through stages. At each stage the unknowns eliminated together form *fronts*,
each with s own unknowns and b boundary unknowns (later unknowns coupled to them), and fronts of
similar size form a batch, padded to one size. From the stages this file derives where everything
lies: unknowns in fronts, contributions of the children in their parents, and matrix entries in
front matrices.

The updates (boundary values of all fronts) of one stage are stored one after the other with one
zero behind them, the place of every contribution that does not exist; so are its Schur complements.
The own values of all fronts are stored one after the other, from the root to the lowest stage: the
*positions*. Where the lowest stage are *leaves*, they act on later unknowns by the sparse matrix
itself and pass no updates on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class BatchPlan(NamedTuple):
    """Index maps (int32) of F fronts of one stage, padded to s own and b boundary unknowns."""

    own: np.ndarray
    """Unknown of each own position, (F, s); padding repeats unknown 0."""
    is_padding: np.ndarray
    """True where an own position is padding, (F, s) bool."""
    boundary: np.ndarray
    """Position of each boundary unknown, (F, b)."""
    sources: np.ndarray
    """Places in the update of the earlier stage that add up in each position, (K, F, s + b); none
    for the leaves and above them."""
    entries: np.ndarray
    """Places in the matrix values and in the own columns (F, s + b, s) they belong to, (2, E)."""
    child_base: np.ndarray
    """Place of the Schur complement of each of the J children, (J, F)."""
    child_stride: np.ndarray
    """Row length of that Schur complement, (J, F)."""
    child_position: np.ndarray
    """Position of each position in the child's boundary, (J, F, s + b); -1 if it is not there."""


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


def round_up(n_own):
    """Return the number of own unknowns that a front is padded to.

    The product with V^T works on rows of that length: whole vector registers double its speed.
    """
    return -(-n_own // 4) * 4


def make_stage(n_own, n_boundary, batch, keys, unknowns, first_position) -> Stage:
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

    def offsets(length):
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


def positions(stages, unknowns) -> np.ndarray:
    """Position of each unknown, (n,)."""
    position = np.empty(len(unknowns.stage), np.int64)
    for number, stage in enumerate(stages):
        here = np.flatnonzero(unknowns.stage == number)
        position[here] = stage.position[unknowns.front[here]] + unknowns.local[here]
    return position


def lay_out(stages, unknowns, position, columns, with_leaves) -> tuple[tuple[BatchPlan, ...], ...]:
    """Return the batches of every stage, the lowest first.

    Args:
        stages: stages from the root to the lowest.
        unknowns: where each unknown is eliminated.
        position: position of each unknown, (n,).
        columns: (width, n) columns of the matrix.
        with_leaves: whether the lowest stage are leaves.
    """
    above_leaves = len(stages) - 2 if with_leaves else -1
    batches = [
        tuple(_stage_batches(stages, number, unknowns, position, columns, number == above_leaves))
        for number in range(len(stages))
    ]
    return tuple(batches[::-1])


def _stage_batches(stages, number, unknowns, position, columns, is_above_leaves):
    stage = stages[number]
    n = columns.shape[1]
    here = np.flatnonzero(unknowns.stage == number)
    boundary_front = stage.keys // n
    starts = np.cumsum(stage.n_boundary) - stage.n_boundary
    boundary_local = np.arange(len(stage.keys)) - starts[boundary_front]
    entry_front, entry_row, entry_column, entry_value = _entries(number, stage, unknowns, columns)
    if number == len(stages) - 1:
        child = stage._replace(keys=stage.keys[:0], unknowns=stage.unknowns[:0], n_updates=0)
        n_children = 0
    else:
        child = stages[number + 1]
        n_children = len(child.s) // len(stage.s)
    child_front = child.keys // n
    child_starts = np.cumsum(child.n_boundary) - child.n_boundary
    child_local = np.arange(len(child.keys)) - child_starts[child_front]
    parent = child_front // max(n_children, 1)
    parent_local = _position(number, stage, unknowns, parent, child.unknowns, n)
    for label in range(stage.batch.max() + 1):
        fronts = np.flatnonzero(stage.batch == label)
        n_fronts, s, b = len(fronts), stage.s[fronts[0]], stage.b[fronts[0]]
        own = np.zeros((n_fronts, s), np.int32)
        is_padding = np.ones((n_fronts, s), bool)
        mine = here[stage.batch[unknowns.front[here]] == label]
        slot = stage.index[unknowns.front[mine]], unknowns.local[mine]
        own[slot], is_padding[slot] = mine, False

        boundary = np.zeros((n_fronts, b), np.int32)
        mine = np.flatnonzero(stage.batch[boundary_front] == label)
        slot = stage.index[boundary_front[mine]], boundary_local[mine]
        boundary[slot] = position[stage.unknowns[mine]]

        mine = np.flatnonzero(stage.batch[entry_front] == label)
        target = stage.index[entry_front[mine]] * (s + b) + entry_row[mine]
        entries = np.stack([entry_value[mine], target * s + entry_column[mine]])

        mine = np.flatnonzero(stage.batch[parent] == label)
        child_position = np.full((n_children, n_fronts, s + b), -1, np.int32)
        slot = stage.index[parent[mine]], parent_local[mine]
        number_of_child = child_front[mine] - parent[mine] * n_children
        child_position[number_of_child, *slot] = child_local[mine]
        if is_above_leaves:
            mine = mine[:0]
        target = stage.index[parent[mine]] * (s + b) + parent_local[mine]
        source = child.update[child_front[mine]] + child_local[mine]
        sources = _by_multiplicity(target, source, n_fronts * (s + b), child.n_updates)
        siblings = fronts[None, :] * n_children + np.arange(n_children)[:, None]
        yield BatchPlan(
            own=own,
            is_padding=is_padding,
            boundary=boundary,
            sources=sources.reshape(-1, n_fronts, s + b),
            entries=int32(entries),
            child_base=int32(child.schur[siblings]),
            child_stride=int32(child.b[siblings]),
            child_position=child_position,
        )


def _entries(number, stage, unknowns, columns):
    """Matrix entries assembled at a stage: front, row and column in it, place in the values."""
    n = columns.shape[1]
    here = np.flatnonzero(unknowns.stage == number)
    rows = np.broadcast_to(here, (len(columns), len(here))).ravel()
    others = columns[:, here].ravel()
    value = (np.arange(len(columns))[:, None] * n + here).ravel()
    keep = unknowns.stage[others] <= number
    rows, others, value = rows[keep], others[keep], value[keep]
    front = unknowns.front[rows]
    return front, _position(number, stage, unknowns, front, others, n), unknowns.local[rows], value


def _position(number, stage, unknowns, front, unknown, n):
    """Position of an unknown in a front: among its own unknowns or behind them in the boundary."""
    starts = np.cumsum(stage.n_boundary) - stage.n_boundary
    found = np.searchsorted(stage.keys, front * n + unknowns.rank[unknown])
    is_own = unknowns.stage[unknown] == number
    return np.where(is_own, unknowns.local[unknown], stage.s[front] + found - starts[front])


def _by_multiplicity(target, source, n_targets, nothing):
    """Table (K, n_targets) of the sources of each target, filled up with `nothing`."""
    order = np.argsort(target, kind="stable")
    target, source = target[order], source[order]
    turn = np.arange(len(target)) - np.searchsorted(target, target)
    table = np.full((turn.max(initial=-1) + 1, n_targets), nothing, np.int32)
    table[turn, target] = source
    return table


def int32(index):
    """Return an index as int32.

    Raises:
        ValueError: if it is too large.
    """
    if index.size and index.max() > np.iinfo(np.int32).max:
        raise ValueError(
            "the factor is too large for 32-bit indices; solve this problem by conjugate gradients"
        )
    return index.astype(np.int32)
