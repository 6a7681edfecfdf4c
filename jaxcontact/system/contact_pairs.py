"""The contact pairs of a scene: which node meets which obstacle or body, along which normal.

A node that lies in two contact sets has a pair for each, as a corner between a floor and a wall
needs them. Two equal rows in the contact operator however make the contact forces ambiguous and
the contact problem singular, so what is one contact becomes one pair: sets with equal obstacles
are one set, and of pairs at one node with equal rows only the nearest can ever touch.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.facets import Facets
from jaxcontact.scene.obstacle import Obstacle, gap_and_normals, position_sizes
from jaxcontact.scene.scene import Scene
from jaxcontact.system.assembly import nodal_areas
from jaxcontact.system.block_matrix import concatenate
from jaxcontact.system.mortar import mortar_rows
from jaxcontact.system.pairing import direction_of, end_signs, find_meeting
from jaxcontact.transforms.traced import is_traced

#: Normals that differ by no more than this times the unit roundoff are equal.
ROUNDING = 64.0


class ContactPairs(NamedTuple):
    """All contact pairs of a scene."""

    nodes: np.ndarray
    """Node of each pair, (C,) int32."""

    masters: np.ndarray
    """Nodes of the other body that a pair is coupled to, (C, m) int32; its own node for none."""

    gap: Array | np.ndarray
    """Distance to the obstacle, (C,) [m]."""

    normals: Array | np.ndarray
    """Unit normals towards the obstacle, (C, d)."""

    area: Array | np.ndarray
    """Integral of the hat function of the node over its contact set, (C,) [m^(d-1)]; with another
    body, over what lies before that."""

    rounding: Array | np.ndarray
    """Rounding error of the gap, that of the positions of node and obstacle included, (C,) [m]."""

    shares: Array | np.ndarray
    """Share of each of them in what the pair is measured from, (C, m); zero for none."""

    held: Array | np.ndarray
    """Share of the nodes of each clamped set, (C, S); see `clamped_numbers`."""

    members: np.ndarray
    """Whether a pair stands for one of each contact set, in the order of their names, (C, K)."""

    @property
    def row_nodes(self) -> np.ndarray:
        """Nodes of the rows of N, the node of the pair first, (C, 1+m) int32."""
        return np.concatenate([self.nodes[:, None], self.masters], axis=1)

    def row_weights(self) -> Array:
        """Return the entries of the rows of N, nu and -m_k nu, (C, (1+m) d)."""
        own = jnp.ones((len(self.nodes), 1), self.normals.dtype)
        factors = jnp.concatenate([own, -jnp.asarray(self.shares, own.dtype)], axis=1)
        entries = factors[:, :, None] * self.normals[:, None, :]  # (C, node, i)
        return entries.reshape(len(entries), entries.shape[1] * entries.shape[2])


def contact_pairs(
    scene: Scene, points: Array | np.ndarray, clamped_set: np.ndarray, dtype: np.dtype
) -> ContactPairs:
    """Return the contact pairs, in the digits of the node positions.

    Args:
        scene: the scene.
        points: node positions, (N, d) [m].
        clamped_set: number of the clamped set of each node, (N,) int, -1 for a free one.
        dtype: the type to which the gap will be rounded.

    Raises:
        ValueError: if an obstacle defines no surface, or no node of a contact set sees the other
            body, or where that is cannot be searched because all node positions are traced.
    """
    sets, n_clamped = _merge_sets(scene), len(scene.clamped)
    if not sets:
        none, no_shares = np.zeros(0), np.zeros((0, 0))
        nodes, masters = none.astype(np.int32), no_shares.astype(np.int32)
        held = np.zeros((0, n_clamped))
        return ContactPairs(
            nodes, masters, none, points[:0], none, none, no_shares, held, no_shares.astype(bool)
        )
    parts = [
        _body_pairs(scene, names, obstacle, facets, points, clamped_set, dtype)
        if isinstance(obstacle, Facets)
        else _obstacle_pairs(obstacle, facets, points, n_clamped, dtype)
        for names, obstacle, facets in sets
    ]
    parts = [
        part._replace(members=_members(scene, names, part.nodes))
        for part, (names, *_) in zip(parts, sets, strict=True)
    ]
    width = max(part.masters.shape[1] for part in parts)
    nodes, masters, *values, members = zip(*(_widened(part, width) for part in parts), strict=True)
    pairs = ContactPairs(
        np.concatenate(nodes),
        np.concatenate(masters),
        *(concatenate(*value) for value in values),
        members=np.concatenate(members),
    )
    if is_traced((pairs.gap, pairs.normals)):
        return pairs
    set_of_pair = np.repeat(np.arange(len(sets)), [len(part.nodes) for part in parts])
    return _drop_twins(pairs, set_of_pair, [facets for *_, facets in sets], points)


def _obstacle_pairs(
    obstacle: Obstacle,
    facets: np.ndarray,
    points: Array | np.ndarray,
    n_clamped: int,
    dtype: np.dtype,
) -> ContactPairs:
    """Return the pairs of facets (F, d) that may touch a rigid obstacle."""
    nodes = np.unique(facets).astype(np.int32)
    places = jnp.asarray(points[nodes])
    gap, normals = gap_and_normals(obstacle, places)
    area = _areas(points, facets, nodes)
    rounding = _rounding(gap, normals, position_sizes(obstacle, places), dtype)
    none, held = np.zeros((nodes.size, 0)), np.zeros((nodes.size, n_clamped))
    masters, members = none.astype(np.int32), none.astype(bool)
    return ContactPairs(nodes, masters, gap, normals, area, rounding, none, held, members)


def _body_pairs(
    scene: Scene,
    names: list[str],
    other: Facets,
    facets: np.ndarray,
    points: Array | np.ndarray,
    clamped_set: np.ndarray,
    dtype: np.dtype,
) -> ContactPairs:
    """Return the pairs of facets (F, d) of the named contact sets that may touch another body."""
    meeting = find_meeting(names, facets, other, scene.mesh, clamped_set)
    rows = mortar_rows(points, facets, end_signs(scene.mesh), direction_of(other), meeting)
    places = jnp.asarray(points[meeting.nodes])
    both = jnp.max(2.0 * jnp.abs(places) + jnp.abs(rows.gap)[:, None], axis=0)
    rounding = _rounding(rows.gap, rows.normals, both, dtype)
    nodes, masters, members = meeting.nodes, meeting.masters, np.zeros((len(rounding), 0), bool)
    values = (rows.gap, rows.normals, rows.area, rounding, rows.shares, rows.held)
    return ContactPairs(nodes, masters, *values, members)


def _members(scene: Scene, names: list[str], nodes: np.ndarray) -> np.ndarray:
    """Return whether pairs of the named sets at the nodes belong to each contact set, (C, K)."""
    belongs = [
        np.isin(nodes, scene.mesh.facets[name]) & (name in names) for name in sorted(scene.contact)
    ]
    return np.stack(belongs, axis=1)


def _widened(pairs: ContactPairs, width: int) -> ContactPairs:
    """Return the pairs with `width` master nodes each, the added ones their own without share."""
    more = width - pairs.masters.shape[1]
    nodes = np.repeat(pairs.nodes[:, None], more, axis=1)
    shares = concatenate(pairs.shares, np.zeros(nodes.shape), axis=1)
    return pairs._replace(masters=np.concatenate([pairs.masters, nodes], axis=1), shares=shares)


@jax.jit
def _areas(points: Array, facets: Array, nodes: Array) -> Array:
    """Return the integral of the hat function of each of the nodes, (C,) [m^(d-1)]."""
    return nodal_areas(points, facets)[nodes]


@partial(jax.jit, static_argnames="dtype")
def _rounding(gap: Array, normals: Array, sizes: Array, dtype: np.dtype) -> Array:
    """Return the rounding error (C,) [m] of gaps between positions of the sizes (d,)."""
    of_places = jnp.finfo(sizes.dtype).eps * (jnp.abs(normals) @ sizes)
    return jax.lax.stop_gradient(of_places + 4.0 * jnp.finfo(dtype).eps * jnp.abs(gap))


def _merge_sets(scene: Scene) -> list[tuple[list[str], Obstacle | Facets, np.ndarray]]:
    """Return every different obstacle, after the sets and before the facets that may touch it."""
    sets: list[tuple[list[str], Obstacle | Facets, np.ndarray]] = []
    for name in sorted(scene.contact):
        obstacle, facets = scene.contact[name], scene.mesh.facets[name]
        for k, (names, other, others) in enumerate(sets):
            if _are_equal(obstacle, other):
                union = np.unique(np.concatenate([others, facets]), axis=0)
                sets[k] = [*names, name], other, union
                break
        else:
            sets.append(([name], obstacle, facets))
    return sets


def _are_equal(first: Obstacle | Facets, second: Obstacle | Facets) -> bool:
    """Return True if two obstacles are known to be equal; traced values are if they are one."""
    leaves, structure = jax.tree.flatten(first)
    others, other_structure = jax.tree.flatten(second)
    return structure == other_structure and all(
        a is b or (not is_traced((a, b)) and np.array_equal(a, b))
        for a, b in zip(leaves, others, strict=True)
    )


def _drop_twins(
    pairs: ContactPairs,
    set_of_pair: np.ndarray,
    facets: list[np.ndarray],
    points: Array | np.ndarray,
) -> ContactPairs:
    """Keep the nearest of the concrete pairs that have one row in N.

    Its area is that of the node in the union of their sets.
    """
    gap, normals, area = np.asarray(pairs.gap), np.asarray(pairs.normals), np.array(pairs.area)
    members = np.array(pairs.members)
    tolerance = ROUNDING * np.finfo(normals.dtype).eps
    nodes, counts = np.unique(pairs.nodes, return_counts=True)
    shared = np.flatnonzero(np.isin(pairs.nodes, nodes[counts > 1]))
    rows = _dense_rows(pairs, shared) if shared.size else {}
    # The pairs at a node, those of one row together, the nearest first.
    clusters: dict[int, list[list[int]]] = {}
    for pair in shared[np.argsort(gap[shared], kind="stable")]:
        at_node = clusters.setdefault(int(pairs.nodes[pair]), [])
        for cluster in at_node:
            if np.linalg.norm(rows[cluster[0]] - rows[pair]) <= tolerance:
                cluster.append(pair)
                break
        else:
            at_node.append([pair])
    keep = np.ones(len(gap), bool)
    areas: dict[tuple[int, ...], np.ndarray] = {}
    for node, at_node in clusters.items():
        for kept, *dropped in at_node:
            if dropped:
                keep[dropped] = False
                joined = tuple(sorted(set_of_pair[[kept, *dropped]]))
                if joined not in areas:
                    union = np.unique(np.concatenate([facets[k] for k in joined]), axis=0)
                    areas[joined] = np.asarray(nodal_areas(points, union))
                area[kept] = areas[joined][node]
                members[kept] = np.any(members[[kept, *dropped]], axis=0)
    rest = (pairs.rounding, pairs.shares, pairs.held, members)
    values = (np.asarray(x)[keep] for x in (gap, normals, area, *rest))
    return ContactPairs(pairs.nodes[keep], pairs.masters[keep], *values)


def _dense_rows(pairs: ContactPairs, chosen: np.ndarray) -> dict[int, np.ndarray]:
    """Return the rows of N of the chosen pairs, on the nodes that occur in them."""
    of_row = pairs.row_nodes[chosen]
    nodes, places = np.unique(of_row, return_inverse=True)
    weights = np.asarray(pairs.row_weights())[chosen].reshape(*of_row.shape, -1)
    rows = np.zeros((len(chosen), nodes.size, weights.shape[2]))
    np.add.at(rows, (np.arange(len(chosen))[:, None], places.reshape(of_row.shape)), weights)
    return dict(zip(chosen.tolist(), rows, strict=True))
