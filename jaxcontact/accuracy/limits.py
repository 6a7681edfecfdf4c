"""Where the model ends: what a motion did that small strains and a linearised gap exclude."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxcontact.motion.linearization import linearization_error
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.scene.scene import Scene

#: Strain or rotation beyond which the linear theory is off by per cent.
LARGEST_STRAIN = 0.1
#: Fewest steps and cells of a contact that is resolved.
FEWEST_STEPS, FEWEST_CELLS = 10, 2
#: Time levels at which strains and gaps are looked at.
N_LEVELS = 50


def limits(
    scene: Scene, stepper: Stepper, trajectory: Trajectory, h: float, tolerance: float
) -> tuple[str, ...]:
    """Return what a motion did that the model does not hold for, one sentence each.

    Args:
        scene: the scene.
        stepper: the stepper of the motion.
        trajectory: the motion.
        h: mesh size, [m].
        tolerance: relative error that matters.
    """
    seen = _thinned(trajectory)
    found = [
        _strain(scene, stepper, seen),
        _linearised_gap(scene, seen, tolerance),
        _contact_width(stepper, trajectory, h),
        _contact_steps(trajectory),
    ]
    return tuple(sentence for sentence in found if sentence)


def _thinned(trajectory: Trajectory) -> Trajectory:
    """Return the motion at about `N_LEVELS` of its time levels."""
    stride = max(len(trajectory.unknowns) // N_LEVELS, 1)
    levels = (trajectory.gap, trajectory.nodal, trajectory.frames)
    gap, nodal, frames = jax.tree.map(lambda x: x[::stride], levels)
    return replace(trajectory, gap=gap, nodal=nodal, frames=frames)


def _strain(scene: Scene, stepper: Stepper, trajectory: Trajectory) -> str:
    cells, points = np.asarray(scene.mesh.cells), np.asarray(scene.mesh.points)
    y = trajectory.displacement
    if trajectory.frames is not None:
        y = stepper.system.lift(trajectory.frames.deformation)
    y = np.asarray(y)
    edges = points[cells[:, 1:]] - points[cells[:, :1]]  # (E, d, d)
    stretch = y[:, cells[:, 1:]] - y[:, cells[:, :1]]  # (K, E, d, d)
    # grad y of (edge, component): edges @ grad = stretch.
    gradient = np.linalg.solve(edges[None], stretch)
    size = np.max(np.abs(gradient), axis=(0, 2, 3))
    worst = int(np.argmax(size))
    if size[worst] <= LARGEST_STRAIN:
        return ""
    place = points[cells[worst]].mean(axis=0)
    return (
        f"strain or rotation reaches {size[worst]:.2g} at {np.round(place, 3).tolist()}: the "
        f"theory is one of small strains and rotations, up to about {LARGEST_STRAIN}"
    )


def _linearised_gap(scene: Scene, trajectory: Trajectory, tolerance: float) -> str:
    """Compare the error of the linearised gap, where it can matter, with the tolerance."""
    if trajectory.frames is not None:
        return ""
    if trajectory.schedule is not None and trajectory.schedule.gap is not None:
        return ""
    errors = linearization_error(scene, trajectory)
    # A pair that stays further away than its error would not have touched.
    error = np.max(errors[errors > np.min(trajectory.gap, axis=0)], initial=0.0)
    size = tolerance * float(jnp.max(jnp.abs(trajectory.displacement)))
    if error <= size:
        return ""
    return (
        f"the gap is linearised where the body starts, and misses up to {error:.2g} m, more than "
        f"the {size:.2g} m that are asked for"
    )


def _contact_width(stepper: Stepper, trajectory: Trajectory, h: float) -> str:
    system = stepper.system
    if system.dimension == 1 or not bool(jnp.any(trajectory.active)):
        return ""
    area = float(jnp.max(trajectory.active @ system.contact_area))
    width = area if system.dimension == 2 else float(np.sqrt(area))
    if width >= FEWEST_CELLS * h:
        return ""
    return (
        f"the contact is at most {width:.2g} m wide, less than {FEWEST_CELLS} cells of {h:.2g} m: "
        "its force is not resolved"
    )


def _contact_steps(trajectory: Trajectory) -> str:
    is_closed = np.asarray(jnp.any(trajectory.active, axis=1))
    edges = np.flatnonzero(np.diff(np.r_[False, is_closed, False].astype(int)))
    if not edges.size:
        return ""
    longest = int(np.max(edges[1::2] - edges[::2]))
    if longest >= FEWEST_STEPS:
        return ""
    return (
        f"the longest contact lasts {longest} steps, fewer than {FEWEST_STEPS}: its force is not "
        "resolved in time"
    )
