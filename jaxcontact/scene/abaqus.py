"""Abaqus decks: nodes, elements of the body, and the sets and surfaces that name them.

Own code because meshio knows few element types (not CPE3), no surfaces, and names the wrong cells
where a block of elements has no set. Source: Abaqus Analysis User's Guide (2016), 2.2 (nodes,
elements, sets, surfaces) and 28.1 (faces of elements).
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxcontact.scene.split_cells import FACES, shape_of
from jaxcontact.transforms.files import check_is_file

if TYPE_CHECKING:
    import meshio

#: Element types by shape, without the letters that choose a formulation.
_TYPES = {
    "line": r"(T[23]D2|B[23][13]|R2D2|RAX2|DC1D2|SAX1)[A-Z]*",
    "line3": r"(T[23]D3|B[23]2|DC1D3|SAX2)[A-Z]*",
    "triangle": r"(CPS3|CPE3|CPEG3|CAX3|S3|STRI3|R3D3|M3D3|SFM3D3|DC2D3|DS3)[A-Z]*",
    "triangle6": r"(CPS6|CPE6|CPEG6|CAX6|STRI65|M3D6|SFM3D6|DC2D6|DS6)[A-Z]*",
    "quad": r"(CPS4|CPE4|CPEG4|CAX4|S4|R3D4|M3D4|SFM3D4|DC2D4|DS4)[A-Z]*5?",
    "quad8": r"(CPS8|CPE8|CPEG8|CAX8|S8|M3D8|SFM3D8|DC2D8|DS8)[A-Z]*5?",
    "quad9": r"M3D9[A-Z]*",
    "tetra": r"(D?C3D4)[A-Z]*",
    "tetra10": r"(D?C3D10)[A-Z]*",
    "pyramid": r"(D?C3D5)[A-Z]*",
    "wedge": r"(D?C3D6|SC6)[A-Z]*",
    "wedge15": r"(D?C3D15)[A-Z]*",
    "hexahedron": r"(D?C3D8|SC8)[A-Z]*",
    "hexahedron20": r"(D?C3D20)[A-Z]*",
    "hexahedron27": r"C3D27[A-Z]*",
}
_FACE_SHAPE = {1: "vertex", 2: "line", 3: "triangle", 4: "quad"}


class _Section(NamedTuple):
    keyword: str
    options: dict[str, str]
    """Values of the options of the keyword, by upper-case names."""
    rows: list[list[str]]
    """Entries of the data lines."""


class _Element(NamedTuple):
    kind: str
    block: int
    row: int
    nodes: tuple[int, ...]


def read_deck(path: Path) -> meshio.Mesh:
    """Return nodes, elements, sets and surfaces of a deck; faces in surfaces become cells.

    Raises:
        OSError: if the deck or a file that it includes cannot be opened.
        ValueError: if the deck is not flat, has elements of other kinds, or names something that
            it does not define.
    """
    # Here and not above: its import takes longer than that of this package without JAX.
    import meshio

    sections = list(_sections(_lines(path)))
    _check_flat(path, sections)
    deck = _Deck()
    for keywords in (("NODE",), ("ELEMENT",), ("NSET", "ELSET"), ("SURFACE",)):
        for section in sections:
            if section.keyword in keywords:
                try:
                    getattr(deck, f"add_{section.keyword.lower()}")(section)
                except (ValueError, IndexError) as error:
                    raise ValueError(f"{path}: *{section.keyword}: {error}") from error
    cells: list[Any] = [*deck.blocks, *((shape, nodes) for _, shape, nodes in deck.faces)]
    sets: dict[str, list[Any]] = {
        name: deck.rows_by_block(ids, len(cells)) for name, ids in deck.cell_sets().items()
    }
    for k, (name, _, nodes) in enumerate(deck.faces, start=len(deck.blocks)):
        rows = sets.setdefault(name, [np.zeros(0, int) for _ in cells])
        rows[k] = np.arange(len(nodes))
    return meshio.Mesh(
        np.array(deck.points),
        cells,
        cell_sets=sets,
        point_sets={name: np.array(ids) for name, ids in deck.visible(deck.node_sets).items()},
    )


class _Deck:
    """What has been read so far; names compare without case, as in Abaqus."""

    def __init__(self):
        self.points: list[list[float]] = []
        self.numbers: dict[int, int] = {}
        self.blocks: list[tuple[str, np.ndarray]] = []
        self.elements: dict[int, _Element] = {}
        self.node_sets: dict[str, list[int]] = {}
        self.element_sets: dict[str, list[int]] = {}
        self.surfaces: dict[str, list[int]] = {}
        self.faces: list[tuple[str, str, np.ndarray]] = []
        self.names: dict[str, str] = {}
        self.hidden: set[str] = set()

    def add_node(self, section: _Section) -> None:
        ids = []
        for row in section.rows:
            self.numbers[int(row[0])] = len(self.points)
            ids.append(len(self.points))
            x = [float(entry) for entry in row[1:4] if entry]
            # A coordinate that is left out is zero.
            self.points.append(x + [0.0] * (3 - len(x)))
        if "NSET" in section.options:
            self._extend(self.node_sets, section, "NSET", ids)

    def add_element(self, section: _Section) -> None:
        kind = section.options.get("TYPE", "").upper()
        cells = [cell for cell, types in _TYPES.items() if re.fullmatch(types, kind)]
        if not cells:
            raise ValueError(
                f"element type {kind or '(none)'} is not supported; mesh the body with CPE3 or "
                "CPS3 triangles or C3D4 tetrahedra, and leave out other elements"
            )
        (cell,) = cells
        entries = np.array([int(x) for row in section.rows for x in row if x], dtype=np.int64)
        n_entries = int("".join(filter(str.isdecimal, cell)) or shape_of(cell)[1]) + 1
        if entries.size % n_entries:
            raise ValueError(f"type {kind} needs {n_entries} numbers per element: itself and nodes")
        entries = entries.reshape(-1, n_entries)
        if cell == "line3":  # its middle is the second node
            entries = entries[:, [0, 1, 3, 2]]
        nodes = [tuple(self._number("node", int(k)) for k in row) for row in entries[:, 1:]]
        for row, (number, corners) in enumerate(zip(entries[:, 0], nodes, strict=True)):
            self.elements[int(number)] = _Element(cell, len(self.blocks), row, corners)
        self.blocks.append((cell, np.array(nodes, np.int64).reshape(-1, n_entries - 1)))
        if "ELSET" in section.options:
            self._extend(self.element_sets, section, "ELSET", entries[:, 0].tolist())

    def add_nset(self, section: _Section) -> None:
        if "ELSET" in section.options:
            elements = self._members(self.element_sets, "element", section.options["ELSET"])
            ids = [node for number in elements for node in self.elements[number].nodes]
        else:
            ids = self._listed(self.node_sets, "node", section)
        self._extend(self.node_sets, section, "NSET", ids)

    def add_elset(self, section: _Section) -> None:
        ids = self._listed(self.element_sets, "element", section)
        self._extend(self.element_sets, section, "ELSET", ids)

    def add_surface(self, section: _Section) -> None:
        name = section.options.get("NAME", "")
        if section.options.get("TYPE", "ELEMENT").upper() == "NODE":
            ids = [k for row in section.rows for k in self._members(self.node_sets, "node", row[0])]
            self._extend(self.node_sets, section, "NAME", ids)
            return
        faces: dict[str, list[tuple[int, ...]]] = {}
        for what, *rest in section.rows:
            side = rest[0].upper() if rest else ""
            members = self._members(self.element_sets, "element", what)
            if side in ("SPOS", "SNEG"):
                # The elements themselves: a skin of shells on the body.
                self.surfaces.setdefault(name, []).extend(members)
                continue
            for number in members:
                element = self.elements[number]
                for face in self._sides(element, side):
                    faces.setdefault(_FACE_SHAPE[len(face)], []).append(face)
        self.faces += [(name, shape, np.array(nodes)) for shape, nodes in faces.items()]

    def visible(self, sets: dict[str, list[int]]) -> dict[str, list[int]]:
        """Return the sets that a user named, which are not empty, under their names."""
        shown = {key: ids for key, ids in sets.items() if ids and key not in self.hidden}
        return {self.names[key]: ids for key, ids in shown.items()}

    def cell_sets(self) -> dict[str, list[int]]:
        """Return the element numbers of every set and of every surface of whole elements."""
        found = self.visible(self.element_sets)
        for name, ids in self.surfaces.items():
            found[name] = [*found.get(name, []), *ids]
        return found

    def rows_by_block(self, numbers: list[int], n_blocks: int) -> list[np.ndarray]:
        """Return the rows in each block of elements with these numbers."""
        rows: list[list[int]] = [[] for _ in range(n_blocks)]
        for number in numbers:
            element = self.elements[number]
            rows[element.block].append(element.row)
        return [np.unique(np.array(row, int)) for row in rows]

    def _sides(self, element: _Element, side: str) -> list[tuple[int, ...]]:
        """Return the face that a label such as S2 names, or without one all outer faces."""
        shape = shape_of(element.kind)[0]
        faces = [tuple(element.nodes[k] for k in face) for face in FACES[shape]]
        if not side:
            return [face for face in faces if self._face_counts[frozenset(face)] == 1]
        labels = [f"{letter}{k + 1}" for k in range(len(faces)) for letter in "SE"]
        if side not in labels:
            raise ValueError(f"a {shape} has no face {side}; use {labels}")
        return [faces[labels.index(side) // 2]]

    @cached_property
    def _face_counts(self) -> Counter[frozenset[int]]:
        return Counter(
            frozenset(element.nodes[k] for k in face)
            for element in self.elements.values()
            for face in FACES[shape_of(element.kind)[0]]
        )

    def _listed(self, sets: dict[str, list[int]], kind: str, section: _Section) -> list[int]:
        if "GENERATE" not in section.options:
            return [
                number
                for entry in itertools.chain.from_iterable(section.rows)
                if entry
                for number in self._members(sets, kind, entry)
            ]
        ranges = [[int(x) for x in row if x] for row in section.rows]
        if any(len(row) not in (2, 3) for row in ranges):
            raise ValueError("GENERATE takes first, last and increment in a line")
        numbers = [k for first, last, *step in ranges for k in range(first, last + 1, *step)]
        return [self._number(kind, number) for number in numbers]

    def _members(self, sets: dict[str, list[int]], kind: str, entry: str) -> list[int]:
        """Return what a number or the name of a set stands for."""
        if entry.lstrip("-").isdecimal():
            return [self._number(kind, int(entry))]
        if entry.upper() not in sets:
            known = sorted(self.names[key] for key in sets)
            raise ValueError(f"no {kind} set {entry!r} is defined; there are {known}")
        return sets[entry.upper()]

    def _number(self, kind: str, number: int) -> int:
        """Return the index of a node, or the number of an element, that must exist."""
        known = self.numbers if kind == "node" else self.elements
        if number not in known:
            raise ValueError(f"{kind} {number} is named, but not defined; add it")
        return self.numbers[number] if kind == "node" else number

    def _extend(
        self, sets: dict[str, list[int]], section: _Section, option: str, ids: list[int]
    ) -> None:
        name = section.options.get(option, "")
        self.names.setdefault(name.upper(), name)
        sets.setdefault(name.upper(), []).extend(ids)
        if "INTERNAL" in section.options:
            self.hidden.add(name.upper())


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines that are not empty or comments, those of included files in their place."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for raw in file:
            line = raw.strip()
            if not line or line.startswith("**"):
                continue
            if line.upper().startswith("*INCLUDE"):
                included = path.parent / line.partition("=")[2].strip().strip('"')
                check_is_file(included)
                yield from _lines(included)
            else:
                yield line


def _sections(lines: Iterator[str]) -> Iterator[_Section]:
    section = _Section("", {}, [])
    for line in lines:
        entries = [entry.strip() for entry in line.split(",")]
        if not line.startswith("*"):
            section.rows.append(entries)
            continue
        options = [entry.partition("=") for entry in entries[1:]]
        keyword = entries[0].lstrip("*").strip().upper()
        values = {key.strip().upper(): value.strip().strip('"') for key, _, value in options}
        section = _Section(keyword, values, [])
        yield section


def _check_flat(path: Path, sections: list[_Section]) -> None:
    """Check that node numbers mean one node each: at most one part, which is not moved."""
    instances = [section for section in sections if section.keyword == "INSTANCE"]
    n_parts = sum(section.keyword == "PART" for section in sections)
    if n_parts > 1 or len(instances) > 1 or any(instance.rows for instance in instances):
        raise ValueError(
            f"{path}: the deck has {n_parts} parts and {len(instances)} instances, or moves one; "
            "write it flat (Abaqus: model attribute noPartsInputFile=ON), so that each node has "
            "one number"
        )
    if not any(section.keyword == "NODE" for section in sections):
        raise ValueError(f"{path}: no *NODE section; is this an Abaqus deck with a mesh?")
