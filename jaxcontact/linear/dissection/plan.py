"""Symbolic factorisation for nested dissection (host, NumPy): fronts, batches and index maps.

The nodes that one part of the separator tree eliminates at one stage are a *front* with s own
unknowns and b boundary unknowns (later unknowns coupled to it).

Source: J. Liu, The multifrontal method for sparse matrix solution, SIAM Review 34 (1992).
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from typing import NamedTuple

import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.linear.dissection.batches import BatchPlan, lay_out
from jaxcontact.linear.dissection.layout import Stage, Unknowns, make_stage, positions
from jaxcontact.linear.dissection.leaves import CouplingPlan, couple_leaves
from jaxcontact.linear.dissection.order import Dissection, dissect, hop_coordinates
from jaxcontact.linear.dissection.stages import (
    Tree,
    cost_of_batch,
    merge_depths,
    own_size,
    split_into_batches,
)


class DissectionPlan(NamedTuple):
    """Everything about a factorisation that the sparsity pattern decides."""

    stages: tuple[tuple[BatchPlan, ...], ...]
    """Batches of each stage, from the bottom; the last is the root (one front)."""
    couplings: tuple[CouplingPlan, ...]
    """Matrix entries in rows of the rest and columns of the first stage, and the transpose, if that
    stage are leaves; else empty."""
    unknown_of_position: np.ndarray
    """Unknown at each position, (P,) int32; padding repeats unknown 0."""
    position_of_unknown: np.ndarray
    """Position of each unknown, root first, (n,) int32."""
    contact_places: np.ndarray
    """Position of each contact unknown in the root front, (C, k) int32."""
    n_factor_entries: int
    """Entries of the factor's lower triangle without any padding."""
    n_stored: int
    """Numbers stored by the factor, padding and contact included."""


def stored_bytes(plan: DissectionPlan, itemsize: int) -> int:
    """Return the bytes of a factor with numbers of `itemsize` bytes, index maps included."""
    maps = [plan.unknown_of_position, plan.position_of_unknown]
    for stage in plan.stages:
        maps += [x for batch in stage for x in (batch.boundary, batch.sources)]
    maps += [coupling.columns for coupling in plan.couplings]
    return plan.n_stored * itemsize + sum(x.nbytes for x in maps)


_PLANS: OrderedDict[bytes, DissectionPlan] = OrderedDict()
_MAX_PLANS = 8


def plan_for(
    columns: Array | np.ndarray,
    unknowns: Array | np.ndarray,
    coordinates: Array | np.ndarray | None,
    leaf_size: int,
) -> DissectionPlan:
    """Return the plan of a sparsity pattern, from the last few plans if it is among them.

    Args:
        columns: (width, n) columns of the matrix, padded by the own row.
        unknowns: (C, k) contact unknowns, eliminated last.
        coordinates: (n, d) positions of the unknowns, or None.
        leaf_size: largest number of unknowns in a leaf of the separator tree.

    Raises:
        ValueError: if one of the arrays is traced.
    """
    if any(isinstance(x, Tracer) for x in (columns, unknowns, coordinates)):
        raise ValueError(
            "nested dissection orders the unknowns on the host, but the sparsity pattern or the "
            "coordinates are traced; build the system outside jit and pass the values in"
        )
    columns, unknowns = np.asarray(columns, np.int32), np.asarray(unknowns, np.int32)
    key = hashlib.blake2b(repr((columns.shape, unknowns.shape, leaf_size)).encode())
    key.update(columns.tobytes())
    key.update(unknowns.tobytes())
    if coordinates is not None:
        coordinates = np.asarray(coordinates, float)
        key.update(coordinates.tobytes())
    digest = key.digest()
    if digest not in _PLANS:
        _PLANS[digest] = build_plan(columns, unknowns, coordinates, leaf_size)
        while len(_PLANS) > _MAX_PLANS:
            _PLANS.popitem(last=False)
    _PLANS.move_to_end(digest)
    return _PLANS[digest]


