"""The named groups of cells and nodes in a mesh file, in whatever way its format names them.

Gmsh numbers and names physical groups; MED numbers families, each of which belongs to any number of
named groups; Abaqus, Exodus and others have sets of cells and nodes; Medit, SU2 and TetGen give
each cell a number, as VTK files do by an integer array of any name.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxcontact.scene.cells import facet_keys

if TYPE_CHECKING:
    import meshio

SIMPLICES = {0: "vertex", 1: "line", 2: "triangle", 3: "tetra"}

#: Arrays by which a format numbers its groups: the number alone is the name, 0 is no group.
_FORMAT_NUMBERS = ("gmsh:physical", "medit:ref", "su2:tag", "tetgen:ref")
#: Arrays that number the geometry of the file and not what the user named.
_NO_GROUPS = ("gmsh:geometrical",)
#: An array with more different numbers than this counts its cells.
_MOST_GROUPS = 256


def cell_groups(path: Path, source: meshio.Mesh, dimension: int) -> dict[str, np.ndarray]:
    """Return the simplices of a dimension in each group that has any.

    Args:
        path: the file, for warnings and for the names that meshio leaves out.
        source: what meshio read.
        dimension: dimension of the simplices.

    Returns:
        Rows of all simplices of this dimension, in the order of the file, by name.
    """
    groups: dict[str, list[np.ndarray]] = {}
    for name, rows in _named_rows(path, source, dimension):
        groups.setdefault(name, []).append(rows)
    return {name: np.unique(np.concatenate(rows)) for name, rows in groups.items()}


def node_groups(
    path: Path, source: meshio.Mesh, number: np.ndarray, boundary: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the boundary facets with all nodes in a set, for each set of nodes that has any.

    Args:
        path: the file, for warnings.
        source: what meshio read.
        number: new number of each node of the file, -1 for a node that is left out.
        boundary: all boundary facets in new numbers, (B,d).
    """
    facets = {}
    sets = dict(source.point_sets)
    for tag, names in getattr(source, "point_tags", {}).items():
        inside = np.flatnonzero(source.point_data["point_tags"] == tag)
        for name in names:
            sets[name] = np.concatenate([sets.get(name, inside[:0]), inside])
    for name, nodes in sets.items():
        inside = np.isin(boundary, number[np.asarray(nodes, dtype=np.int64)]).all(axis=1)
        if inside.any():
            facets[name] = boundary[inside]
        else:
            _warn(path, f"node set {name!r} is left out, it holds no whole facet of the boundary")
    return facets


def boundary_groups(
    path: Path, groups: dict[str, np.ndarray], facets: np.ndarray, boundary: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the facets of each group, each once; a group off the boundary is left out.

    Args:
        path: the file, for warnings.
        groups: rows of `facets` by name.
        facets: all facets of the file, (F,d).
        boundary: all boundary facets, (B,d).
    """
    n_nodes = int(max(facets.max(initial=0), boundary.max())) + 2
    # Nodes that are left out are -1; keys count from zero.
    keys = facet_keys(facets + 1, n_nodes)
    on_boundary = np.isin(keys, facet_keys(boundary + 1, n_nodes))
    sets = {}
    for name, group in groups.items():
        n_inside = np.count_nonzero(~on_boundary[group])
        if n_inside:
            _warn(
                path,
                f"group {name!r} is left out, {n_inside} of its {len(group)} facets are not on "
                "the boundary of the mesh",
            )
        else:
            _, first = np.unique(keys[group], return_index=True)
            sets[name] = facets[group[np.sort(first)]]
    return sets


def _named_rows(
    path: Path, source: meshio.Mesh, dimension: int
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield a name and rows; one name may come several times."""
    arrays = {
        key: [np.asarray(values) for values in blocks]
        for key, blocks in source.cell_data.items()
        if key not in _NO_GROUPS and _is_numbering(path, key, blocks)
    }
    names = _names_of_numbers(path, source, dimension)
    start = 0
    for i, block in enumerate(source.cells):
        if block.type != SIMPLICES[dimension]:
            continue
        for key, blocks in arrays.items():
            is_format = key in _FORMAT_NUMBERS or (key == "cell_tags" and bool(names))
            # Gmsh gives a reversed group the negative number.
            numbers = np.abs(blocks[i]) if key == "gmsh:physical" else blocks[i]
            for value in np.unique(numbers):
                if is_format and value == 0:
                    continue
                own = [str(value)] if is_format else [f"{key}:{value}"]
                for name in names.get(int(value), own) if is_format else own:
                    yield name, start + np.flatnonzero(numbers == value)
        for name, blocks in source.cell_sets.items():
            # The bounding entities of Gmsh are None for a point.
            if not name.startswith("gmsh:") and np.size(blocks[i]):
                yield name, start + np.asarray(blocks[i], dtype=np.int64)
        start += len(block.data)


def _is_numbering(path: Path, key: str, blocks: list) -> bool:
    """Return True if the numbers of cells, by blocks, stand for groups."""
    values = [np.asarray(block) for block in blocks]
    if any(array.ndim != 1 or array.dtype.kind not in "iu" for array in values):
        return False
    n_groups = np.unique(np.concatenate(values)).size if values else 0
    if n_groups > _MOST_GROUPS:
        _warn(path, f"cell data {key!r} is left out, {n_groups} different numbers are no groups")
    return n_groups <= _MOST_GROUPS


def _names_of_numbers(path: Path, source: meshio.Mesh, dimension: int) -> dict[int, list[str]]:
    """Return the names that a file gives to the numbers of its groups."""
    if "su2:tag" in source.cell_data:
        return {number: [name] for number, name in _su2_markers(path).items()}
    if "gmsh:physical" in source.cell_data:
        named = source.field_data.items()
        return {int(tag): [name] for name, (tag, d) in named if d == dimension}
    return getattr(source, "cell_tags", {})


def _su2_markers(path: Path) -> dict[int, str]:
    """Return the markers of an SU2 file; meshio counts those whose name is no number."""
    markers, number = {}, 0
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        key, _, value = line.partition("=")
        if key.strip() == "MARKER_TAG":
            name = value.strip()
            number = int(name) if name.lstrip("-").isdecimal() else number + 1
            markers[number] = name
    return markers


def _warn(path: Path, message: str) -> None:
    # The line that a user wrote: above this one are a helper, read_mesh and its caller.
    warnings.warn(f"{path}: {message}", stacklevel=4)
