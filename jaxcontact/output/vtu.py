"""The files of ParaView: one VTU file per time level and a PVD file that lists them with times.

Format: VTK XML with zlib compression, written by meshio; PVD as in the ParaView user's guide. Every
file is written as a whole, and the PVD file after those that it lists, so that a series can be
opened at any moment, also while it grows or after its program was killed.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.scene.mesh import Mesh
from jaxcontact.system.system import System
from jaxcontact.transforms.files import atomic_write

_CELL_TYPES = {1: "line", 2: "triangle", 3: "tetra"}


def check_series(path: Path, mesh: Mesh, system: System) -> None:
    """Check what a series is made of.

    Raises:
        ValueError: if the path does not end in .pvd, or the mesh is that of another system.
    """
    if path.suffix != ".pvd":
        raise ValueError(f"a time series needs a path that ends in .pvd, got {str(path)!r}")
    if system.points.shape != mesh.points.shape:
        raise ValueError(
            f"the system has nodes and components {system.points.shape}, the mesh "
            f"{mesh.points.shape}; pass the mesh of the scene that was simulated"
        )


def check_motion(mesh: Mesh, trajectory: Trajectory, control: ArrayLike | None) -> None:
    """Raise a ValueError if a motion or its control are not of the mesh."""
    shape, steps = trajectory.displacement.shape[1:], len(trajectory.contact_impulse)
    if shape != mesh.points.shape:
        raise ValueError(
            f"the displacement has nodes and components {shape}, the mesh "
            f"{mesh.points.shape}; pass the mesh of the scene that was simulated"
        )
    if control is not None and np.shape(control) != (steps, *mesh.points.shape):
        raise ValueError(
            f"control must have shape {(steps, *mesh.points.shape)}, got {np.shape(control)}"
        )


def nodal_fields(
    system: System, trajectory: Trajectory, control: ArrayLike | None
) -> dict[str, np.ndarray]:
    """Return the fields at the recorded time levels, (L, N, 3) or (L, N) each.

    Those of a step are at the level with which it ends, and zero at time zero.
    """
    stride = len(trajectory.contact_impulse) // (len(trajectory.unknowns) - 1)
    impulse = _at_levels(np.asarray(trajectory.contact_impulse), stride)
    area = np.asarray(trajectory.dt) * np.asarray(system.contact_area)
    pressure = impulse / area[None, :]
    fields = {
        "displacement": _three_components(np.asarray(trajectory.displacement)),
        "velocity": _three_components(np.asarray(trajectory.velocity)),
    }
    if control is not None:
        fields["control"] = _three_components(_at_levels(np.asarray(control), stride))
    nodes, shape = np.asarray(system.contact_nodes), (len(impulse), system.n_nodes)
    # A node may be in several contact sets: forces add up, the smallest gap counts.
    gap = np.asarray(trajectory.gap)
    fields |= {"contact_impulse": np.zeros(shape), "contact_pressure": np.zeros(shape)}
    fields["gap"] = np.full(shape, np.nan)
    for pair, node in enumerate(nodes):
        fields["contact_impulse"][:, node] += impulse[:, pair]
        fields["contact_pressure"][:, node] += pressure[:, pair]
        fields["gap"][:, node] = np.fmin(fields["gap"][:, node], gap[:, pair])
    return fields


def _at_levels(steps: np.ndarray, stride: int) -> np.ndarray:
    """Return values of T steps at the levels 0, k, ..., T, (T,...) -> (T/k+1,...)."""
    return np.concatenate([np.zeros_like(steps[:1]), steps[stride - 1 :: stride]])


def _three_components(vectors: np.ndarray) -> np.ndarray:
    """Fill up vectors (..., d) with zeros to three components, as VTK wants them."""
    padding = [(0, 0)] * (vectors.ndim - 1) + [(0, 3 - vectors.shape[-1])]
    return np.pad(vectors, padding)


def write_level(file: Path, mesh: Mesh, fields: Mapping[str, np.ndarray], level: int) -> None:
    """Write the VTU file of one time level."""
    # Here and not above: its import takes longer than that of this package without JAX.
    import meshio

    picture = meshio.Mesh(
        _three_components(np.asarray(mesh.points)),
        [(_CELL_TYPES[mesh.dimension], np.asarray(mesh.cells))],
        point_data={name: series[level] for name, series in fields.items()},
    )
    with atomic_write(file, "wb") as vtu:
        # The writer of meshio opens a name, never a file: it gets that of the unfinished file.
        picture.write(vtu.name, file_format="vtu")


def write_list(path: Path, times: Mapping[str, float]) -> None:
    """Write the PVD file of a series, and remove VTU files of its name that it does not list.

    Args:
        path: the PVD file.
        times: time [s] of each VTU file by its name in the folder of the series.
    """
    folder = path.with_suffix("")
    entries = [
        f'    <DataSet timestep="{time:.12g}" part="0" file={quoteattr(f"{folder.name}/{name}")}/>'
        for name, time in times.items()
    ]
    with atomic_write(path, "w") as pvd:
        pvd.write(
            '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
            + "\n".join(entries)
            + "\n  </Collection>\n</VTKFile>\n"
        )
    for file in folder.iterdir():
        if re.fullmatch(rf"{re.escape(path.stem)}_\d+\.vtu", file.name) and file.name not in times:
            file.unlink()


def read_list(path: Path) -> dict[str, float]:
    """Return what `write_list` wrote, nothing if there is no such file.

    Raises:
        ValueError: if the file is no PVD file.
    """
    if not path.exists():
        return {}
    try:
        entries = ElementTree.parse(path).findall(".//DataSet")
        return {Path(x.attrib["file"]).name: float(x.attrib["timestep"]) for x in entries}
    except (ElementTree.ParseError, KeyError) as error:
        raise ValueError(f"{path} is no time series ({error}); remove it first") from error
