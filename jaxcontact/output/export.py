"""Simulations as files for ParaView: one VTU file per time level and a PVD file that lists them.

Open the PVD file; "Warp By Vector" with `displacement` shows the motion. The files hold the
reference configuration and, on the nodes,

    displacement, velocity, control    three components, missing ones zero
    contact_impulse, contact_pressure  of the step that ends at this time; zero off the contact set
    gap                                NaN off the contact set

Format: VTK XML with zlib compression, written by meshio; PVD as in the ParaView user's guide.
"""

from __future__ import annotations

import os
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.motion.checks import check_every_step
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.scene.mesh import Mesh
from jaxcontact.system.system import System
from jaxcontact.transforms.files import atomic_write, make_folder

__all__ = ["write_time_series"]

_CELL_TYPES = {1: "line", 2: "triangle", 3: "tetra"}


def write_time_series(
    path: str | os.PathLike[str],
    mesh: Mesh,
    system: System,
    trajectory: Trajectory,
    control: ArrayLike | None = None,
    *,
    every: int = 1,
) -> list[Path]:
    """Write a motion as a time series for ParaView.

    Holds afterwards: `path` lists the files `<stem>_<step>.vtu` in the folder `<stem>` beside it
    with their times. Files of these names are replaced, each as a whole, no other file is touched.
    The PVD file is the last: it never lists a file that is not there, whenever the writing ends.

    Args:
        path: the PVD file to write; its folder is made if there is none.
        mesh: the mesh of the scene.
        system: the discretised scene.
        trajectory: the motion, T steps.
        control: the control, (T, N, d); each step is written at the time where it ends, and zero
            at time zero.
        every: write every so many steps only; the first and the last time level always.

    Returns:
        The files: the PVD file, then the VTU files in time order.

    Raises:
        ValueError: if the path does not end in .pvd, `every` is not positive, shapes differ, or the
            trajectory was recorded with a save_every other than 1; `every` thins out.
        OSError: if a file cannot be written; the message names it.
    """
    check_every_step(trajectory)
    path = Path(path)
    if path.suffix != ".pvd":
        raise ValueError(f"a time series needs a path that ends in .pvd, got {str(path)!r}")
    if every < 1:
        raise ValueError(f"every must be 1 or more, got {every}")
    displacement = np.asarray(trajectory.displacement)
    steps = displacement.shape[0] - 1
    if displacement.shape[1:] != mesh.points.shape:
        raise ValueError(
            f"the displacement has nodes and components {displacement.shape[1:]}, the mesh "
            f"{mesh.points.shape}; pass the mesh of the scene that was simulated"
        )
    if control is not None and np.shape(control) != (steps, *mesh.points.shape):
        raise ValueError(
            f"control must have shape {(steps, *mesh.points.shape)}, got {np.shape(control)}"
        )
    fields = _nodal_fields(system, trajectory, control)
    time = np.asarray(trajectory.time)
    folder = path.with_suffix("")
    make_folder(folder)

    files, entries = [], []
    for level in [*range(0, steps, every), steps]:
        file = folder / f"{path.stem}_{level:0{len(str(steps))}d}.vtu"
        _write_level(file, mesh, fields, level)
        files.append(file)
        place = quoteattr(f"{folder.name}/{file.name}")
        entries.append(f'    <DataSet timestep="{time[level]:.12g}" part="0" file={place}/>')
    with atomic_write(path, "w") as pvd:
        pvd.write(
            '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
            + "\n".join(entries)
            + "\n  </Collection>\n</VTKFile>\n"
        )
    return [path, *files]


def _nodal_fields(
    system: System, trajectory: Trajectory, control: ArrayLike | None
) -> dict[str, np.ndarray]:
    """Return the fields at the T+1 time levels, (T+1, N, 3) or (T+1, N) each."""
    impulse = _from_time_zero(np.asarray(trajectory.contact_impulse))
    dt = _from_time_zero(np.diff(np.asarray(trajectory.time)))
    # There is no step before time zero: any length gives the pressure zero.
    dt[0] = 1.0
    pressure = impulse / (dt[:, None] * np.asarray(system.contact_area)[None, :])
    fields = {
        "displacement": _three_components(np.asarray(trajectory.displacement)),
        "velocity": _three_components(np.asarray(trajectory.velocity)),
    }
    if control is not None:
        fields["control"] = _three_components(_from_time_zero(np.asarray(control)))
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


def _from_time_zero(steps: np.ndarray) -> np.ndarray:
    """Put zeros for time zero before the values of T steps, (T,...) -> (T+1,...)."""
    return np.concatenate([np.zeros_like(steps[:1]), steps])


def _three_components(vectors: np.ndarray) -> np.ndarray:
    """Fill up vectors (..., d) with zeros to three components, as VTK wants them."""
    padding = [(0, 0)] * (vectors.ndim - 1) + [(0, 3 - vectors.shape[-1])]
    return np.pad(vectors, padding)


def _write_level(file: Path, mesh: Mesh, fields: dict[str, np.ndarray], level: int) -> None:
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
