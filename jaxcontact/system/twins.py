"""Contact pairs with one row in N: two equal rows would make the contact problem singular."""

from __future__ import annotations

import numpy as np
from jax import Array

from jaxcontact.system.assembly import nodal_areas
from jaxcontact.system.pairs import ContactPairs

#: Normals that differ by no more than this times the unit roundoff are equal.
ROUNDING = 64.0


def drop_twins(
    pairs: ContactPairs,
    facets: list[np.ndarray],
    points: Array | np.ndarray,
) -> ContactPairs:
    """Keep the nearest of the concrete pairs that have one row in N.

    Its area is that of the node in the union of their sets.

    Args:
        pairs: all pairs.
        facets: of the contact sets of each obstacle.
        points: node positions, (N, d) [m].
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
                joined = tuple(sorted(pairs.owner[[kept, *dropped]]))
                if joined not in areas:
                    union = np.unique(np.concatenate([facets[k] for k in joined]), axis=0)
                    areas[joined] = np.asarray(nodal_areas(points, union))
                area[kept] = areas[joined][node]
                members[kept] = np.any(members[[kept, *dropped]], axis=0)
    rest = (pairs.rounding, pairs.shares, pairs.held, pairs.owner, members)
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
