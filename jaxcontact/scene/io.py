"""Meshes from files, in every format that meshio reads."""

from __future__ import annotations

import contextlib
import copy
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from jaxcontact.scene.abaqus import read_deck
from jaxcontact.scene.cells import boundary_facets, cell_volumes
from jaxcontact.scene.exodus import read_exodus
from jaxcontact.scene.file_groups import SIMPLICES, boundary_groups, cell_groups, node_groups
from jaxcontact.scene.gmsh_numbers import check_node_numbers
from jaxcontact.scene.mesh import Mesh
from jaxcontact.scene.split_cells import make_simplicial
from jaxcontact.transforms.files import check_is_file

if TYPE_CHECKING:
    import meshio

__all__ = ["read_mesh"]

#: What to do about words with which meshio refuses a file.
_ADVICE = {
    "parametric nodes": "save it without parametric coordinates (Gmsh: Mesh.SaveParametric=0)",
    "out of bounds": "its cells name nodes that it does not have: write it again",
    "Incompatible cell data 'gmsh:": (
        "some of its elements are in no physical group: put them into one, or save the groups "
        "only (Gmsh: Mesh.SaveAll=0) or in the older format (gmsh -format msh22)"
    ),
}

#: Formats whose readers in meshio ask for ever for the next line of a file that is cut off, and
#: whether they read text.
_ENDLESS = {
    ".nas": ("nastran", True),
    ".bdf": ("nastran", True),
    ".fem": ("nastran", True),
    ".dat": ("tecplot", True),
    ".tec": ("tecplot", True),
    ".off": ("off", True),
    ".mdpa": ("mdpa", False),
    ".ply": ("ply", False),
}


class _EndingText(io.TextIOWrapper):
    """A text file that does not end in silence."""

    n_empty = 0

    def readline(self, size: int = -1, /) -> str:
        """Return the next line; an EOFError if there has been none for a hundred times."""
        return _count_empty(self, super().readline(size))


class _EndingBytes(io.BufferedReader):
    """A binary file that does not end in silence."""

    n_empty = 0

    def readline(self, size: int | None = -1, /) -> bytes:
        """Return the next line; an EOFError if there has been none for a hundred times."""
        return _count_empty(self, super().readline(size))


Line = TypeVar("Line", str, bytes)


def _count_empty(file: _EndingText | _EndingBytes, line: Line) -> Line:
    file.n_empty = 0 if line else file.n_empty + 1
    if file.n_empty > 100:
        raise EOFError("the file is cut off")
    return line


def read_mesh(path: str | os.PathLike[str], *, dimension: int | None = None) -> Mesh:
    """Read the cells of the highest dimension in a file as simplices, with its named groups.

    Holds afterwards: nodes that no cell uses are gone, constant trailing coordinates of line and
    planar meshes are dropped, and inverted cells are turned over. Cells of higher order are read by
    their corners, quadrilaterals, pyramids, wedges and hexahedra are cut into simplices that fit
    (`scene/split_cells.py`); both with a warning.

    Named groups become facet sets where they hold facets and regions where they hold cells:

    - Gmsh physical groups, groups of MED, blocks and side sets of Exodus, and the sets of elements
      and surfaces of Abaqus and others, by name;
    - sets of nodes by name, as the boundary facets that have all their nodes in the set;
    - groups that only have a number (Gmsh, Medit, SU2, TetGen) by that number, such as "7";
    - integer cell data of other formats (VTK, VTU) by array and number, such as "mat_id:7".

    Facets off the boundary, sets of nodes without a facet, and arrays of more than 256 numbers
    are left out with a warning. Parts that share no nodes are several bodies: see
    `Mesh.components`.

    Args:
        path: The file; its ending tells the format.
        dimension: Dimension of the cells to read, 1, 2 or 3; by default the highest in the file.

    Returns:
        The mesh, in the length unit of the file (the package expects metres).

    Raises:
        OSError: There is no file, it is a folder, or it cannot be opened.
        ImportError: The format needs another package, as XDMF and MED need h5py.
        ValueError: The file cannot be read as a mesh, has no cells of this dimension, has cells
            that are not convex or no polytopes with corners, names nodes that it does not have,
            lacks the cells of the body, is a curved or tilted surface or curve, or holds a mesh
            that `Mesh.from_arrays` refuses.
    """
    path = Path(path)
    source, model_dimension = read_source(path)
    return mesh_of(source, path, dimension, model_dimension)


def read_source(path: Path) -> tuple[meshio.Mesh, int]:
    """Return what meshio reads from a file, and the dimension of its model, 0 if it tells none."""
    return _read(path), _gmsh_dimension(path)


