"""The frames of bodies that turn over a whole motion."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import AlongDirection, WeakContact
from jaxcontact.motion.schedule import Schedule
from jaxcontact.schemes import StepState
from jaxcontact.system.frames import FrameState
from jaxcontact.system.system import System


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FrameMotion:
    """Place and deformation of F bodies with frames over T steps; n unknowns, dimension d."""

    rotation: Array
    """Rotation R of each body, (T+1, F, d, d)."""

    centre: Array
    """Mass centre of each body, (T+1, F, d) [m]."""

    deformation: Array
    """Deformation u in the axes of the body, (T+1, n) [m]: `system.lift` makes it nodal, for
    `stress`. Of a body without frame, its displacement."""

    @property
    def states(self) -> FrameState:
        """What the steps have handed on."""
        return FrameState(self.rotation, self.deformation)


def frame_motion(
    system: System, start: StepState, states: StepState, displacement: Array
) -> FrameMotion | None:
    """Return the frames of a start and the recorded states after it; None without frames."""
    frames = system.frames
    if frames is None or start.frames is None or states.frames is None:
        return None
    rotation, deformation = (
        jnp.concatenate([first[None], later])
        for first, later in zip(start.frames, states.frames, strict=True)
    )

    def centre(y: Array) -> Array:
        y = y.reshape(frames.reference.shape)
        return frames.origin + frames.sums(y, frames.moments[:, :1])[:, :, 0]

    return FrameMotion(rotation, jax.vmap(centre)(displacement), deformation)


def turning(frames: FrameMotion | None) -> FrameMotion:
    """Return the frames of a motion.

    Raises:
        ValueError: if there are none.
    """
    if frames is None:
        raise ValueError("no body has a frame; discretize a scene with large_rotation=True")
    return frames


def check_frames(
    system: System, schedule: Schedule | None, weak_contact: WeakContact | AlongDirection | None
) -> None:
    """Raise a ValueError for what bodies that turn do not know."""
    if system.frames is None:
        return
    if weak_contact is not None:
        raise ValueError(
            "with large_rotation=True there is the derivative of ClosedBranch() in reverse mode; "
            "leave out weak_contact"
        )
    if schedule is None:
        return
    parts = {
        "pressure": schedule.pressure,
        "obstacle": schedule.obstacle,
        "motion": schedule.motion,
        "gap": schedule.gap,
    }
    given = [name for name, part in parts.items() if part is not None and part != {}]
    if given:
        raise ValueError(
            f"Schedule({given[0]}=...) is of the reference configuration; with "
            "large_rotation=True a schedule takes traction and body_force"
        )
