"""Simulations as files for ParaView: one VTU file per time level and a PVD file that lists them.

Open the PVD file; "Warp By Vector" with `displacement` shows the motion. The files hold the
reference configuration and, on the nodes,

    displacement, velocity, control    three components, missing ones zero
    contact_impulse, contact_pressure  of the step that ends at this time; zero off the contact set
    gap                                NaN off the contact set

`write_time_series` writes a motion that is there, `TimeSeries` one that is being made.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.motion.checks import check_every_step
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.output.vtu import (
    check_motion,
    check_series,
    nodal_fields,
    read_list,
    write_level,
    write_list,
)
from jaxcontact.scene.mesh import Mesh
from jaxcontact.system.system import System
from jaxcontact.transforms.files import make_folder

__all__ = ["TimeSeries", "write_time_series"]


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
    with their times. Files of these names are replaced, each as a whole; those of an earlier series
    of this name are removed, no other file is touched. The PVD file never lists a file that is not
    there, whenever the writing ends.

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
    check_series(path, mesh, system)
    check_motion(mesh, trajectory, control)
    if every < 1:
        raise ValueError(f"every must be 1 or more, got {every}")
    fields = nodal_fields(system, trajectory, control)
    time = np.asarray(trajectory.time)
    steps = len(time) - 1
    folder = path.with_suffix("")
    make_folder(folder)
    times = {}
    for level in [*range(0, steps, every), steps]:
        name = f"{path.stem}_{level:0{len(str(steps))}d}.vtu"
        write_level(folder / name, mesh, fields, level)
        times[name] = time[level]
    write_list(path, times)
    return [path, *(folder / name for name in times)]


class TimeSeries:
    """A time series for ParaView that grows with a simulation in parts."""

    def __init__(self, path: str | os.PathLike[str], mesh: Mesh, system: System):
        """Name the series; what there is of it is kept until a part replaces it.

        Args:
            path: the PVD file; its folder is made if there is none.
            mesh: the mesh of the scene.
            system: the discretised scene.

        Raises:
            ValueError: if the path does not end in .pvd, or the mesh is that of another system.
            OSError: if the folder cannot be made.
        """
        self._path, self._mesh, self._system = Path(path), mesh, system
        check_series(self._path, mesh, system)
        make_folder(self._path.with_suffix(""))

    def append(
        self, trajectory: Trajectory, first_step: int, control: ArrayLike | None = None
    ) -> None:
        """Write the recorded states of a part of the motion, one file each.

        The series holds afterwards what it held up to the start of the part, and the part: after a
        kill the same part, or an earlier one, can be written again. Files are named by step.

        Args:
            trajectory: the part, T steps; `save_every` thins it out.
            first_step: number of steps before the part, 0 for the first.
            control: the control of the part, (T, N, d).

        Raises:
            ValueError: if shapes differ, first_step is negative, or the PVD file is none.
            OSError: if a file cannot be written.
        """
        check_motion(self._mesh, trajectory, control)
        if first_step < 0:
            raise ValueError(f"first_step must not be negative, got {first_step}")
        fields = nodal_fields(self._system, trajectory, control)
        steps, levels = len(trajectory.contact_impulse), len(trajectory.unknowns)
        numbers = first_step + np.arange(0, steps + 1, steps // (levels - 1))
        names = [f"{self._path.stem}_{number:09d}.vtu" for number in numbers]
        # The part before ends where this one starts, and knows the step that led there.
        before = read_list(self._path) if first_step else {}
        times = {name: time for name, time in before.items() if name <= names[0]}
        dt = float(trajectory.dt)
        for level, (name, number) in enumerate(zip(names, numbers, strict=True)):
            if name not in times:
                write_level(self._path.with_suffix("") / name, self._mesh, fields, level)
                times[name] = float(number * dt)
        write_list(self._path, times)
