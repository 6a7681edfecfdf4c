"""Nested dissection of a mesh graph by coordinate bisection (host, NumPy).

Every part of the mesh is cut in two halves of equal size across one coordinate axis; the smallest
set of nodes that meets every cut edge (a minimum vertex cover, by König's theorem from a maximum
matching) separates the halves. All parts of one depth are cut at once, so the work is a few sorts
and one matching per depth and axis.

Source: A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10
(1973); J. Liu, A graph partitioning algorithm by node separators, ACM TOMS 15 (1989).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra
from scipy.sparse.csgraph import maximum_bipartite_matching as maximum_matching


class Dissection(NamedTuple):
    """A separator tree: nodes of depth 0 are eliminated last, the leaves (largest depth) first."""

    depth: np.ndarray
    """Depth at which a node is eliminated, (N,); 0 only for the nodes ordered last on request."""
    part: np.ndarray
    """Part of that depth the node belongs to, (N,), below 2^(depth-1); its parent is part // 2."""
    n_depths: int
    """Number of depths, the leaves included."""


def dissect(
    edges: np.ndarray,
    coordinates: np.ndarray,
    sizes: np.ndarray,
    is_last: np.ndarray,
    leaf_size: int,
) -> Dissection:
    """Order the nodes of a graph by nested dissection.

    After the call two nodes that share an edge lie on one line of descent of the separator tree.

    Args:
        edges: (E, 2) node pairs, each edge once.
        coordinates: (N, d) positions of the nodes.
        sizes: (N,) number of unknowns of each node.
        is_last: (N,) True for nodes to be eliminated after all others (depth 0).
        leaf_size: largest number of unknowns in a leaf.
    """
    depth = np.where(is_last, 0, -1)
    part = np.zeros(len(sizes), np.int64)
    level = 1
    while True:
        active = np.flatnonzero(depth < 0)
        edges = edges[(depth[edges] < 0).all(1)]
        edges = edges[part[edges[:, 0]] == part[edges[:, 1]]]
        filled = np.bincount(part[active], sizes[active], 1)
        if filled.max() <= leaf_size or np.bincount(part[active]).max() < 2:
            depth[active] = level
            return Dissection(depth, part, level + 1)
        side, is_separator = _bisect(edges, coordinates, sizes, part, active)
        depth[is_separator] = level
        rest = active[~is_separator[active]]
        part[rest] = 2 * part[rest] + side[rest]
        level += 1


def hop_coordinates(edges: np.ndarray, n_nodes: int) -> np.ndarray:
    """Return positions (N, 3) from distances counted in edges, for a mesh without known points.

    Each column is the difference of the distances to two nodes far apart. Connected components are
    chained by one extra edge each, so that every distance is finite.
    """
    graph = _adjacency(edges, n_nodes)
    n_components, component = connected_components(graph, directed=False)
    if n_components > 1:
        first = np.unique(component, return_index=True)[1]
        chain = np.stack([first[:-1], first[1:]], 1)
        graph = _adjacency(np.concatenate([edges, chain]), n_nodes)

    def hops(node: int) -> np.ndarray:
        """Return the distance of every node, (N,)."""
        return dijkstra(graph, directed=False, unweighted=True, indices=node)

    columns, nearest = [], hops(int(hops(0).argmax()))
    for _ in range(3):
        start = hops(int(nearest.argmax()))
        end = hops(int(start.argmax()))
        columns.append(start - end)
        nearest = np.minimum(nearest, np.minimum(start, end))
    return np.stack(columns, 1)


def _adjacency(edges: np.ndarray, n_nodes: int) -> csr_array:
    """Return the graph of the edges (E, 2), (N, N)."""
    ones = np.ones(len(edges), np.int8)
    return coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(n_nodes, n_nodes)).tocsr()


def _bisect(
    edges: np.ndarray,
    coordinates: np.ndarray,
    sizes: np.ndarray,
    part: np.ndarray,
    active: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Cut every part across the axis with the smallest separator.

    Args:
        edges: node pairs within one part, (E, 2).
        coordinates: positions of the nodes, (N, d).
        sizes: unknowns of each node, (N,).
        part: part of each node, (N,).
        active: nodes that are not eliminated yet, (A,).

    Returns:
        side of each node, 0 or 1, (N,); True for the nodes of the separators, (N,).
    """
    side = np.zeros(len(sizes), np.int64)
    is_separator = np.zeros(len(sizes), bool)
    smallest = np.full(part[active].max() + 1, np.inf)
    for axis in range(coordinates.shape[1]):
        side_k = _halve(np.roll(coordinates, -axis, 1), sizes, part, active)
        cover = _minimum_cover(edges[side_k[edges[:, 0]] != side_k[edges[:, 1]]], side_k)
        width = np.bincount(part[cover], sizes[cover], len(smallest))
        # What an earlier axis has chosen is undone in the parts that this axis cuts better.
        is_better = width < smallest
        smallest = np.where(is_better, width, smallest)
        chosen = active[is_better[part[active]]]
        side[chosen] = side_k[chosen]
        is_separator[chosen] = False
        is_separator[cover[is_better[part[cover]]]] = True
    return side, is_separator


def _halve(
    coordinates: np.ndarray, sizes: np.ndarray, part: np.ndarray, active: np.ndarray
) -> np.ndarray:
    """Side (N,) of each node when its part is cut at the median of the first coordinate."""
    keys = coordinates[active].T[::-1]  # ties of the first coordinate are broken by the others
    order = active[np.lexsort((*keys, part[active]))]
    passed = np.cumsum(sizes[order]) - 0.5 * sizes[order]
    total = np.bincount(part[order], sizes[order])
    before = np.cumsum(total) - total
    side = np.zeros(len(sizes), np.int64)
    side[order] = passed - before[part[order]] > 0.5 * total[part[order]]
    return side


def _minimum_cover(cut: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Smallest set of nodes that meets every cut edge (K, 2), all parts at once."""
    if len(cut) == 0:
        return np.zeros(0, np.int64)
    is_left_first = side[cut[:, 0]] == 0
    left, i = np.unique(np.where(is_left_first, cut[:, 0], cut[:, 1]), return_inverse=True)
    right, j = np.unique(np.where(is_left_first, cut[:, 1], cut[:, 0]), return_inverse=True)
    ones = np.ones(len(cut), np.int8)
    bipartite = csr_array((ones, (i, j)), shape=(len(left), len(right)))
    match = maximum_matching(bipartite, perm_type="column")  # right partner of each left node or -1
    # König: reach along alternating paths from the unmatched left nodes; the cover is
    # the left nodes not reached and the right nodes reached.
    matched = np.flatnonzero(match >= 0)
    free = np.flatnonzero(match < 0)
    n_left, source = len(left), len(left) + len(right)
    tails = np.concatenate([i, n_left + match[matched], np.full(len(free), source)])
    heads = np.concatenate([n_left + j, matched, free])
    paths = csr_array((np.ones(len(tails), np.int8), (tails, heads)), shape=(source + 1,) * 2)
    is_reached = np.zeros(source + 1, bool)
    is_reached[breadth_first_order(paths, source, return_predecessors=False)] = True
    return np.concatenate([left[~is_reached[:n_left]], right[is_reached[n_left:source]]])