def mesh_of(
    source: meshio.Mesh, path: Path, dimension: int | None, model_dimension: int = 0
) -> Mesh:
    """Return the mesh in what meshio has read; see `read_mesh`.

    Args:
        source: cells, points and groups; not changed.
        path: the file, or where they come from, for messages.
        dimension: dimension of the cells to take; None is the highest.
        model_dimension: dimension of the geometry that they are the mesh of; 0 is not known.
    """
    source = copy.copy(source)
    make_simplicial(path, source)
    d = dimension if dimension is not None else max((b.dim for b in source.cells), default=0)
    if d not in (1, 2, 3):
        raise ValueError(
            f"{path}: dimension is {d}, but must be 1, 2 or 3; the file has {_contents(source)}"
        )
    others = sorted({b.type for b in source.cells if b.dim == d and b.type != SIMPLICES[d]})
    if others:
        raise ValueError(
            f"{path}: cells of type {', '.join(others)} are not supported; split them into "
            f"{SIMPLICES[d]} cells or mesh again (Gmsh: -order 1 and no recombination)"
        )
    if dimension is None and d < model_dimension:
        raise ValueError(
            f"{path}: the model has dimension {model_dimension}, but the file has only "
            f"{_contents(source)}, since the body is in no physical group; put it into one, or "
            f"read the {SIMPLICES[d]} cells with dimension={d}"
        )
    corners = _simplices(source, d)
    if not len(corners):
        raise ValueError(
            f"{path}: no {SIMPLICES[d]} cells; the file has {_contents(source)}: choose another "
            "dimension= or save the cells of the body too"
        )
    regions = cell_groups(path, source, d)
    if "gmsh:physical" in source.cell_data:
        corners, regions = _once(corners, regions)
    used, cells = np.unique(corners, return_inverse=True)
    points = _drop_flat_axes(path, np.asarray(source.points, dtype=np.float64)[used], d)
    cells = _turn_over(points, cells.reshape(corners.shape))
    number = np.full(len(source.points), -1)
    number[used] = np.arange(len(used))
    boundary = boundary_facets(cells)
    # Facets that are named as such go before those that a set of nodes encloses.
    facet_sets = node_groups(path, source, number, boundary) | boundary_groups(
        path, cell_groups(path, source, d - 1), number[_simplices(source, d - 1)], boundary
    )
    return Mesh.from_arrays(points, cells, facet_sets, regions)


def _read(path: Path) -> meshio.Mesh:
    """The meshio mesh in a file; a file that does not parse becomes a ValueError."""
    # Here and not above: its import takes longer than that of this package without JAX.
    import meshio

    check_is_file(path)
    if path.suffix.lower() == ".inp":
        return read_deck(path)
    with path.open("rb"):
        pass
    if path.suffix.lower() == ".msh":
        check_node_numbers(path)
    # meshio prints why a format did not fit and, when none is left, ends the interpreter.
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            if path.suffix.lower() in (".e", ".exo", ".ex2"):
                return read_exodus(path)
            if path.suffix.lower() not in _ENDLESS:
                return meshio.read(path)
            file_format, is_text = _ENDLESS[path.suffix.lower()]
            file = _EndingBytes(path.open("rb", buffering=0))
            with _EndingText(file) if is_text else file as lines:
                return meshio.read(lines, file_format)
    except OSError:
        raise
    except ImportError as error:
        raise ImportError(
            f"{path}: {error}; pip install 'jaxcontact[formats]' for what this format needs"
        ) from error
    except (Exception, SystemExit) as error:
        reason = " ".join(said.getvalue().split()) or repr(error)
        advice = [text for words, text in _ADVICE.items() if words in reason] or [
            "check that its ending tells the format, or convert it with `meshio convert`"
        ]
        raise ValueError(f"{path}: meshio cannot read this file ({reason}); {advice[0]}") from error


def _gmsh_dimension(path: Path) -> int:
    """The dimension of the geometry that a Gmsh file of format 4 describes; 0 for other files."""
    content = path.read_bytes() if path.suffix.lower() == ".msh" else b""
    header = content[: content.find(b"$EndMeshFormat")].split()
    start = content.find(b"$Entities")
    if start < 0 or len(header) < 4:
        return 0
    _, entities = content[start : start + 200].split(b"\n", 1)
    is_binary, size = header[2] == b"1", int(header[3])
    counts = np.frombuffer(entities, f"u{size}", 4) if is_binary else entities.split()[:4]
    return max((d for d in range(4) if int(counts[d])), default=0)


def _once(
    cells: np.ndarray, regions: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The cells with each once, and the regions; Gmsh repeats a cell for each of its groups."""
    _, first, inverse = np.unique(
        np.sort(cells, axis=1), axis=0, return_index=True, return_inverse=True
    )
    kept = np.sort(first)
    renumbered = np.searchsorted(kept, first[inverse.ravel()])
    return cells[kept], {name: np.unique(renumbered[rows]) for name, rows in regions.items()}


def _contents(source: meshio.Mesh) -> str:
    counts = {}
    for block in source.cells:
        counts[block.type] = counts.get(block.type, 0) + len(block.data)
    return ", ".join(f"{n} {kind} cells" for kind, n in counts.items()) or "no cells"


def _simplices(source: meshio.Mesh, dimension: int) -> np.ndarray:
    """Node indices of all simplices of this dimension, in the file's order, (.,d+1)."""
    blocks = [block.data for block in source.cells if block.type == SIMPLICES[dimension]]
    return np.concatenate([np.zeros((0, dimension + 1), np.int64), *blocks]).astype(np.int64)


def _drop_flat_axes(path: Path, points: np.ndarray, d: int) -> np.ndarray:
    """The first d coordinates, after a check that the others are constant, (N,.) -> (N,d)."""
    extent = np.ptp(points, axis=0)
    if (extent[d:] > 1e-10 * extent.max()).any():
        raise ValueError(
            f"{path}: the {SIMPLICES[d]} cells extend by {extent.tolist()} along the axes, but a "
            f"mesh of dimension {d} must lie flat in the first {d} coordinates: turn it, or mesh "
            "the volume"
        )
    return points[:, :d]


def _turn_over(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The cells with two nodes swapped wherever the volume is negative."""
    inverted = cell_volumes(points, cells) < 0
    cells[inverted, -2:] = cells[inverted, :-3:-1]
    return cells
