"""The contact pairs of a scene: which node meets which obstacle or body, along which normal.

A node that lies in two contact sets has a pair for each, as a corner between a floor and a wall
needs them. Two equal rows in the contact operator however make the contact forces ambiguous and
the contact problem singular, so what is one contact becomes one pair: sets with equal obstacles
are one set, and of pairs at one node with equal rows only the nearest can ever touch.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.cells import end_signs
from jaxcontact.scene.compound import Along, gap_along
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.obstacle import Obstacle, gap_and_normals, position_sizes
from jaxcontact.scene.scene import Scene, contact_obstacles
from jaxcontact.system.assembly import nodal_areas
from jaxcontact.system.block_matrix import concatenate
from jaxcontact.system.mortar import directions, mortar_rows
from jaxcontact.system.pairing import direction_of, find_meeting
from jaxcontact.system.pairs import ContactPairs
from jaxcontact.system.twins import drop_twins
from jaxcontact.transforms.traced import as_array, is_traced, poison_unless, take_rows

#: A gap may be negative by so many of its rounding errors.
PENETRATION = 64.0
#: Owner and members of pairs, before they are known.
_UNKNOWN = (np.zeros(0, np.int32), np.zeros((0, 0), bool))


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
    sets = merged_obstacles(scene)
    if not sets:
        none, no_shares = np.zeros(0), np.zeros((0, 0))
        nodes, masters = none.astype(np.int32), no_shares.astype(np.int32)
        held = np.zeros((0, len(scene.clamped)))
        shares = (no_shares, held, nodes, no_shares.astype(bool))
        return ContactPairs(nodes, masters, none, points[:0], none, none, *shares)
    parts = [
        _body_pairs(scene, names, obstacle, facets, points, clamped_set, dtype)
        if isinstance(obstacle, Facets)
        else _obstacle_pairs(scene, obstacle, facets, points, dtype)
        for names, obstacle, facets in sets
    ]
    parts = [
        part._replace(
            owner=np.full(len(part.nodes), number, np.int32),
            members=_members(scene, names, part.nodes),
        )
        for number, (part, (names, *_)) in enumerate(zip(parts, sets, strict=True))
    ]
    width = max(part.masters.shape[1] for part in parts)
    columns = zip(*(_widened(part, width) for part in parts), strict=True)
    nodes, masters, *values, owner, members = columns
    pairs = ContactPairs(
        np.concatenate(nodes),
        np.concatenate(masters),
        *(concatenate(*value) for value in values),
        owner=np.concatenate(owner),
        members=np.concatenate(members),
    )
    pairs = _without_clamped(scene, pairs, clamped_set)
    # Where bodies turn, equal rows differ in another place.
    if is_traced((pairs.gap, pairs.normals)) or scene.large_rotation:
        return pairs
    return drop_twins(pairs, [facets for *_, facets in sets], points)


def _without_clamped(scene: Scene, pairs: ContactPairs, clamped_set: np.ndarray) -> ContactPairs:
    """Return the pairs of nodes that can move, after a look at the gap of the others.

    If a gap that cannot be looked at is negative, all gaps are NaN.
    """
    is_held = clamped_set[pairs.nodes] >= 0
    if not is_held.any():
        return pairs
    kept, held = np.flatnonzero(~is_held), np.flatnonzero(is_held)
    depth = -take_rows(pairs.gap, held) - PENETRATION * take_rows(pairs.rounding, held)
    moving = ContactPairs(*(take_rows(as_array(x), kept) for x in pairs))
    if is_traced(depth):
        return moving._replace(gap=poison_unless(jnp.all(depth <= 0.0), moving.gap))
    worst = int(np.argmax(depth))
    if depth[worst] > 0.0:
        node, number = int(pairs.nodes[held[worst]]), int(np.argmax(pairs.members[held[worst]]))
        raise ValueError(
            f"{np.count_nonzero(np.asarray(depth) > 0.0)} clamped nodes of contact sets penetrate "
            f"what they may touch, deepest node {node} of {sorted(scene.contact)[number]!r} by "
            f"{float(-np.asarray(pairs.gap)[held[worst]]):.3g} m; move the obstacle"
        )
    return moving


def _obstacle_pairs(
    scene: Scene,
    obstacle: Obstacle,
    facets: np.ndarray,
    points: Array | np.ndarray,
    dtype: np.dtype,
) -> ContactPairs:
    """Return the pairs of facets (F, d) that may touch a rigid obstacle."""
    nodes = np.unique(facets).astype(np.int32)
    places = jnp.asarray(points[nodes])
    if isinstance(obstacle, Along):
        along = None if obstacle.direction is None else as_array(obstacle.direction)
        ends = end_signs(scene.mesh.cells)
        normals = jnp.asarray(directions(points, facets, ends, along, nodes))
        gap, is_met = gap_along(obstacle, places, normals)
        if not is_traced(is_met):
            kept = np.asarray(is_met)
            _check_met(kept)
            nodes = nodes[kept]
            places, normals, gap = (x[kept] for x in (places, normals, gap))
    else:
        gap, normals = gap_and_normals(obstacle, places)
    area = _areas(points, facets, nodes)
    rounding = _rounding(gap, normals, position_sizes(obstacle, places), dtype)
    none, held = np.zeros((nodes.size, 0)), np.zeros((nodes.size, len(scene.clamped)))
    values = (gap, normals, area, rounding, none, held)
    return ContactPairs(nodes, none.astype(np.int32), *values, *_UNKNOWN)


def _check_met(is_met: np.ndarray) -> None:
    if not np.any(is_met):
        raise ValueError(
            f"none of the {is_met.size} nodes of a contact set meets the obstacle of jc.Along on "
            "its ray; does the direction point from the body to the obstacle?"
        )


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
    rows = mortar_rows(points, facets, end_signs(scene.mesh.cells), direction_of(other), meeting)
    places = jnp.asarray(points[meeting.nodes])
    both = jnp.max(2.0 * jnp.abs(places) + jnp.abs(rows.gap)[:, None], axis=0)
    rounding = _rounding(rows.gap, rows.normals, both, dtype)
    values = (rows.gap, rows.normals, rows.area, rounding, rows.shares, rows.held)
    return ContactPairs(meeting.nodes, meeting.masters, *values, *_UNKNOWN)


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


def merged_obstacles(scene: Scene) -> list[tuple[list[str], Obstacle | Facets, np.ndarray]]:
    """Return every different obstacle, after the sets and before the facets that may touch it."""
    sets: list[tuple[list[str], Obstacle | Facets, np.ndarray]] = []
    for name, obstacle in contact_obstacles(scene):
        facets = scene.mesh.facets[name]
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
