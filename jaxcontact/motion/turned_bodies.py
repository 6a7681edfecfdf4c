"""A warning where a body has turned farther than small displacements allow.

Linear strain takes a rotation by an angle a for a stretch by 1 / cos a - 1. Source: MATH.md 12.
"""

from __future__ import annotations

import warnings

import jax
import numpy as np
from jax import Array

from jaxcontact.system.bodies import body_numbers
from jaxcontact.system.lift import Lift
from jaxcontact.system.system import System
from jaxcontact.transforms.traced import is_traced

#: Degrees up to which nothing is said: at 5 degrees a body is stretched by 0.4 %.
LARGEST_ANGLE = 5.0

#: Levels of a motion that are looked at.
N_LEVELS = 16


def warn_of_rotation(system: System, unknowns: Array, stride: int) -> None:
    """Warn once if a body without clamped nodes turns too far in a concrete motion (L, n).

    Args:
        system: the system.
        unknowns: the recorded states, (L, n).
        stride: steps between two of them.
    """
    if system.dimension == 1 or system.frames is not None or is_traced((system, unknowns)):
        return
    levels = np.unique(np.linspace(0, len(unknowns) - 1, N_LEVELS).astype(int))
    y, points = np.asarray(_seen(system.lifting, unknowns, levels)), np.asarray(system.points)
    # Most motions are too small to turn anything, and need no search for bodies.
    if np.max(np.ptp(y, axis=1)) < np.radians(LARGEST_ANGLE) * np.min(np.ptp(points, axis=0)):
        return
    numbers = body_numbers(system)
    is_free = np.zeros(system.n_nodes, bool)
    is_free[np.asarray(system.free_nodes)] = True
    for number in np.setdiff1d(numbers, numbers[~is_free]):
        angles = _angles(points[numbers == number], y[:, numbers == number])
        far = np.flatnonzero(angles > LARGEST_ANGLE)
        if far.size:
            warnings.warn(
                f"body {number} has turned by {angles[far[0]]:.0f} degrees at step "
                f"{levels[far[0]] * stride}, which small displacements take for strain; let "
                "bodies turn by Scene(..., large_rotation=True)",
                stacklevel=3,
            )
            return


@jax.jit
def _seen(lift: Lift, unknowns: Array, levels: Array) -> Array:
    """Return the nodal displacement at some levels; one program, since every motion needs it."""
    return lift(unknowns[levels])


def _angles(points: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Return the angles (L,) in degrees by which nodes (K, d) have turned with y (L, K, d)."""
    X, x = points - points.mean(axis=0), points + displacement
    moments = np.einsum("lki,kj->lij", x - x.mean(axis=1, keepdims=True), X)
    left, _, right = np.linalg.svd(moments)
    rotation = left @ right
    cosine = (np.trace(rotation, axis1=1, axis2=2) - (X.shape[1] - 2)) / 2.0
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
