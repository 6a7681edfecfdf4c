"""The Hadamard directional derivative of the motion, exact at weak contact too.

The recursion of the motion with homogeneous data, and in every step the variational inequality on
the critical cone: with strong contact S and weak contact W

    (N dy')_i = 0 on S,    0 <= dlam_i  _|_  -(N dy')_i >= 0 on W,    dlam_i = 0 elsewhere.

It is the limit of [y(u + t du) - y(u)]/t as t falls to zero, positively homogeneous, and linear in
the direction if and only if no step has weak contact. Source: paper, Theorem 4.20; MATH.md 3.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import CriticalCone
from jaxcontact.motion.checks import raise_if_failed
from jaxcontact.motion.schedule import Schedule
from jaxcontact.motion.simulate import simulate
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import State, Trajectory
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.tangents import tangent_of


@in_full_precision
def directional_derivative(
    stepper: Stepper,
    control: Array | None,
    direction: Array | None = None,
    *,
    steps: int | None = None,
    initial: State | None = None,
    initial_direction: State | None = None,
    stepper_direction: Stepper | None = None,
    schedule: Schedule | None = None,
    schedule_direction: Schedule | None = None,
) -> Trajectory:
    """Return the one-sided derivative of the motion along a direction.

    The same as `jax.jvp` of `simulate(..., weak_contact=CriticalCone())`.

    Args:
        stepper: from `prepare`.
        control: force density u, (T, N, d) [N/m^d], or None.
        direction: du, (T, N, d) [N/m^d]; None is zero.
        steps: number of steps T if there is no control.
        initial: state at time zero; default at rest without displacement.
        initial_direction: direction of the initial state; None is zero.
        stepper_direction: direction of the stepper, as `jax.jvp` of a function that ends in
            `prepare` returns it; None is zero.
        schedule: what changes in time beside the control.
        schedule_direction: direction of the schedule, with arrays in the same places; None is zero.

    Returns:
        A trajectory that holds the derivatives of time, displacement, velocity, gap and
        contact_impulse; active, weak, iterations and status are those of the motion.

    Raises:
        ValueError: if shapes do not fit.
        SolveError: if a step of the motion was not solved.
    """
    if direction is not None and (control is None or np.shape(direction) != np.shape(control)):
        shape = None if control is None else np.shape(control)
        raise ValueError(
            f"direction must have the shape of the control, {shape}, got {np.shape(direction)}; "
            "without a control, give a control of zeros"
        )
    rest = jnp.zeros_like(stepper.system.points)
    initial_direction = None if initial_direction is None else initial_direction.filled(rest)
    initial = None if initial is None else initial.filled(rest)
    if initial is None and initial_direction is not None:
        initial = jax.tree.map(lambda x: jnp.zeros_like(jnp.asarray(x)), initial_direction)
    if schedule_direction is not None and (
        jax.tree.map(np.shape, schedule_direction) != jax.tree.map(np.shape, schedule)
    ):
        raise ValueError("schedule_direction must have arrays of the shapes of the schedule")
    primals = jax.tree.map(jnp.asarray, (stepper, control, initial, schedule))
    if stepper_direction is None:
        stepper_direction = tangent_of(primals[0], None)
    tangents = (
        stepper_direction,
        tangent_of(primals[1], direction),
        tangent_of(primals[2], initial_direction),
        tangent_of(primals[3], schedule_direction),
    )
    options = {"steps": steps, "weak_contact": CriticalCone()}

    def motion(
        stepper: Stepper, control: Array | None, initial: State | None, schedule: Schedule | None
    ) -> Trajectory:
        return simulate(stepper, control, initial=initial, schedule=schedule, **options)

    trajectory, tangent = jax.jvp(motion, primals, tangents)
    if not isinstance(trajectory.status, Tracer):
        raise_if_failed(trajectory)
    contact = replace(
        tangent.contact, active=trajectory.contact.active, weak=trajectory.contact.weak
    )
    return replace(
        tangent,
        contact=contact,
        iterations=trajectory.iterations,
        status=trajectory.status,
    )
