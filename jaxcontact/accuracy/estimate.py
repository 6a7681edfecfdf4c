"""The error of a quantity by its parts: mesh, time step, reduced model, precision.

    space = 3/2 |Q(h) - Q(h/2)|,  time = 3/2 |Q(dt) - Q(dt/2)|,  reduction = |Q(m) - Q(enriched)|

each the root mean square over dt x {1, 0.94, 0.88}; 3/2 lies between the factors 2 and 4/3 of first
and second order. Differences to coarser neighbours would be cheaper, and wrong before the orders
show.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from jaxcontact.accuracy.probe import Build, Choice, Probes, Quantity
from jaxcontact.schemes import ContactImplicit, Scheme
from jaxcontact.transforms.options import check_option

#: Error over difference to the finer neighbour.
ORDER_FACTOR = 1.5


@dataclass(frozen=True)
class ErrorEstimate:
    """Estimated absolute errors of a quantity, in its unit."""

    value: float
    """The quantity, the mean over the three time steps."""

    space: float
    """Error of the mesh."""

    time: float
    """Error of the time step."""

    reduction: float
    """Error of the reduced model; zero of a full one."""

    precision: float
    """Error of float32; zero of float64, whose rounding is far below the others."""

    @property
    def total(self) -> float:
        """Sum of the parts."""
        return self.space + self.time + self.reduction + self.precision

    @property
    def dominant(self) -> str:
        """Name of the largest part: what to refine first."""
        return max(("space", "time", "reduction", "precision"), key=lambda x: getattr(self, x))


def estimate_error(
    build: Build,
    quantity: Quantity,
    *,
    h: float,
    dt: float,
    modes: int | None = None,
    scheme: Scheme | None = None,
    dtype: DTypeLike = jnp.float64,
) -> ErrorEstimate:
    """Estimate the error of a quantity by 9 runs of it, 12 with modes, each compiled anew.

    Args:
        build: makes the scene of a mesh size h [m].
        quantity: simulates with a stepper and returns a number, or a number and the trajectory.
            It is called with different time steps: simulate up to a time, with
            `steps=round(end / float(stepper.dt))`, and not a number of steps.
        h: mesh size, [m]; the finest mesh has h / 2.
        dt: time step, [s]; the shortest is dt / 2.
        modes: vibrations of a reduced model; None is the full one.
        scheme: time-stepping scheme, default `ContactImplicit()`.
        dtype: floating point type, float64 or float32.

    Returns:
        The parts of the error, at h, dt and modes.

    Raises:
        ValueError: if h or dt are not positive, or build or quantity return something else.
        SolveError: if a step was not solved.
    """
    scheme = ContactImplicit() if scheme is None else scheme
    check_option("scheme", scheme, Scheme, "ContactImplicit()")
    for name, size in (("h", h), ("dt", dt)):
        if not (np.ndim(size) == 0 and 0.0 < float(size) < np.inf):
            raise ValueError(f"{name} must be a positive number, got {size}")
    probes = Probes(build, quantity)
    return parts_of_error(probes, Choice(float(h), float(dt), scheme, jnp.dtype(dtype), modes))


def parts_of_error(probes: Probes, choice: Choice) -> ErrorEstimate:
    """Return the parts of the error of one choice."""
    h, dt, is_single = choice.h, choice.dt, choice.dtype == jnp.float32
    enriched, double = choice._replace(is_enriched=True), choice._replace(dtype=jnp.dtype(float))
    difference = probes.difference
    return ErrorEstimate(
        value=float(np.mean(probes.phases(choice))),
        space=ORDER_FACTOR * difference(choice, choice._replace(h=h / 2)),
        time=ORDER_FACTOR * difference(choice, choice._replace(dt=dt / 2)),
        reduction=0.0 if choice.modes is None else difference(choice, enriched),
        precision=difference(choice, double) if is_single else 0.0,
    )
