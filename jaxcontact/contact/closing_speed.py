"""How fast bodies in free flight close their gaps: the speed of an impact.

The loads of a body over its mass are its acceleration a; from the normal velocity N v and the gap
psi - N y at the start,

    speed^2 = max(N v, 0)^2 + 2 max(N a, 0) (psi - N y).
"""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.contact.vi import ContactProblem
from jaxcontact.system.bodies import free_flight_acceleration
from jaxcontact.system.system import System
from jaxcontact.transforms.traced import is_traced, poison_unless


class PreparedScene(Protocol):
    """What a law needs to know of a scene: a `Stepper` has it."""

    @property
    def system(self) -> System:
        """The matrices of the scene."""
        ...

    @property
    def dt(self) -> Array:
        """Length of a time step, scalar [s]."""
        ...

    @property
    def contact_problem(self) -> ContactProblem:
        """The contact problem whose solution is the contact at the end of a step."""
        ...


class StartingState(Protocol):
    """What a motion starts from: a `State`."""

    @property
    def displacement(self) -> Array | None:
        """Nodal displacement, (N, d) [m]; None is zero."""
        ...

    @property
    def velocity(self) -> Array | None:
        """Nodal velocity, (N, d) [m/s]; None is zero."""
        ...


def closing_speed(
    stepper: PreparedScene, initial: StartingState | None, speed: float | Array | None
) -> Array:
    """Return the closing speed of the first touch, scalar [m/s], by hand or of the free flight.

    Without initial state a closed gap is taken for a drop from as high as the scene is large.

    Raises:
        ValueError: if a concrete speed is not positive and finite, nothing flies at an obstacle, or
            it would have to be found from a mesh that is traced.
    """
    system = stepper.system
    if speed is None and is_traced(system.nodal_mass.columns):
        raise ValueError("the mesh is traced; give speed=, or find it outside of jax.jit")
    if speed is None:
        speed = _free_flight(system, initial)
        advice = (
            "no body without clamps flies at an obstacle; give speed=, the closing speed at touch "
            "in m/s, for instance trajectory.closing_speed of a run with exact contact"
        )
    else:
        advice = f"speed must be positive and finite, the closing speed in m/s, got {speed}"
    if not is_traced(speed) and not (np.shape(speed) == () and 0.0 < float(speed) < np.inf):
        raise ValueError(advice)
    speed = jnp.asarray(speed, system.dtype)
    return jax.lax.stop_gradient(poison_unless((speed > 0.0) & (speed < jnp.inf), speed))


def _free_flight(system: System, initial: StartingState | None) -> Array:
    towards = jnp.maximum(system.normals @ free_flight_acceleration(system), 0.0)
    if initial is None:
        extent = jnp.max(jnp.max(system.points, axis=0) - jnp.min(system.points, axis=0))
        gap = jnp.where(system.gap > 4.0 * system.gap_rounding, system.gap, extent)
        return jnp.sqrt(jnp.max(2.0 * towards * gap, initial=0.0))

    def along_normals(field: Array | None) -> Array:
        field = jnp.zeros_like(system.points) if field is None else jnp.asarray(field)
        return system.normals @ system.restrict(field)

    gap = system.gap - along_normals(initial.displacement)
    velocity = along_normals(initial.velocity)
    squares = jnp.maximum(velocity, 0.0) ** 2 + 2.0 * towards * jnp.maximum(gap, 0.0)
    return jnp.sqrt(jnp.max(squares, initial=0.0))
