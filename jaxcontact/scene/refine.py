"""Uniform refinement: every edge is halved and every cell cut into 2^d of half its size.

A tetrahedron leaves an octahedron between its four corner cells, which is cut along the shortest of
its three diagonals. However often this is repeated, the cells do not degenerate.

Source: Bey, Computing 55 (1995) 355-378; Kroeger, Preusser, Numer. Math. 109 (2008) 435-457.
"""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np

from jaxcontact.transforms.traced import Values

#: The children of a cell: each corner is the middle of the edge between two corners of the parent.
#: In 3D the last four share the diagonal from the middle of 02 to that of 13.
_CHILDREN = {
    1: (((0, 0), (0, 1)), ((0, 1), (1, 1))),
    2: (
        ((0, 0), (0, 1), (0, 2)),
        ((0, 1), (1, 1), (1, 2)),
        ((0, 2), (1, 2), (2, 2)),
        ((1, 2), (0, 2), (0, 1)),
    ),
    3: (
        ((0, 0), (0, 1), (0, 2), (0, 3)),
        ((0, 1), (1, 1), (1, 2), (1, 3)),
        ((0, 2), (1, 2), (2, 2), (2, 3)),
        ((0, 3), (1, 3), (2, 3), (3, 3)),
        ((0, 1), (0, 2), (0, 3), (1, 3)),
        ((0, 2), (0, 1), (1, 2), (1, 3)),
        ((0, 3), (0, 2), (2, 3), (1, 3)),
        ((0, 2), (1, 2), (2, 3), (1, 3)),
    ),
}
#: The same for the facets of the boundary, by their number of corners.
_FACETS = {1: (((0, 0),),), 2: _CHILDREN[1], 3: _CHILDREN[2]}
#: Even permutations that bring each diagonal of the octahedron to the first place.
_TURNS = np.array([[0, 1, 2, 3], [0, 2, 3, 1], [0, 3, 1, 2]])


def edges_of(cells: np.ndarray) -> np.ndarray:
    """Return the edges of the cells, each once with the smaller node first, (K, 2)."""
    pairs = itertools.combinations(range(cells.shape[1]), 2)
    return np.unique(np.concatenate([np.sort(cells[:, pair], axis=1) for pair in pairs]), axis=0)


def refine_points(points: Values, edges: np.ndarray) -> Values:
    """Return the nodes with the middles of the edges after them, (N+K, d)."""
    middles = 0.5 * (points[edges[:, 0]] + points[edges[:, 1]])
    return (np if isinstance(points, np.ndarray) else jnp).concatenate([points, middles])


def refine_cells(cells: np.ndarray, edges: np.ndarray, positions: Values) -> np.ndarray:
    """Return the 2^d children of every cell, (2^d E, d+1) int32, those of a cell one after another.

    Args:
        cells: (E, d+1); they stay positively oriented.
        edges: `edges_of(cells)`; the middle of edge k is node N + k.
        positions: node positions, (N, d); concrete in 3D.
    """
    if cells.shape[1] == 4:
        x = positions[cells]  # (E,a,d)
        # Twice the ways between the middles of opposite edges: 02 and 13, 03 and 21, 01 and 32.
        ways = x[:, _TURNS[:, 0]] + x[:, _TURNS[:, 2]] - x[:, _TURNS[:, 1]] - x[:, _TURNS[:, 3]]
        shortest = np.argmin(np.sum(ways**2, axis=2), axis=1)
        cells = np.take_along_axis(cells, _TURNS[shortest], axis=1)
    return _halve(cells, _CHILDREN[cells.shape[1] - 1], edges, len(positions))


def refine_facets(facets: np.ndarray, edges: np.ndarray, n_nodes: int) -> np.ndarray:
    """Return the 2^(d-1) children of every facet, (2^(d-1) F, d) int32, oriented as these."""
    return _halve(facets, _FACETS[facets.shape[1]], edges, n_nodes)


def _halve(
    cells: np.ndarray, children: tuple[tuple[tuple[int, int], ...], ...], edges: np.ndarray, n: int
) -> np.ndarray:
    ends = cells[:, np.array(children)]  # (E, child, corner, end of the edge)
    first, last = ends.min(axis=-1), ends.max(axis=-1)
    keys = edges[:, 0].astype(np.int64) * n + edges[:, 1]
    middle = n + np.searchsorted(keys, first.astype(np.int64) * n + last)
    nodes = np.where(first == last, first, middle)
    return nodes.reshape(-1, nodes.shape[-1]).astype(np.int32)
