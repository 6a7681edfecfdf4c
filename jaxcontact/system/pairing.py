"""Which facets of another body each contact node meets: the search on concrete node positions.

A node of a contact set looks along a unit direction nu. The facet that its ray hits gives the gap,
the facets that its own facets see along nu give the weights (see `mortar.py`). What is found are
indices, which stay fixed where positions are differentiated; facets that almost overlap are found
too, so that nothing is missing after a small motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from jaxcontact.scene.cells import area_vectors, end_signs
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.mesh import Mesh
from jaxcontact.system.mortar import Meeting, directions, meet, overlap, project

#: Least cosine between the direction and the normal of a facet that sees or is seen.
STEEPEST = 0.1
#: How far a ray may miss a facet, in barycentric coordinates: a rounding error.
ON_FACET = 1e-9
#: How far facets may be from overlapping and still be found, in barycentric coordinates.
MARGIN = 0.05
#: Least part of a facet that another body has to cover: a smaller one determines no weights.
COVER = 1e-3
#: Pairs of node and facet that are compared at once.
CHUNK = 1_000_000


def find_meeting(
    names: Sequence[str], slave: np.ndarray, facets: Facets, mesh: Mesh, clamped_set: np.ndarray
) -> Meeting:
    """Return the facets that meet: one row for each node that sees the other body.

    Args:
        names: of the contact sets, for messages.
        slave: their facets, (F, d).
        facets: what they may touch.
        mesh: the mesh of both, with concrete `points` or `layout`.
        clamped_set: number of the clamped set of each node, (N,) int, -1 for a free one; only free
            nodes are masters.

    Raises:
        ValueError: if no concrete positions are known or no node sees the other body.
    """
    x = mesh.positions("the search of the facets that meet")
    ends = end_signs(mesh.cells)
    nodes, place = np.unique(slave, return_inverse=True)
    nu = directions(x, slave, ends, direction_of(facets), nodes)

    # Every node with its own facets, it first, as far as they look along its direction.
    d = slave.shape[1]
    own = np.concatenate([np.roll(slave, -a, axis=1) for a in range(d)])
    node = np.concatenate([place.reshape(slave.shape)[:, a] for a in range(d)])
    # A turned edge points inward: the normals are those of the facets as they are.
    outward = np.tile(area_vectors(x, slave, ends), (d, 1))
    looks = _cosines(outward, nu[node]) > STEEPEST
    own, node = own[looks], node[looks]

    master = mesh.facets[facets.name]
    vectors = area_vectors(x, master, ends)
    depth = _cell_sizes(x, mesh.cells)[nodes]
    ray, seen = _candidates(x, nodes, nu, depth, own, node, master, vectors)
    places, way = meet(x[master[seen]], x[nodes[ray]], nu[ray])
    hits = np.flatnonzero((places.min(axis=1) >= -ON_FACET) & (way >= -depth[ray]))
    hits = hits[np.lexsort((np.abs(way[hits]), ray[hits]))]
    _, first = np.unique(ray[hits], return_index=True)
    hit = np.full(nodes.size, -1)
    hit[ray[hits[first]]] = seen[hits[first]]

    # Pieces: the facets that the facets of a node with a hit see.
    looking = np.flatnonzero(hit[node] >= 0)
    group, found = _matches(node[looking], ray)
    group, other = looking[group], seen[found]
    corners = project(x[own[group]], x[master[other]], nu[node[group]])
    keep = _overlaps(corners)
    group, other, corners = group[keep], other[keep], corners[keep]
    keep = ~_is_hidden(x, master, nodes, nu, node[group], other, ray, seen)
    group, other, corners = group[keep], other[keep], corners[keep]

    covered = np.zeros(len(own))
    np.add.at(covered, group, overlap(corners)[0].sum(axis=1))
    is_used = covered * math.factorial(d - 1) >= COVER
    keep = is_used[group]
    group, other = (np.cumsum(is_used) - 1)[group[keep]], other[keep]
    own, node = own[is_used], node[is_used]
    rows, row = np.unique(node, return_inverse=True)
    if not rows.size:
        raise ValueError(
            f"none of the {nodes.size} nodes of contact sets {sorted(names)} sees a facet of "
            f"{facets.name!r} along the contact direction; are both named right, and do the "
            "bodies face each other? Facets(name, along=direction) sets the direction"
        )
    masters, slots = _tables(nodes[rows], row[group], master[other], clamped_set)
    held = np.arange(clamped_set.max() + 1)
    indices = (nodes[rows], master[hit[rows]], own, row, master[other], group, masters, slots, held)
    return Meeting(*(np.asarray(index, np.int32) for index in indices))


def direction_of(facets: Facets) -> np.ndarray | None:
    """Return the contact direction, (d,), or None for the normals of the contact set."""
    return None if facets.along is None else np.asarray(facets.along, float)


def _cosines(vectors: np.ndarray, nu: np.ndarray) -> np.ndarray:
    return np.sum(vectors * nu, axis=1) / np.linalg.norm(vectors, axis=1)


def _cell_sizes(x: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the longest extent of the cells at each node along an axis, (N,) [m]."""
    sizes = np.zeros(len(x))
    np.maximum.at(sizes, cells, np.ptp(x[cells], axis=1).max(axis=1)[:, None])
    return sizes


