"""The contact pairs of a scene: which node meets which obstacle, along which normal.

A node that lies in two contact sets has a pair for each, as a corner between a floor and a wall
needs them. Two equal rows in the contact operator however make the contact forces ambiguous and
the contact problem singular, so what is one contact becomes one pair: sets with equal obstacles
are one set, and of pairs at one node with equal normals only the nearest can ever touch.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.obstacle import Obstacle, gap_and_normals, position_sizes
from jaxcontact.scene.scene import Scene
from jaxcontact.system.assembly import nodal_areas
from jaxcontact.system.block_matrix import concatenate
from jaxcontact.transforms.traced import is_traced

#: Normals that differ by no more than this times the unit roundoff are equal.
ROUNDING = 64.0


class ContactPairs(NamedTuple):
    """All contact pairs of a scene."""

    nodes: np.ndarray
    """Node of each pair, (C,) int32."""

    gap: Array | np.ndarray
    """Distance to the obstacle, (C,) [m]."""

    normals: Array | np.ndarray
    """Unit normals towards the obstacle, (C, d)."""

    area: Array | np.ndarray
    """Integral of the hat function of the node over its contact set, (C,) [m^(d-1)]."""

    rounding: Array | np.ndarray
    """Rounding error of the gap, that of the positions of node and obstacle included, (C,) [m]."""


def contact_pairs(scene: Scene, points: Array | np.ndarray, dtype: np.dtype) -> ContactPairs:
    """Return the contact pairs, in the digits of the node positions.

    Args:
        scene: the scene.
        points: node positions, (N, d) [m].
        dtype: the type to which the gap will be rounded.
    """
    sets = _merge_sets(scene)
    if not sets:
        nothing = np.zeros(0)
        return ContactPairs(np.zeros(0, np.int32), nothing, points[:0], nothing, nothing)
    parts = []
    for obstacle, facets in sets:
        nodes = np.unique(facets).astype(np.int32)
        places = jnp.asarray(points[nodes])
        gap, normals = gap_and_normals(obstacle, places)
        area = _areas(points, facets, nodes)
        sizes = position_sizes(obstacle, places)
        rounding = _rounding(gap, normals, sizes, dtype)
        parts.append(ContactPairs(nodes, gap, normals, area, rounding))
    nodes, *values = zip(*parts, strict=True)
    pairs = ContactPairs(np.concatenate(nodes), *(concatenate(*value) for value in values))
    if is_traced((pairs.gap, pairs.normals)):
        return pairs
    set_of_pair = np.repeat(np.arange(len(sets)), [len(part.nodes) for part in parts])
    return _drop_twins(pairs, set_of_pair, [facets for _, facets in sets], points)


@jax.jit
def _areas(points: Array, facets: Array, nodes: Array) -> Array:
    """Return the integral of the hat function of each of the nodes, (C,) [m^(d-1)]."""
    return nodal_areas(points, facets)[nodes]


@partial(jax.jit, static_argnames="dtype")
def _rounding(gap: Array, normals: Array, sizes: Array, dtype: np.dtype) -> Array:
    """Return the rounding error (C,) [m] of gaps between positions of the sizes (d,)."""
    of_places = jnp.finfo(sizes.dtype).eps * (jnp.abs(normals) @ sizes)
    return jax.lax.stop_gradient(of_places + 4.0 * jnp.finfo(dtype).eps * jnp.abs(gap))


def _merge_sets(scene: Scene) -> list[tuple[Obstacle, np.ndarray]]:
    """Return every different obstacle with the facets (F, d) that may touch it."""
    sets: list[tuple[Obstacle, np.ndarray]] = []
    for name in sorted(scene.contact):
        obstacle, facets = scene.contact[name], scene.mesh.facets[name]
        for k, (other, others) in enumerate(sets):
            if _are_equal(obstacle, other):
                sets[k] = other, np.unique(np.concatenate([others, facets]), axis=0)
                break
        else:
            sets.append((obstacle, facets))
    return sets


def _are_equal(first: Obstacle, second: Obstacle) -> bool:
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
    """Keep the nearest of the concrete pairs at one node that have one normal.

    Its area is that of the node in the union of their sets.
    """
    gap, normals, area = np.asarray(pairs.gap), np.asarray(pairs.normals), np.array(pairs.area)
    tolerance = ROUNDING * np.finfo(normals.dtype).eps
    nodes, counts = np.unique(pairs.nodes, return_counts=True)
    shared = np.flatnonzero(np.isin(pairs.nodes, nodes[counts > 1]))
    # The pairs at a node, those of one normal together, the nearest first.
    clusters: dict[int, list[list[int]]] = {}
    for pair in shared[np.argsort(gap[shared], kind="stable")]:
        at_node = clusters.setdefault(int(pairs.nodes[pair]), [])
        for cluster in at_node:
            if np.linalg.norm(normals[cluster[0]] - normals[pair]) <= tolerance:
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
    values = (gap, normals, area, np.asarray(pairs.rounding))
    return ContactPairs(pairs.nodes[keep], *(x[keep] for x in values))
