"""Trajectories in files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from jaxcontact.motion.contact_record import ContactRecord
from jaxcontact.motion.frame_motion import FrameMotion
from jaxcontact.motion.nodal_fields import NodalFields, StoredFields
from jaxcontact.motion.schedule import Schedule
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.system.lift import Lift
from jaxcontact.transforms.saved import load_dataclass


def load_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory that `Trajectory.save` wrote, bit for bit.

    `load_trajectory(path).final` is the state from which a run goes on.

    Raises:
        OSError: if there is no such file, it is a folder, or it may not be read.
        ValueError: if the file is damaged or holds something else.
        RuntimeError: if it is in float64 while JAX has it switched off.
    """
    kinds = (Trajectory, ContactRecord, Schedule, FrameMotion, StoredFields, Lift)
    saved = load_dataclass(path, kinds)
    return replace(saved, nodal=NodalFields.from_stored(saved.nodal))
