"""Scenes for `recommend`: a bar and a block that fall on a floor, a half disc pressed on one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import jaxcontact as jc
from common import half_disc_runs

BAR = jc.reference.FallingBar()
TOLERANCES = (0.1, 0.03, 0.01)


class Case(NamedTuple):
    """A scene with the coarsest mesh and step of its grid."""

    build: Callable[[float], jc.Scene]
    end: float
    """Time of the motion, [s]."""
    speed: float
    """Of the throw, against the last axis, [m/s]."""
    h: float
    dt: float
    levels: int
    """Number of meshes, each of half the size."""
    dt_levels: int
    tolerances: tuple[float, ...]
    exact: float | None = None
    """The exact mean, if it is known."""


def bar(h: float) -> jc.Scene:
    """Return a bar that falls on a floor."""
    return jc.Scene(
        mesh=jc.meshes.interval(BAR.length, h=h),
        material=jc.KelvinVoigt(young=BAR.young, poisson=0.0),
        contact={"left": jc.HalfSpace(point=np.array([-BAR.gap]), normal=np.array([1.0]))},
        body_force=np.array([-BAR.gravity]),
    )


def block(h: float) -> jc.Scene:
    """Return a rubber block above a floor."""
    floor = jc.HalfSpace(point=np.array([0.0, -0.05]), normal=np.array([0.0, 1.0]))
    return jc.Scene(
        mesh=jc.meshes.rectangle((1.0, 0.5), h=h),
        material=jc.KelvinVoigt(
            young=1e6, poisson=0.3, bulk_viscosity=100.0, shear_viscosity=100.0, density=1000.0
        ),
        contact={"bottom": floor},
        body_force=np.array([0.0, -9810.0]),
    )


def half_disc(h: float) -> jc.Scene:
    """Return the half disc under a body force."""
    scene = jc.scenes.half_disc(h=h, gap=half_disc_runs.GAP)
    return dataclasses.replace(scene, body_force=np.array([0.0, half_disc_runs.PUSH]))


def exact_bar(end: float) -> float:
    """Return the mean of the exact displacement of the bar over length and time."""
    x, t = np.linspace(0.0, BAR.length, 401), np.linspace(0.0, end, 2001)
    y = np.asarray(BAR.displacement(x[None, :], t[:, None]))
    return float(np.trapezoid(np.trapezoid(y, x, axis=1), t) / (BAR.length * end))


CASES = {
    "bar": Case(bar, 2.0, 0.0, BAR.length / 4, 0.05, 6, 6, TOLERANCES, exact_bar(2.0)),
    "block": Case(block, 0.08, 2.0, 0.25, 6e-3, 5, 6, TOLERANCES),
    "half disc": Case(half_disc, half_disc_runs.DURATION, 0.0, 7.5, 4.4e-4, 5, 6, TOLERANCES),
}
