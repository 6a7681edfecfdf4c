"""What changes in time beside the control: loads on facet sets, obstacles and supports that move.

Everything is an amplitude in time times a fixed shape in space, and is kept so: T steps with J
shapes of n unknowns are (T, J) and (J, n) numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.motion.stepper import Stepper
from jaxcontact.system.system import System
from jaxcontact.transforms.traced import is_traced


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Schedule:
    """Loads and motions over T steps; loads add to those of the scene and to the control.

    Forces are constant in a step, as the control is: entry k acts from time k tau to (k + 1) tau.
    Motions are values at the time levels k tau, k = 0, ..., T. `sample` makes both of functions.

    Derivative: by every array.
    """

    traction: Mapping[str, Array | np.ndarray] = field(default_factory=dict)
    """Force per area on facet sets, each (T, d) [N/m^(d-1)]."""

    pressure: Mapping[str, Array | np.ndarray] = field(default_factory=dict)
    """Pressure on facet sets, each (T,) [N/m^(d-1)]; positive pushes against the outward normal."""

    body_force: Array | np.ndarray | None = None
    """Volume force, (T, d) [N/m^d]; None is none."""

    obstacle: Mapping[str, Array | np.ndarray] = field(default_factory=dict)
    """Translation of the rigid obstacle of contact sets against the scene, each (T+1, d) [m]. It
    changes the gap by nu . d with the contact normals nu of the scene."""

    motion: Mapping[str, Array | np.ndarray] = field(default_factory=dict)
    """Displacement of clamped facet sets, each moved as a whole, (T+1, d) [m]."""

    gap: Array | np.ndarray | None = None
    """Change of the gap of every contact pair, (T+1, C) [m], as `turned_gap` makes it for obstacles
    that turn; adds to that of `obstacle` and `motion`. None is none."""


#: Fields that hold values at time levels, T+1 of them, and not in steps.
LEVELS = ("obstacle", "motion", "gap")


def check_schedule(system: System, schedule: Schedule) -> tuple[Schedule, int]:
    """Return the schedule in the precision of a system, and its number of steps T.

    Raises:
        ValueError: if a name is unknown, a shape or the number of steps does not fit, a value is
            not finite, or something cannot move by itself.
    """
    if not isinstance(schedule, Schedule):
        raise ValueError(f"schedule must be a jc.Schedule(...), got {schedule!r}")
    d, n_pairs, parts = system.dimension, system.normals.count, system.parts
    known = {
        "traction": (parts.facets, "a facet set of the mesh", (d,)),
        "pressure": (parts.facets, "a facet set of the mesh", ()),
        "body_force": (None, "", (d,)),
        "obstacle": (parts.obstacles, "a contact set with a rigid obstacle", (d,)),
        "motion": (parts.clamped, "a clamped set", (d,)),
        "gap": (None, "", (n_pairs,)),
    }
    steps: dict[str, int] = {}
    for part in fields(Schedule):
        names, what, shape = known[part.name]
        value = getattr(schedule, part.name)
        if names is None:
            entries = {} if value is None else {part.name: value}
        elif isinstance(value, Mapping):
            if unknown := sorted(set(value) - set(names)):
                raise ValueError(
                    f"Schedule.{part.name} names {unknown[0]!r}, which is not {what} of the scene; "
                    f"there are {sorted(names)}"
                )
            entries = {f"{part.name}[{name!r}]": entry for name, entry in value.items()}
        else:
            raise ValueError(f"Schedule.{part.name} must be a mapping {{name: array}}")
        more = int(part.name in LEVELS)
        for name, entry in entries.items():
            _check_entry(f"Schedule.{name}", entry, shape, "T+1" if more else "T")
            steps[name] = np.shape(entry)[0] - more
    if len(set(steps.values())) != 1 or min(steps.values()) < 1:
        raise ValueError(
            f"the entries of a Schedule must be for one number of steps T, got {steps}; forces "
            "have T rows, one a step, and motions T+1, one a time level"
        )
    moves = schedule.obstacle or schedule.motion or schedule.gap is not None
    if system.open_pairs is not None and moves:
        raise ValueError(
            "pairs that are taken to stay open, by with_pairs or reduce(pairs=), do not follow "
            "obstacles and supports that move; keep all pairs"
        )
    _check_movable(system, schedule)
    return jax.tree.map(lambda x: jnp.asarray(x, system.dtype), schedule), min(steps.values())


def sample(
    function: Callable[[float], ArrayLike], stepper: Stepper, steps: int, *, levels: bool = False
) -> Array:
    """Return the values of a function of time as a control or a `Schedule` takes them.

    Args:
        function: maps a time, scalar [s], to an array of any shape, for instance a traction (d,),
            or a force density (N, d) on `stepper.system.points`.
        stepper: from `prepare`; gives the step length.
        steps: number of steps T.
        levels: at the time levels, for what moves: T+1 values. Else in the middle of each step, for
            what is constant in a step: T values, whose error is of second order.

    Returns:
        The values, (T, ...) or (T+1, ...).

    Derivative: by what the function depends on, if it is written with jax.numpy; any other function
    of a float is evaluated time by time.

    Example:
        >>> stepper = jc.prepare(jc.discretize(jc.scenes.bar_on_wall()), 0.5)
        >>> jc.sample(lambda t: 2.0 * t, stepper, 3)
        Array([0.5, 1.5, 2.5], dtype=float64)
    """
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ValueError(f"steps must be a positive whole number, got {steps!r}")
    dtype = stepper.system.dtype
    places = jnp.arange(steps + 1, dtype=dtype) if levels else jnp.arange(steps, dtype=dtype) + 0.5
    times = stepper.dt * places
    try:
        return jnp.asarray(jax.vmap(lambda t: jnp.asarray(function(t), dtype))(times))
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError):
        if is_traced(times):
            raise
    return jnp.stack([jnp.asarray(function(float(t)), dtype) for t in np.asarray(times)])


def _check_entry(name: str, entry: ArrayLike, shape: tuple[int, ...], first: str) -> None:
    if np.ndim(entry) != 1 + len(shape) or np.shape(entry)[1:] != shape:
        expected = ", ".join([first, *map(str, shape)]) + ("" if shape else ",")
        raise ValueError(f"{name} must have shape ({expected}), got {np.shape(entry)}")
    if not is_traced(entry) and not np.all(np.isfinite(np.asarray(entry))):
        raise ValueError(f"{name} holds values that are not finite")


def _check_movable(system: System, schedule: Schedule) -> None:
    """Check that what moves does so by itself, where the scene is concrete."""
    for name in schedule.motion:
        is_alone = system.parts.clamped[name].is_alone
        if not is_traced(is_alone) and not is_alone:
            raise ValueError(
                f"clamped set {name!r} shares nodes with another clamped set, so that they cannot "
                "both hold; leave a row of facets between the sets"
            )
    for name in schedule.obstacle:
        members = system.parts.obstacles[name]
        if not is_traced(members) and np.any(np.asarray(members) > 1.0):
            raise ValueError(
                f"some nodes of contact set {name!r} meet the obstacle of another contact set in "
                "the same way, and it is not known with which they move; give the sets no nodes in "
                "common, or make them one set"
            )
