"""Runs of one quantity on other meshes, time steps, precisions and reduced models."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxcontact.motion.stepper import Stepper, prepare
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.scene.scene import Scene
from jaxcontact.schemes import ContactImplicit, Scheme
from jaxcontact.system.discretize import discretize
from jaxcontact.system.reduction import enrich, reduce
from jaxcontact.system.system import System

#: Factors of the time step of the runs that stand for one: a single run is a lottery with the
#: phase of the impact in its step.
PHASES = (1.0, 0.94, 0.88)

#: Makes the scene of a mesh size.
Build = Callable[[float], Scene]

#: Simulates with a stepper and returns a number, or a number and the trajectory behind it.
Quantity = Callable[[Stepper], Array | float | tuple[Array | float, Trajectory]]


class Choice(NamedTuple):
    """What a simulation is made with."""

    h: float
    """Mesh size, [m]."""

    dt: float
    """Time step, [s]."""

    scheme: Scheme = ContactImplicit()
    """Time-stepping scheme."""

    dtype: DTypeLike = jnp.float64
    """Floating point type."""

    modes: int | None = None
    """Vibrations of a reduced model; None is the full one."""

    is_enriched: bool = False
    """Whether it is the enriched model of a reduced one, see `reduction_error`."""


def number_of(found: Array | float | tuple[Array | float, Trajectory]) -> float:
    """Return the number of what a quantity returned.

    Raises:
        ValueError: if it is none.
    """
    number = found[0] if isinstance(found, tuple) else found
    if np.shape(number) != ():
        raise ValueError(
            "the quantity must be a number, or (number, trajectory), got an array of shape "
            f"{np.shape(number)}"
        )
    return float(number)


@dataclass
class Probes:
    """The runs so far: no choice is run twice."""

    build: Build
    """Makes the scene of a mesh size."""

    quantity: Quantity
    """What is measured."""

    systems: dict[tuple, System] = field(default_factory=dict)
    """The system of each mesh size, type and model."""

    values: dict[Choice, float] = field(default_factory=dict)
    """The quantity of each choice."""

    trajectories: dict[Choice, Trajectory] = field(default_factory=dict)
    """The trajectory of each choice, if the quantity returns it."""

    seconds: float = 0.0
    """Time of all runs, compilation included, [s]."""

    def run(self, choice: Choice) -> float:
        """Return the quantity of one choice, and keep its trajectory."""
        if choice not in self.values:
            begin = time.perf_counter()
            found = self.quantity(self.stepper(choice))
            if isinstance(found, tuple):
                self.trajectories[choice] = found[1]
            self.values[choice] = number_of(found)
            self.seconds += time.perf_counter() - begin
        return self.values[choice]

    def phases(self, choice: Choice) -> np.ndarray:
        """Return the quantity at the time steps of `PHASES`."""
        return np.array([self.run(choice._replace(dt=choice.dt * x)) for x in PHASES])

    def difference(self, first: Choice, second: Choice) -> float:
        """Return the root mean square over the phases of the difference of two choices."""
        return float(np.sqrt(np.mean((self.phases(first) - self.phases(second)) ** 2)))

    def stepper(self, choice: Choice) -> Stepper:
        """Return the stepper of a choice."""
        return prepare(self.system(choice), choice.dt, scheme=choice.scheme)

    def system(self, choice: Choice) -> System:
        """Return the full, reduced or enriched system of a choice."""
        key = (choice.h, choice.dtype, choice.modes, choice.is_enriched and choice.dt)
        if key not in self.systems:
            self.systems[key] = self._make_system(choice)
        return self.systems[key]

    def _make_system(self, choice: Choice) -> System:
        if choice.modes is None:
            scene = self.build(choice.h)
            if not isinstance(scene, Scene):
                raise ValueError(f"build(h) must return a Scene, got {type(scene).__name__}")
            return discretize(scene, dtype=choice.dtype)
        full = self.system(choice._replace(modes=None, is_enriched=False))
        if choice.is_enriched:
            return enrich(full, self.system(choice._replace(is_enriched=False)), choice.dt)
        return reduce(full, min(choice.modes, full.size - 1))
