"""Index maps of the batches of fronts (host, NumPy).

For every stage this file lists its items, one after the other, each with its front and its place
in the front: own unknowns, boundary unknowns, matrix entries, and what the children contribute. A
batch then takes the items of its own fronts. A front counts its positions from its own unknowns,
0 .. s, to its boundary, s .. s + b; both sizes are those of the batch, padding included.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxcontact.linear.dissection.layout import Stage, Unknowns, int32


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


def lay_out(
    stages: Sequence[Stage],
    unknowns: Unknowns,
    position: np.ndarray,
    columns: np.ndarray,
    with_leaves: bool,
) -> tuple[tuple[BatchPlan, ...], ...]:
    """Return the batches of every stage, the lowest first.

    Args:
        stages: stages from the root to the lowest.
        unknowns: where each unknown is eliminated.
        position: position of each unknown, (n,).
        columns: (width, n) columns of the matrix.
        with_leaves: whether the lowest stage are leaves.
    """
    lowest = len(stages) - 1
    batches = []
    for number, stage in enumerate(stages):
        children = stages[number + 1] if number < lowest else None
        own = _own_unknowns(number, unknowns)
        boundary = _boundary_positions(stage, position)
        entries = _entries(number, stage, unknowns, columns)
        contributions = _contributions(number, stage, children, unknowns)
        # Leaves act on later unknowns by the matrix itself: their Schur complements count, their
        # updates do not exist.
        has_updates = not (with_leaves and number == lowest - 1)
        labels = range(stage.batch.max() + 1)
        batches.append(
            tuple(
                _batch_plan(stage, label, own, boundary, entries, contributions, has_updates)
                for label in labels
            )
        )
    return tuple(batches[::-1])


class _Places(NamedTuple):
    """What lies at K places of the fronts of a stage, (K,) each."""

    front: np.ndarray
    local: np.ndarray
    """Column of the place in a table with one row per front."""
    value: np.ndarray


class _Entries(NamedTuple):
    """Matrix entries that are assembled at a stage, (K,) each."""

    front: np.ndarray
    row: np.ndarray
    """Position in the front: own unknowns at 0 .. s, the boundary behind them."""
    column: np.ndarray
    """Position among the own unknowns."""
    value: np.ndarray
    """Place in the matrix values."""


class _Contributions(NamedTuple):
    """The boundary unknowns of all J children of each front, (K,) each."""

    children: Stage | None
    """The earlier stage; None for the lowest."""
    n_children: int
    """J; front f has the children J f .. J f + J - 1."""
    front: np.ndarray
    """The parent, which has every boundary unknown of its children as own or boundary unknown."""
    local: np.ndarray
    """Position in the parent."""
    sibling: np.ndarray
    """Number of the child, below J."""
    child_local: np.ndarray
    """Position in the boundary of the child."""
    source: np.ndarray
    """Place in the update of the earlier stage."""


def _own_unknowns(number: int, unknowns: Unknowns) -> _Places:
    """Own unknowns of the fronts of a stage: each unknown of the stage once."""
    here = np.flatnonzero(unknowns.stage == number)
    return _Places(unknowns.front[here], unknowns.local[here], here)


def _boundary_positions(stage: Stage, position: np.ndarray) -> _Places:
    """Boundary of the fronts of a stage by position: in the order of elimination."""
    front = stage.keys // len(position)
    return _Places(front, _rank_in_boundary(stage, front), position[stage.unknowns])


def _rank_in_boundary(stage: Stage, front: np.ndarray) -> np.ndarray:
    """Count the boundary unknowns of each front from zero; keys are sorted by front."""
    starts = np.cumsum(stage.n_boundary) - stage.n_boundary
    return np.arange(len(front)) - starts[front]


def _entries(number: int, stage: Stage, unknowns: Unknowns, columns: np.ndarray) -> _Entries:
    """Entries that couple own unknowns of a stage to own or later ones.

    An entry is assembled where the first of its two unknowns is eliminated; its transpose in the
    row of the later unknown is left out, so that each coupling counts once.
    """
    n = columns.shape[1]
    here = np.flatnonzero(unknowns.stage == number)
    own = np.broadcast_to(here, (len(columns), len(here))).ravel()
    other = columns[:, here].ravel()
    value = (np.arange(len(columns))[:, None] * n + here).ravel()
    is_own_or_later = unknowns.stage[other] <= number
    own, other, value = own[is_own_or_later], other[is_own_or_later], value[is_own_or_later]
    front = unknowns.front[own]
    row = _position(number, stage, unknowns, front, other)
    return _Entries(front, row, unknowns.local[own], value)


def _contributions(
    number: int, stage: Stage, children: Stage | None, unknowns: Unknowns
) -> _Contributions:
    """Where the boundary unknowns of the children are found in their parents."""
    if children is None:
        nothing = np.zeros(0, np.int64)
        return _Contributions(None, 0, nothing, nothing, nothing, nothing, nothing)
    n_children = len(children.s) // len(stage.s)
    child = children.keys // len(unknowns.stage)
    child_local = _rank_in_boundary(children, child)
    parent = child // n_children
    return _Contributions(
        children=children,
        n_children=n_children,
        front=parent,
        local=_position(number, stage, unknowns, parent, children.unknowns),
        sibling=child - parent * n_children,
        child_local=child_local,
        source=children.update[child] + child_local,
    )


def _position(
    number: int, stage: Stage, unknowns: Unknowns, front: np.ndarray, unknown: np.ndarray
) -> np.ndarray:
    """Position of unknowns in fronts, (K,): among the own unknowns, or behind them.

    A boundary unknown is found by its key, since the keys of a stage are sorted.
    """
    starts = np.cumsum(stage.n_boundary) - stage.n_boundary
    found = np.searchsorted(stage.keys, front * len(unknowns.rank) + unknowns.rank[unknown])
    is_own = unknowns.stage[unknown] == number
    return np.where(is_own, unknowns.local[unknown], stage.s[front] + found - starts[front])


def _batch_plan(
    stage: Stage,
    label: int,
    own: _Places,
    boundary: _Places,
    entries: _Entries,
    contributions: _Contributions,
    has_updates: bool,
) -> BatchPlan:
    """Return the index maps of one batch: of all items of the stage, those in its fronts."""
    fronts = np.flatnonzero(stage.batch == label)
    n_fronts, s, b = len(fronts), int(stage.s[fronts[0]]), int(stage.b[fronts[0]])

    def mine(items: _Places | _Entries | _Contributions) -> tuple[np.ndarray, np.ndarray]:
        """Return which items lie in the batch, (K',), and the number of their front in it."""
        chosen = np.flatnonzero(stage.batch[items.front] == label)
        return chosen, stage.index[items.front[chosen]]

    own_table, is_padding = np.zeros((n_fronts, s), np.int32), np.ones((n_fronts, s), bool)
    chosen, row = mine(own)
    own_table[row, own.local[chosen]] = own.value[chosen]
    is_padding[row, own.local[chosen]] = False

    boundary_table = np.zeros((n_fronts, b), np.int32)
    chosen, row = mine(boundary)
    boundary_table[row, boundary.local[chosen]] = boundary.value[chosen]

    # Own columns (F, s + b, s), flat.
    chosen, row = mine(entries)
    target = (row * (s + b) + entries.row[chosen]) * s + entries.column[chosen]
    entry_table = np.stack([entries.value[chosen], target])

    # Positions (F, s + b), flat for the sources.
    chosen, row = mine(contributions)
    local, n_children = contributions.local[chosen], contributions.n_children
    child_position = np.full((n_children, n_fronts, s + b), -1, np.int32)
    child_position[contributions.sibling[chosen], row, local] = contributions.child_local[chosen]
    target, source = row * (s + b) + local, contributions.source[chosen]
    if not has_updates:
        target, source = target[:0], source[:0]

    children = stage if contributions.children is None else contributions.children
    siblings = fronts[None, :] * n_children + np.arange(n_children)[:, None]
    sources = _by_multiplicity(target, source, n_fronts * (s + b), children.n_updates)
    return BatchPlan(
        own=own_table,
        is_padding=is_padding,
        boundary=boundary_table,
        sources=sources.reshape(len(sources), n_fronts, s + b),
        entries=int32(entry_table),
        child_base=int32(children.schur[siblings]),
        child_stride=int32(children.b[siblings]),
        child_position=child_position,
    )


def _by_multiplicity(
    target: np.ndarray, source: np.ndarray, n_targets: int, nothing: int
) -> np.ndarray:
    """Return a table (K, n_targets) of the sources of each target, filled up with `nothing`.

    Row k holds the k-th source of every target, so that a sum over rows is a sum of gathers.
    """
    order = np.argsort(target, kind="stable")
    target, source = target[order], source[order]
    turn = np.arange(len(target)) - np.searchsorted(target, target)
    table = np.full((turn.max(initial=-1) + 1, n_targets), nothing, np.int32)
    table[turn, target] = source
    return table
