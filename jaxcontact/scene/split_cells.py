"""Cells of every shape as simplices: corners only, and polytopes cut from their first nodes.

A quadrilateral is cut from its node of smallest number. A hexahedron, wedge or pyramid is the union
of the cones from its node of smallest number over the faces that do not have it, each cut in this
way. How a face is cut follows from its own nodes, so that neighbours fit, whatever their shapes.

Source: Dompierre, Labbe, Vallet, Camarero, How to subdivide pyramids, prisms and hexahedra into
tetrahedra, 8th Int. Meshing Roundtable (1999) 195-204.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import meshio

#: Corners of the faces of each shape, numbered as Abaqus does; all of them look inward.
FACES = {
    "line": ((0,), (1,)),
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "pyramid": ((0, 1, 2, 3), (0, 4, 1), (1, 4, 2), (2, 4, 3), (3, 4, 0)),
    "wedge": ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    "hexahedron": (
        (0, 1, 2, 3),
        (4, 7, 6, 5),
        (0, 4, 5, 1),
        (1, 5, 6, 2),
        (2, 6, 7, 3),
        (3, 7, 4, 0),
    ),
}
#: What each shape becomes.
_PIECES = {"quad": "triangle", "pyramid": "tetra", "wedge": "tetra", "hexahedron": "tetra"}


def shape_of(kind: str) -> tuple[str, int]:
    """Return the shape of a cell type, "tetra" for "tetra10", and its number of corners.

    The shape is empty for cells without corners as first nodes, and for points.
    """
    found = re.fullmatch(rf"({'|'.join(FACES)})\d*", kind)
    if found is None:
        return "", 0
    return found[1], 1 + max(max(face) for face in FACES[found[1]])


def make_simplicial(path: Path, source: meshio.Mesh) -> None:
    """Replace the cells of a mesh by simplices, with their data and sets, and say so.

    Args:
        path: the file, for messages.
        source: what was read; other cells stay as they are.

    Raises:
        ValueError: if there are no nodes, a cell names others, or is not convex.
    """
    if np.ndim(source.points) != 2:
        raise ValueError(f"{path}: there is no table of node positions; is the file whole?")
    points = np.asarray(source.points, float)
    points = np.pad(points, [(0, 0), (0, 3 - points.shape[1])]) if len(points) else points
    blocks: list[tuple[str, np.ndarray]] = []
    parents: list[np.ndarray | None] = []
    reduced, cut = Counter[str](), Counter[str]()
    for block in source.cells:
        kind, cells, parent = block.type, block.data, None
        shape, n_corners = shape_of(kind)
        if shape:
            _check_nodes(path, kind, np.asarray(cells), len(points))
            kind, cells = shape, np.asarray(cells).astype(np.int64)[:, :n_corners]
            if kind != block.type:
                reduced[block.type] += len(cells)
        if kind in _PIECES:
            whole, kind = kind, _PIECES[kind]
            cells, parent = _split(cells, whole)
            _check_convex(path, whole, points, cells, parent)
            cut[whole] += len(block.data)
        blocks.append((kind, cells))
        parents.append(parent)
    if reduced:
        _warn(path, f"{_listed(reduced)} cells are read by their corners: curved sides get flat")
    if cut:
        _warn(path, f"{_listed(cut)} cells are cut into simplices")
    _replace_cells(source, blocks, parents)


def _replace_cells(
    source: meshio.Mesh, blocks: list[tuple[str, np.ndarray]], parents: list[np.ndarray | None]
) -> None:
    """Put blocks in the place of those of a mesh; `parents` are the old cells of the new ones."""
    source.cells = [
        type(old)(kind, cells) for old, (kind, cells) in zip(source.cells, blocks, strict=True)
    ]
    source.cell_data = {
        key: [
            values if parent is None else np.asarray(values)[parent]
            for values, parent in zip(data, parents, strict=True)
        ]
        for key, data in source.cell_data.items()
    }
    source.cell_sets = {
        name: [
            rows if parent is None or rows is None else np.flatnonzero(np.isin(parent, rows))
            for rows, parent in zip(sets, parents, strict=True)
        ]
        for name, sets in source.cell_sets.items()
    }


def _split(cells: np.ndarray, shape: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the pieces of cells of a shape, (P, 3 or 4), and the cell of each, (P,) in order."""
    rows = np.arange(len(cells))
    if shape == "quad":
        pieces, parents = _fan(cells), np.tile(rows, 2)
    else:
        first = cells.argmin(axis=1)
        parts, owners = [], []
        for face in FACES[shape]:
            has_not = ~np.isin(first, face)
            triangles = _fan(cells[has_not][:, face])
            owner = np.tile(rows[has_not], len(face) - 2)
            # The faces look inward: turned, they make a positive piece with the node above them.
            parts.append(np.column_stack([cells[owner, first[owner]], triangles[:, ::-1]]))
            owners.append(owner)
        pieces, parents = np.concatenate(parts), np.concatenate(owners)
    order = np.argsort(parents, kind="stable")
    return pieces[order], parents[order]


def _fan(polygons: np.ndarray) -> np.ndarray:
    """Return the triangles of polygons (F, k) from their smallest nodes, (F (k - 2), 3)."""
    k = polygons.shape[1]
    turns = (polygons.argmin(axis=1)[:, None] + np.arange(k)[None, :]) % k
    turned = np.take_along_axis(polygons, turns, axis=1)
    return np.concatenate([turned[:, [0, i, i + 1]] for i in range(1, k - 1)])


def _check_convex(
    path: Path, shape: str, points: np.ndarray, pieces: np.ndarray, parents: np.ndarray
) -> None:
    """Raise if pieces of one cell lie on different sides of each other."""
    edges = points[pieces[:, 1:]] - points[pieces[:, :1]]
    normals = np.cross(edges[:, 0], edges[:, 1])
    if pieces.shape[1] == 4:
        normals = np.sum(normals * edges[:, 2], axis=1)[:, None]
    first = np.searchsorted(parents, parents)
    folded = np.unique(parents[np.sum(normals * normals[first], axis=1) <= 0.0])
    if folded.size:
        raise ValueError(
            f"{path}: {folded.size} {shape} cells are not convex, the first is number {folded[0]} "
            "of its kind (from 0): correct its nodes, or mesh with simplices"
        )


def _check_nodes(path: Path, kind: str, cells: np.ndarray, n_nodes: int) -> None:
    outside = np.flatnonzero(((cells < 0) | (cells >= n_nodes)).any(axis=1))
    if outside.size:
        raise ValueError(
            f"{path}: {outside.size} {kind} cells name nodes that are not in the file, the first "
            f"{cells[outside[0]].tolist()} of nodes 0 to {n_nodes - 1}; write the file again"
        )


def _listed(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in counts.items())


def _warn(path: Path, message: str) -> None:
    # The line that a user wrote: above this one are make_simplicial, read_mesh and its caller.
    warnings.warn(f"{path}: {message}", stacklevel=4)
