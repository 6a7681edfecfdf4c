"""The error of a reduced model, by the difference to an enriched one that contains it.

The enriched space has twice as many vibrations and the step responses D^-1 N^T. One run of it costs
about twice the reduced one; the residual of the reduced motion weighted by an adjoint costs more,
and was no better where contact sets change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax.numpy as jnp
from jax import Array

from jaxcontact.control.inner_product import nodal_norms
from jaxcontact.motion.stepper import Stepper, prepare
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.system.reduction import enrich
from jaxcontact.system.system import System

Model = TypeVar("Model", Stepper, System)


@dataclass(frozen=True)
class ReductionError:
    """Estimated errors of a reduced model against the full one, at the same time step."""

    displacement: float | None
    """Largest L2 norm of the error of the displacement over the largest one of the displacement;
    None if the run returned a number."""

    impulse: float | None
    """Largest error of the accumulated impulse of all pairs over the impulse of the whole run; zero
    if nothing touches."""

    quantity: float | None
    """Absolute error of the number that the run returned; None if it returned a trajectory."""

    enriched: System
    """The enriched model that was compared with."""


def reduction_error(
    system: System, reduced: Model, run: Callable[[Model], Trajectory | Array | float]
) -> ReductionError:
    """Estimate the error of a reduced model; runs it and an enriched model once each.

    Args:
        system: the full system that was reduced.
        reduced: the stepper of the reduced system; or the reduced system itself.
        run: maps a stepper to a trajectory, or to a number that is taken from one; with a system
            as `reduced` it gets systems, and prepares them itself.

    Returns:
        The estimate; within a factor of two of the error where that is not rounding or chatter.

    Raises:
        ValueError: if the system is not the one that was reduced.
        SolveError: if a step was not solved.
    """
    stepper = reduced if isinstance(reduced, Stepper) else None
    model = reduced.system if isinstance(reduced, Stepper) else reduced
    first = run(reduced)
    dt = first.dt if isinstance(first, Trajectory) else stepper and stepper.dt
    enriched = enrich(system, model, None if dt is None else float(dt))
    other: Any = enriched if stepper is None else prepared_as(stepper, enriched)
    second = run(other)
    if isinstance(first, Trajectory) and isinstance(second, Trajectory):
        y = second.displacement
        missed, size = (
            float(jnp.sqrt(jnp.max(nodal_norms(system.nodal_mass, field))))
            for field in (first.displacement - y, y)
        )
        lost = _impulse(first) - _impulse(second)
        whole = float(_impulse(second)[-1])
        impulse = float(jnp.max(jnp.abs(lost))) / whole if whole else 0.0
        return ReductionError(missed / size if size else 0.0, impulse, None, enriched)
    numbers = [float(jnp.asarray(found)) for found in (first, second)]
    return ReductionError(None, None, abs(numbers[0] - numbers[1]), enriched)


def prepared_as(stepper: Stepper, system: System) -> Stepper:
    """Return the stepper of another system with the time step and the choices of one."""
    return prepare(system, stepper.dt, scheme=stepper.scheme, contact_solver=stepper.contact_solver)


def _impulse(trajectory: Trajectory) -> Array:
    """Return the impulse of all pairs up to each time level, (T,) [N s]."""
    return jnp.cumsum(jnp.sum(trajectory.contact_impulse, axis=1))
