"""Chatter: a contact force that alternates from step to step, by the scheme and not by the body.

`ContactImplicit` has no contact force at a time, only an impulse of a step, and in lasting contact
consecutive impulses may be far apart around a mean that is right. Source: MATH.md 2.
"""

from __future__ import annotations

import warnings

import numpy as np

from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.transforms.traced import is_traced

#: So many changes in a row have to alternate, each at least this part of the largest force.
CHANGES, SIZE = 5, 0.1

ADVICE = (
    "the contact force alternates from step to step, by up to {size:.0%} of its largest value: "
    "this is chatter of the scheme; scheme=jc.ContactStabilized() has none, and a mean over some "
    "steps has little"
)


class ChatterWarning(UserWarning):
    """A contact force was read that alternates from step to step."""


def chatter(trajectory: Trajectory) -> float:
    """Return the largest change of a contact force that alternates, relative to the largest force.

    Zero if no force alternates over five changes in a row, or the trajectory is traced.

    Args:
        trajectory: T steps, of one motion.
    """
    if is_traced(trajectory.contact_impulse) or trajectory.contact_impulse.ndim != 2:
        return 0.0
    force = np.asarray(trajectory.contact_impulse)
    change = np.diff(force, axis=0)
    largest = np.max(np.abs(force), axis=0, initial=0.0)
    # Each change against the one before it: the smaller of both where they have other signs.
    pairs = np.minimum(np.abs(change[1:]), np.abs(change[:-1]))
    is_turn = (change[1:] * change[:-1] < 0.0) & (pairs >= SIZE * largest)
    if len(pairs) < CHANGES - 1:
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(np.asarray(is_turn), CHANGES - 1, axis=0)
    run = np.all(windows, axis=-1)
    if not np.any(run):
        return 0.0
    steps = np.arange(len(pairs) - CHANGES + 2)[:, None] + np.arange(CHANGES - 1)
    worst = pairs[steps].max(axis=1)  # (W, C)
    return float(np.max(np.where(run, worst / np.where(largest, largest, 1.0), 0.0)))


def warn_of_chatter(trajectory: Trajectory, stacklevel: int = 3) -> None:
    """Warn whoever called the caller if a contact force chatters."""
    size = chatter(trajectory)
    if size > 0.0:
        warnings.warn(ADVICE.format(size=size), ChatterWarning, stacklevel=stacklevel)