def _candidates(
    x: np.ndarray,
    nodes: np.ndarray,
    nu: np.ndarray,
    depth: np.ndarray,
    own: np.ndarray,
    node: np.ndarray,
    master: np.ndarray,
    vectors: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return rays and the facing facets near them, (P,) each, those that may hide others too."""
    centres = x[master].mean(axis=1)
    sizes = np.linalg.norm(x[master] - centres[:, None], axis=2).max(axis=1)
    reach = np.zeros(nodes.size)
    np.maximum.at(reach, node, np.linalg.norm(x[own] - x[own[:, :1]], axis=2).max(axis=1))
    reach = (1.0 + MARGIN) * (reach + 2.0 * sizes.max())
    normals = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    rays, seen = [], []
    step = max(1, CHUNK // len(master))
    for start in range(0, nodes.size, step):
        some = slice(start, start + step)
        offsets = centres[None] - x[nodes[some], None]  # (ray, facet, i)
        along = np.einsum("rfi,ri->rf", offsets, nu[some])
        aside = np.sum(offsets**2, axis=2) - along**2
        faces = (nu[some] @ normals.T < -STEEPEST) & (along >= -depth[some, None] - sizes[None])
        ray, facet = np.nonzero(faces & (aside <= reach[some, None] ** 2))
        rays.append(ray + start)
        seen.append(facet)
    return np.concatenate(rays), np.concatenate(seen)


def _overlaps(corners: np.ndarray) -> np.ndarray:
    """Return whether facets overlap the unit simplex up to the margin, (Z,) bool.

    Args:
        corners: (Z, b, a), see `project`.
    """
    # Convex sets are apart if and only if a side of one of them separates them.
    sides = np.concatenate([corners, np.linalg.inv(corners)], axis=2)
    return np.all(sides.max(axis=1) > -MARGIN, axis=1)


def _is_hidden(
    x: np.ndarray,
    master: np.ndarray,
    nodes: np.ndarray,
    nu: np.ndarray,
    node: np.ndarray,
    other: np.ndarray,
    ray: np.ndarray,
    seen: np.ndarray,
) -> np.ndarray:
    """Return whether a nearer facet lies before the centre of a facet, (Z,) bool.

    Nearer to the node, on either side: a facet that is penetrated counts by its depth.
    """
    pairs, inverse = np.unique(np.stack([node, other], axis=1), axis=0, return_inverse=True)
    pair, found = _matches(pairs[:, 0], ray)
    rival = seen[found]
    centres = x[master].mean(axis=1)
    sizes = np.linalg.norm(x[master] - centres[:, None], axis=2).max(axis=1)
    direction = nu[pairs[pair, 0]]
    offset = centres[rival] - centres[pairs[pair, 1]]
    aside = np.sum(offset**2, axis=1) - np.sum(offset * direction, axis=1) ** 2
    near = (aside <= sizes[rival] ** 2) & (rival != pairs[pair, 1])
    pair, rival, direction = pair[near], rival[near], direction[near]
    centre = centres[pairs[pair, 1]]
    places, way = meet(x[master[rival]], centre, direction)
    depth = np.sum((centre - x[nodes[pairs[pair, 0]]]) * direction, axis=1)
    is_before = (places.min(axis=1) >= 0.0) & (np.abs(depth + way) < np.abs(depth))
    hidden = np.zeros(len(pairs), bool)
    hidden[pair[is_before]] = True
    return hidden[inverse.reshape(-1)]


def _matches(wanted: np.ndarray, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of a place in `wanted` and a place in `keys` with equal numbers."""
    order = np.argsort(keys, kind="stable")
    starts, stops = (np.searchsorted(keys[order], wanted, side) for side in ("left", "right"))
    count = stops - starts
    place = np.repeat(np.arange(len(wanted)), count)
    within = np.arange(len(place)) - np.repeat(np.cumsum(count) - count, count)
    return place, order[starts[place] + within]


def _tables(
    nodes: np.ndarray, row: np.ndarray, facets: np.ndarray, clamped_set: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the free master nodes of each row (C, m), and the place of each corner (Z, d).

    The place of a clamped corner is m plus the number of its set.
    """
    entries = np.stack([np.repeat(row, facets.shape[1]), facets.ravel()], axis=1)
    unique, inverse = np.unique(entries, axis=0, return_inverse=True)
    free = clamped_set[unique[:, 1]] < 0
    before = np.cumsum(free) - free
    first = np.searchsorted(unique[:, 0], np.arange(nodes.size))
    slot = before - before[first[unique[:, 0]]]
    width = int(np.max(slot[free], initial=-1)) + 1
    masters = np.repeat(nodes[:, None], width, axis=1)
    masters[unique[free, 0], slot[free]] = unique[free, 1]
    slots = np.where(free, slot, width + clamped_set[unique[:, 1]])[inverse.reshape(-1)]
    return masters, slots.reshape(facets.shape)
