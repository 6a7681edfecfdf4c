"""Node numbers of a Gmsh file that no table holds."""

from __future__ import annotations

import contextlib
import itertools
from pathlib import Path

#: The reader makes a table up to the largest number: so many entries for a node, and some more.
ENTRIES, MORE = 1000, 10**7


def check_node_numbers(path: Path) -> None:
    """Refuse a text file of format 2.2 whose node numbers are far beyond the number of nodes.

    Raises:
        ValueError: if a table of them would not be of the size of the file.
    """
    largest, count = 0.0, 0
    with path.open("rb") as file, contextlib.suppress(ValueError, IndexError, StopIteration):
        if next(file).strip() != b"$MeshFormat" or not next(file).startswith(b"2.2 0"):
            return
        next(line for line in file if line.strip() == b"$Nodes")
        count = int(next(file))
        rows = itertools.takewhile(lambda line: not line.startswith(b"$"), file)
        for row in itertools.islice(rows, count + 1):
            largest = max(largest, float(row.split(None, 1)[0]))
    if largest > ENTRIES * count + MORE:
        raise ValueError(
            f"{path}: a node has the number {largest:.0f}, but there are {count}; is the file "
            "damaged? Otherwise number the nodes anew (Gmsh: Mesh.Renumber=1)"
        )
