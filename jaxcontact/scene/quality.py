"""How good the cells of a mesh are: mean ratio and heights.

The mean ratio of a simplex with volume V and edges l_ij is

    eta = (V / V_1)^(2/d) d (d+1) / 2 / sum l_ij^2,

V_1 the volume of the regular simplex with edges one: 1 for that alone, 0 for a flat cell. Its
heights are 1 / |grad l_i| with the barycentric coordinates l_i; the smallest one bounds the Courant
number c tau / h of a step.

Source: Liu, Joe, BIT 34 (1994) 268-287.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from jaxcontact.scene.cells import cell_volumes


@dataclass(frozen=True)
class MeshQuality:
    """Quality of the E cells of a mesh of dimension d; print it to read it."""

    mean_ratio: np.ndarray
    """Mean ratio eta of each cell, (E,): 1 if regular, 0 if flat. Below 0.1 is bad in 3D."""

    height: np.ndarray
    """Smallest height of each cell, (E,) [m]."""

    centre: np.ndarray
    """Mean of the corners of each cell, (E, d) [m]."""

    @property
    def minimum(self) -> float:
        """Smallest mean ratio."""
        return float(self.mean_ratio.min())

    @property
    def mean(self) -> float:
        """Mean of the mean ratios."""
        return float(self.mean_ratio.mean())

    @property
    def smallest_height(self) -> float:
        """Smallest height of a cell, [m]."""
        return float(self.height.min())

    def worst(self, count: int = 5) -> np.ndarray:
        """Return the numbers of the cells of smallest mean ratio, the worst first, (count,)."""
        return np.argsort(self.mean_ratio, kind="stable")[:count]

    def __str__(self) -> str:
        """Return a few lines: the mean ratios, the smallest height, the worst cells."""
        lowest = int(np.argmin(self.height))
        return "\n".join(
            [
                f"{len(self.mean_ratio)} cells, mean ratio (1 is regular, 0 is flat): "
                f"smallest {self.minimum:.3g}, mean {self.mean:.3g}",
                f"smallest height {self.smallest_height:.3g} m {self._place(lowest)}",
                "smallest mean ratios:",
                *(f"  {self.mean_ratio[cell]:.3g} {self._place(cell)}" for cell in self.worst()),
            ]
        )

    def _place(self, cell: int) -> str:
        place = ", ".join(f"{x:.4g}" for x in self.centre[cell])
        return f"in cell {cell} at ({place})"


def mesh_quality(positions: np.ndarray, cells: np.ndarray) -> MeshQuality:
    """Return the quality of cells (E, d+1) at node positions (N, d)."""
    d = positions.shape[1]
    corners = positions[cells]
    edges = corners[:, 1:] - corners[:, :1]
    gradients = np.linalg.inv(edges).swapaxes(1, 2)  # of the coordinates 1 to d, (E,a,d)
    gradients = np.concatenate([gradients, -gradients.sum(axis=1, keepdims=True)], axis=1)
    pairs = itertools.combinations(range(d + 1), 2)
    squares = sum(np.sum((corners[:, i] - corners[:, j]) ** 2, axis=1) for i, j in pairs)
    regular = math.sqrt((d + 1) / 2**d) / math.factorial(d)
    size = (np.abs(cell_volumes(positions, cells)) / regular) ** (2 / d)
    return MeshQuality(
        mean_ratio=size * (d * (d + 1) / 2) / squares,
        height=1.0 / np.linalg.norm(gradients, axis=2).max(axis=1),
        centre=corners.mean(axis=1),
    )
