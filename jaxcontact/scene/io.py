"""Meshes from files, in every format that meshio reads."""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxcontact.scene.mesh import Mesh, boundary_facets, cell_volumes, facet_keys

__all__ = ["read_mesh"]

_SIMPLICES = {0: "vertex", 1: "line", 2: "triangle", 3: "tetra"}


def read_mesh(path: str | os.PathLike[str], *, dimension: int | None = None) -> Mesh:
    """Read the simplices of the highest dimension in a file, with its named groups.

    Holds afterwards: nodes that no cell uses are gone, constant trailing coordinates of line and
    planar meshes are dropped, and inverted cells are turned over. Gmsh physical groups and the cell
    sets of the file (Abaqus and others) become facet sets where they hold facets and regions where
    they hold cells; a physical group without a name is called by its number. Groups with
    facets that are not on the boundary are left out with a warning.

    Args:
        path: The file; its ending tells the format.
        dimension: Dimension of the cells to read, 1, 2 or 3; by default the highest in the file.

    Returns:
        The mesh, in the length unit of the file (the package expects metres).

    Raises:
        OSError: The file cannot be opened.
        ImportError: The format needs another package, as XDMF and MED need h5py.
        ValueError: The file cannot be read as a mesh, has no simplices of this dimension, has other
            cells of this dimension, is a curved or tilted surface or curve, or holds a mesh that
            `Mesh.from_arrays` refuses.
    """
    source = _read(Path(path))
    d = dimension if dimension is not None else max((b.dim for b in source.cells), default=0)
    if d not in (1, 2, 3):
        raise ValueError(
            f"{path}: dimension is {d}, but must be 1, 2 or 3; the file has {_contents(source)}"
        )
    others = sorted({b.type for b in source.cells if b.dim == d and b.type != _SIMPLICES[d]})
    if others:
        raise ValueError(
            f"{path}: cells of type {', '.join(others)} are not linear simplices; split them into "
            f"{_SIMPLICES[d]} cells or mesh again (Gmsh: -order 1 and no recombination)"
        )
    corners = _simplices(source, d)
    if not len(corners):
        raise ValueError(
            f"{path}: no {_SIMPLICES[d]} cells; the file has {_contents(source)}: choose another "
            "dimension= or save the cells of the body too"
        )
    used, cells = np.unique(corners, return_inverse=True)
    points = _drop_flat_axes(path, np.asarray(source.points, dtype=np.float64)[used], d)
    cells = _turn_over(points, cells.reshape(corners.shape))
    number = np.full(len(source.points), -1)
    number[used] = np.arange(len(used))
    facets = number[_simplices(source, d - 1)]
    on_boundary = np.isin(
        facet_keys(facets + 1, len(used) + 1),
        facet_keys(boundary_facets(cells) + 1, len(used) + 1),
    )
    facet_sets = {}
    for name, group in _groups(source, d - 1).items():
        n_inside = np.count_nonzero(~on_boundary[group])
        if n_inside:
            warnings.warn(
                f"{path}: group {name!r} is left out, {n_inside} of its {len(group)} facets are "
                "not on the boundary of the mesh",
                stacklevel=2,
            )
        else:
            _, first = np.unique(facet_keys(facets[group], len(used)), return_index=True)
            facet_sets[name] = facets[group[np.sort(first)]]
    return Mesh.from_arrays(points, cells, facet_sets, _groups(source, d))


def _read(path: Path) -> Any:
    """The meshio mesh in a file; a file that does not parse becomes a ValueError."""
    # Here and not above: its import takes longer than that of this package without JAX.
    import meshio

    with path.open("rb"):
        pass
    # meshio prints why a format did not fit and, when none is left, ends the interpreter.
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return meshio.read(path)
    except (OSError, ImportError):
        raise
    except (Exception, SystemExit) as error:
        reason = " ".join(said.getvalue().split()) or repr(error)
        raise ValueError(
            f"{path}: meshio cannot read this file ({reason}); check that its ending tells the "
            "format, or convert it with `meshio convert`"
        ) from error


def _contents(source: Any) -> str:
    counts = {}
    for block in source.cells:
        counts[block.type] = counts.get(block.type, 0) + len(block.data)
    return ", ".join(f"{n} {kind} cells" for kind, n in counts.items()) or "no cells"


def _simplices(source: Any, dimension: int) -> np.ndarray:
    """Node indices of all simplices of this dimension, in the file's order, (.,d+1)."""
    blocks = [block.data for block in source.cells if block.type == _SIMPLICES[dimension]]
    return np.concatenate([np.zeros((0, dimension + 1), np.int64), *blocks]).astype(np.int64)


def _groups(source: Any, dimension: int) -> Mapping[str, np.ndarray]:
    """Rows of `_simplices(source, dimension)` in each named group that has any."""
    names = {tag: name for name, (tag, d) in source.field_data.items() if d == dimension}
    tags = source.cell_data.get("gmsh:physical")
    groups: dict[str, list[np.ndarray]] = {}
    start = 0
    for i, block in enumerate(source.cells):
        if block.type != _SIMPLICES[dimension]:
            continue
        if tags is not None:
            # Gmsh gives the number 0 to elements of no physical group.
            for tag in np.unique(tags[i][tags[i] != 0]):
                rows = np.flatnonzero(tags[i] == tag)
                groups.setdefault(names.get(tag, str(tag)), []).append(start + rows)
        for name, rows in source.cell_sets.items():
            if rows[i] is not None and len(rows[i]) and not name.startswith("gmsh:"):
                groups.setdefault(name, []).append(start + np.asarray(rows[i], dtype=np.int64))
        start += len(block.data)
    return {name: np.unique(np.concatenate(rows)) for name, rows in groups.items()}


def _drop_flat_axes(path: Any, points: np.ndarray, d: int) -> np.ndarray:
    """The first d coordinates, after a check that the others are constant, (N,.) -> (N,d)."""
    extent = np.ptp(points, axis=0)
    if (extent[d:] > 1e-10 * extent.max()).any():
        raise ValueError(
            f"{path}: the {_SIMPLICES[d]} cells extend by {extent.tolist()} along the axes, but a "
            f"mesh of dimension {d} must lie flat in the first {d} coordinates: turn it, or mesh "
            "the volume"
        )
    return points[:, :d]


def _turn_over(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The cells with two nodes swapped wherever the volume is negative."""
    inverted = cell_volumes(points, cells) < 0
    cells[inverted, -2:] = cells[inverted, :-3:-1]
    return cells