def build_plan(
    columns: np.ndarray,
    unknowns: np.ndarray,
    coordinates: np.ndarray | None,
    leaf_size: int,
) -> DissectionPlan:
    """Order the unknowns and lay out the factorisation.

    Args:
        columns: (width, n) columns of the matrix, padded by the own row.
        unknowns: (C, k) contact unknowns, eliminated last.
        coordinates: (n, d) positions of the unknowns, or None.
        leaf_size: largest number of unknowns in a leaf of the separator tree.
    """
    n = columns.shape[1]
    is_contact = np.zeros(n, bool)
    is_contact[unknowns] = True
    # The components of a mesh node have identical rows: their graph is d^2 times smaller.
    node, first = _group(columns, is_contact)
    sizes = np.bincount(node)
    tails = np.broadcast_to(np.arange(len(first)), (len(columns), len(first))).ravel()
    pairs = np.unique(tails * len(first) + node[columns[:, first]].ravel())
    edges = np.stack([pairs // len(first), pairs % len(first)], 1)
    half = edges[edges[:, 0] < edges[:, 1]]
    if coordinates is None:
        points = hop_coordinates(half, len(first))
    else:
        points = coordinates[first]
    tree = _eliminate(dissect(half, points, sizes, is_contact[first], leaf_size), edges, sizes)
    heads, with_leaves = merge_depths(tree)
    where = _locate(tree, heads, node)
    stages: list[Stage] = []
    for head, end in zip(heads, [*heads[1:], len(tree.own_size)], strict=True):
        own, boundary = own_size(tree, head, end), tree.boundary_size[head]
        parts, nodes = tree.boundary[head]
        keys, members = _unknowns_of(parts, nodes, node, sizes, where.rank)
        first_position = stages[-1].n_positions if stages else 0
        is_leaf = with_leaves and end == len(tree.own_size)
        batch = split_into_batches(own, boundary, is_leaf, cost_of_batch(tree))[0]
        stages.append(make_stage(own, boundary, batch, keys, members, first_position))
    root_places = where.local[unknowns].astype(np.int32)
    position = positions(stages, where)
    unknown_of_position = np.zeros(stages[-1].n_positions, np.int32)
    unknown_of_position[position] = np.arange(n)
    couplings = couple_leaves(stages, where, position, columns) if with_leaves else ()
    n_stored = sum(int((x.s * (x.s + x.b)).sum()) for x in stages)
    if with_leaves:
        n_stored -= int((stages[-1].s * stages[-1].b).sum())
        n_stored += sum(coupling.entries.size for coupling in couplings)
    n_contact = len(unknowns)
    return DissectionPlan(
        stages=lay_out(stages, where, position, columns, with_leaves),
        couplings=couplings,
        unknown_of_position=unknown_of_position,
        position_of_unknown=position.astype(np.int32),
        contact_places=root_places,
        n_factor_entries=_count_entries(tree),
        n_stored=n_stored + n_contact * (int(stages[0].s[0]) + n_contact),
    )


def _group(columns: np.ndarray, is_contact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group unknowns with identical rows into nodes: node (n,) and a first unknown of each (N,)."""
    n = columns.shape[1]
    # Rows are compared by the sum of random keys of their columns, the own one included once: the
    # padding of a row repeats it. Contact unknowns never share a node with others.
    key = np.random.default_rng(0).integers(0, 2**63, n, dtype=np.uint64)
    is_own = columns == np.arange(n)
    signature = np.where(is_own, 0, key[columns]).sum(0, dtype=np.uint64) + key * is_own.any(0)
    signature = np.where(is_contact, ~signature, signature)
    _, first, node = np.unique(signature, return_index=True, return_inverse=True)
    order = np.argsort(first)  # number the nodes as the unknowns are numbered
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank[node], first[order]


def _eliminate(dissection: Dissection, edges: np.ndarray, sizes: np.ndarray) -> Tree:
    """Find the boundary of each part: the later nodes that its elimination couples.

    From the leaves to the root, the boundary of a part are the later neighbours of its own nodes
    and what its children pass on: their boundary without the nodes of the part itself.

    Args:
        dissection: the separator tree of N nodes.
        edges: (E, 2) node pairs, each edge in both directions.
        sizes: unknowns of each node, (N,).
    """
    depth, part, n_depths = dissection
    n = len(depth)
    rank = np.empty(n, np.int64)  # nodes near the leaves first, so children and parents agree
    rank[np.lexsort((part, -depth))] = np.arange(n)
    node_of_rank = np.argsort(rank)
    below, above = edges[depth[edges[:, 0]] > depth[edges[:, 1]]].T
    boundary, n_own, n_boundary = [], [], []
    inherited = np.zeros(0, np.int64)
    for level in range(n_depths - 1, -1, -1):
        is_here = depth[below] == level
        direct = part[below[is_here]] * n + rank[above[is_here]]
        # Keys part * n + rank: sorted by part, then in the order of elimination, each once.
        keys = np.unique(np.concatenate([direct, inherited]))
        parts, nodes = keys // n, node_of_rank[keys % n]
        n_parts = 2 ** max(level - 1, 0)
        here = np.flatnonzero(depth == level)
        boundary.append((parts, nodes))
        n_own.append(np.bincount(part[here], sizes[here], n_parts).astype(np.int64))
        n_boundary.append(np.bincount(parts, sizes[nodes], n_parts).astype(np.int64))
        is_later = depth[nodes] < level - 1
        inherited = (parts[is_later] // 2) * n + rank[nodes[is_later]]
    return Tree(depth, part, rank, boundary[::-1], n_own[::-1], n_boundary[::-1])


def _count_entries(tree: Tree) -> int:
    """Count the entries of the factor's lower triangle without padding."""
    sizes = zip(tree.own_size, tree.boundary_size, strict=True)
    return int(sum((s * (s + 1) // 2 + s * b).sum() for s, b in sizes))


def _locate(tree: Tree, heads: list[int], node: np.ndarray) -> Unknowns:
    """Find stage, front and position of every unknown, (n,) each.

    Args:
        tree: the separator tree.
        heads: first depth of each stage, from the root.
        node: node of each unknown, (n,).
    """
    n = len(node)
    # The front of a part is its ancestor at the head of the stage: one halving per depth.
    stage_of_depth = np.searchsorted(heads, np.arange(len(tree.own_size)), side="right") - 1
    stage = stage_of_depth[tree.depth[node]]
    front = tree.part[node] >> (tree.depth[node] - np.asarray(heads)[stage])
    rank = np.empty(n, np.int64)
    rank[np.lexsort((np.arange(n), tree.rank[node]))] = np.arange(n)
    order = np.lexsort((rank, front, stage))
    group = (stage * n + front)[order]
    local = np.empty(n, np.int64)
    local[order] = np.arange(n) - np.searchsorted(group, group)
    return Unknowns(stage, front, local, rank)


def _unknowns_of(
    parts: np.ndarray, nodes: np.ndarray, node: np.ndarray, sizes: np.ndarray, rank: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Spread pairs (part, node) to pairs (part, unknown): key part * n + rank, and the unknown."""
    n = len(node)
    members = np.argsort(node, kind="stable")
    starts = np.cumsum(sizes) - sizes
    count = sizes[nodes]
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    unknowns = members[np.repeat(starts[nodes], count) + within]
    return np.repeat(parts, count) * n + rank[unknowns], unknowns
