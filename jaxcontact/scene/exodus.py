"""Exodus II files: element blocks, node sets and side sets with their names.

Own code because meshio reads no side sets and no names of blocks, and does not know the element
types that most programs write (TETRA4, TET4, TRI3).

Source: Schoof, Yarberry, EXODUS II: A Finite Element Data Model, SAND92-2137 (1994), 4.8 (sides).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import meshio

#: Shape and number of corners by the first letters of an element type.
_SHAPES = {
    "SPH": ("vertex", 1),
    "BAR": ("line", 2),
    "BEA": ("line", 2),
    "TRU": ("line", 2),
    "EDG": ("line", 2),
    "TRI": ("triangle", 3),
    "QUA": ("quad", 4),
    "TET": ("tetra", 4),
    "PYR": ("pyramid", 5),
    "WED": ("wedge", 6),
    "HEX": ("hexahedron", 8),
}
#: Corners of the sides 1, 2, ... of each shape.
_SIDES = {
    "line": ((0,), (1,)),
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 1, 3), (1, 2, 3), (0, 3, 2), (0, 2, 1)),
    "pyramid": ((0, 1, 4), (1, 2, 4), (2, 3, 4), (0, 4, 3), (0, 3, 2, 1)),
    "wedge": ((0, 1, 4, 3), (1, 2, 5, 4), (0, 3, 5, 2), (0, 2, 1), (3, 4, 5)),
    "hexahedron": (
        (0, 1, 5, 4),
        (1, 2, 6, 5),
        (2, 3, 7, 6),
        (0, 4, 7, 3),
        (0, 3, 2, 1),
        (4, 5, 6, 7),
    ),
}
_FACES = {1: "vertex", 2: "line", 3: "triangle", 4: "quad"}


def read_exodus(path: Path) -> meshio.Mesh:
    """Return nodes, blocks and sets of a file; sides become cells, blocks and side sets cell sets.

    Raises:
        ImportError: if netCDF4 is not there.
        OSError: if the file cannot be opened.
        ValueError: if it has elements that are not known.
    """
    import meshio
    import netCDF4  # pyright: ignore[reportMissingImports]

    with netCDF4.Dataset(path) as file:
        file.set_auto_mask(False)
        values = {name: variable[:] for name, variable in file.variables.items()}
        connections = _numbered(file.variables, "connect")
        shapes = [_shape(file.variables[name].elem_type, name) for name in connections]
    blocks = [np.asarray(values[name], np.int64) - 1 for name in connections]
    axes = [values[f"coord{axis}"] for axis in "xyz" if f"coord{axis}" in values]
    points = np.stack(axes, axis=1) if axes else values["coord"].T

    cells: list[Any] = []
    members: list[str] = []
    for name, (shape, n_corners), nodes in zip(
        _names(values, "eb", len(blocks)), shapes, blocks, strict=True
    ):
        kind = shape if nodes.shape[1] == n_corners else f"{shape}{nodes.shape[1]}"
        cells.append((kind, nodes))
        members.append(name)
    first = np.cumsum([0, *(len(nodes) for nodes in blocks)])
    sides = _numbered(values, "elem_ss")
    for name, key in zip(_names(values, "ss", len(sides)), sides, strict=True):
        elements, side = values[key] - 1, values[key.replace("elem", "side")] - 1
        owner = np.searchsorted(first, elements, side="right") - 1
        for block, number in sorted(set(zip(owner.tolist(), side.tolist(), strict=True))):
            chosen = elements[(owner == block) & (side == number)] - first[block]
            face = list(_SIDES[shapes[block][0]][number])
            cells.append((_FACES[len(face)], blocks[block][chosen][:, face]))
            members.append(name)
    nodes = _numbered(values, "node_ns")
    names = _names(values, "ns", len(nodes))
    return meshio.Mesh(
        points,
        cells,
        point_sets={name: values[key] - 1 for name, key in zip(names, nodes, strict=True)},
        cell_sets={
            name: [
                np.arange(len(rows) if member == name else 0)
                for member, (_, rows) in zip(members, cells, strict=True)
            ]
            for name in dict.fromkeys(members)
        },
    )


def _numbered(names: Iterable[str], start: str) -> list[str]:
    """Return the names `start` 1, 2, ... in this order."""
    found = [name for name in names if re.fullmatch(rf"{start}\d+", name)]
    return sorted(found, key=lambda name: int(name.removeprefix(start)))


def _shape(element_type: str, name: str) -> tuple[str, int]:
    found = _SHAPES.get(element_type.strip().upper()[:3])
    if found is None:
        raise ValueError(f"{name} has elements of type {element_type}, which is not supported")
    return found


def _names(values: dict[str, np.ndarray], kind: str, count: int) -> list[str]:
    """Return the names of blocks or sets; the number of one that has no name."""
    numbers = [str(k) for k in values.get(f"{kind}_prop1", np.arange(1, count + 1))]
    texts = [b"".join(row).split(b"\0")[0].decode() for row in values.get(f"{kind}_names", ())]
    return [text.strip() or number for text, number in zip(texts or numbers, numbers, strict=True)]
