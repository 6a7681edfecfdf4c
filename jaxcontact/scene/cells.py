"""Arithmetic on the cells of a simplicial mesh: volumes, facets, connected parts."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from jaxcontact.transforms.traced import Values

# Facet i of a cell is the one opposite its vertex i, oriented outward.
_LOCAL_FACETS = {
    1: ((1,), (0,)),
    2: ((1, 2), (2, 0), (0, 1)),
    3: ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)),
}


def cell_volumes(points: Values, cells: np.ndarray) -> Values:
    """Signed volume det(x_1 - x_0, ..., x_d - x_0) / d! of every cell.

    Args:
        points: Node positions, (N,d) [m], NumPy or JAX (the result is of the same kind).
        cells: Node indices, (E,d+1).

    Returns:
        Length, area or volume of the cells, (E,) [m^d]; negative for inverted cells.
    """
    d = points.shape[1]
    edges = [points[cells[:, i]] - points[cells[:, 0]] for i in range(1, d + 1)]
    determinant = _determinant([[edge[:, j] for j in range(d)] for edge in edges])
    return determinant / math.factorial(d)


def _determinant(rows: list[list[Values]]) -> Values:
    """Laplace expansion along the first row; the entries are arrays of one shape."""
    if len(rows) == 1:
        return rows[0][0]
    minors = [[row[:j] + row[j + 1 :] for row in rows[1:]] for j in range(len(rows))]
    return sum((-1) ** j * rows[0][j] * _determinant(minor) for j, minor in enumerate(minors))


def boundary_facets(cells: np.ndarray) -> np.ndarray:
    """The facets that belong to exactly one cell, oriented outward.

    Args:
        cells: Node indices of positively oriented cells, (E,d+1).

    Returns:
        Node indices, (B,d) int32, in the order of the cells.

    Raises:
        ValueError: A facet belongs to more than two cells.
    """
    d = cells.shape[1] - 1
    facets = cells[:, np.array(_LOCAL_FACETS[d])].reshape(-1, d)  # (E,d+1,d) -> (E(d+1),d)
    keys = facet_keys(facets, int(cells.max()) + 1)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]])
    counts = np.diff(np.r_[starts, len(keys)])
    if (counts > 2).any():
        crowded = facets[order[starts[counts > 2]]]
        raise ValueError(
            f"{len(crowded)} facets belong to more than two cells, the first is "
            f"{crowded[0].tolist()}: remove duplicate or overlapping cells"
        )
    return facets[np.sort(order[starts[counts == 1]])].astype(np.int32)


def end_signs(cells: np.ndarray) -> np.ndarray:
    """Return in one dimension 1 and -1 at right and left ends of bodies, (N,); else (0,)."""
    if cells.shape[1] > 2:
        return np.zeros(0)
    n_nodes = int(cells.max()) + 1
    counts = [np.bincount(cells[:, side], minlength=n_nodes) for side in (0, 1)]
    return np.asarray(counts[1] - counts[0], float)


def area_vectors(points: Values, facets: np.ndarray, ends: Values) -> Values:
    """Return outward normals of facets, as long as their areas, (F, d) [m^(d-1)].

    Args:
        points: node positions, (N, d) [m].
        facets: (F, d).
        ends: see `end_signs`.
    """
    xp: Values = np if isinstance(points, np.ndarray) else jnp
    d = points.shape[1]
    if d == 1:
        return xp.asarray(ends, points.dtype)[facets]
    edges = points[facets[:, 1:]] - points[facets[:, :1]]
    if d == 2:
        return xp.stack([edges[:, 0, 1], -edges[:, 0, 0]], axis=1)
    return 0.5 * xp.cross(edges[:, 0], edges[:, 1])


def facet_keys(facets: np.ndarray, n_nodes: int) -> np.ndarray:
    """One number per facet that does not depend on the order of its nodes.

    Args:
        facets: Node indices in [0, n_nodes), (F,d).
        n_nodes: Number of nodes; facets to be compared need the same.

    Returns:
        Keys, (F,) int64.

    Raises:
        ValueError: 64 bits do not suffice (from two million nodes on in 3D).
    """
    if n_nodes ** facets.shape[1] >= 2**63:
        raise ValueError(f"{n_nodes} nodes are too many for 64-bit facet keys: coarsen the mesh")
    keys = np.zeros(len(facets), dtype=np.int64)
    for column in np.sort(facets, axis=1).T:
        keys = keys * n_nodes + column
    return keys


def components(cells: np.ndarray, n_nodes: int) -> np.ndarray:
    """The connected part of each node, where nodes of one cell are connected.

    Args:
        cells: Node indices, (E,d+1).
        n_nodes: Number of nodes N.

    Returns:
        Numbers of the parts, (N,) int32, from 0 on, in the order of their first nodes.
    """
    first, others = np.repeat(cells[:, 0], cells.shape[1] - 1), cells[:, 1:].ravel()
    edges = (np.ones(len(others), np.int8), (first, others))
    graph = scipy.sparse.coo_array(edges, shape=(n_nodes, n_nodes))
    return connected_components(graph, directed=False)[1].astype(np.int32)
