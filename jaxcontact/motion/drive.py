"""What a schedule does to a step, and to the energy ledger.

Loads are amplitudes times shapes. An obstacle that has moved by d(t) leaves the gap

    psi_i(t) = psi_i + nu_i . d(t),

and so does a clamped set of another body that has moved by g(t), by its share in the row of a pair.
The wall does the work -lam . (psi' - psi)/tau, and lam . (psi - N y)/tau is lost in the impact.
Source: MATH.md 11.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.motion.nodal_fields import NodalFields
from jaxcontact.motion.schedule import Schedule
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.supports import (
    Flow,
    Moves,
    StepMoves,
    SupportShapes,
    moves_of,
    support_flow,
    support_load,
    support_shapes,
)
from jaxcontact.motion.trajectory import State
from jaxcontact.schemes import Scheme, StepState
from jaxcontact.system.assembly import nodal_areas
from jaxcontact.system.mortar import area_vectors
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.traced import poison_unless


class Shapes(NamedTuple):
    """What the amplitudes of a schedule multiply."""

    loads: Array
    """Loads of traction, pressure and body force, (J, n)."""

    supports: SupportShapes | None
    """Forces of the supports; None if none moves."""


class Drive(NamedTuple):
    """The amplitudes of a schedule."""

    loads: Array
    """Of the loads, (T, J)."""

    shift: Array | None
    """Change of the gap, (T+1, C) [m]; None is none."""

    moves: Moves | None
    """Of the supports, leaves (T+1, k); None if none moves."""


class StepDrive(NamedTuple):
    """What one step sees of a drive."""

    loads: Array
    """Amplitudes of the loads, (J,)."""

    shift: tuple[Array, Array] | None
    """Change of the gap before and after the step, (C,) each [m]."""

    moves: StepMoves | None
    """Of the supports."""


def drive_of(system: System, dt: Array, schedule: Schedule) -> tuple[Drive, Shapes]:
    """Return the amplitudes of a checked schedule, and their shapes."""
    loads, shapes = _loads(system, schedule)
    moves = supports = None
    if schedule.motion:
        moves = moves_of(jnp.concatenate(list(schedule.motion.values()), axis=1), dt)
        supports = support_shapes(system, [system.parts.clamped[name] for name in schedule.motion])
    return Drive(loads, gap_shift(system, schedule), moves), Shapes(shapes, supports)


def _loads(system: System, schedule: Schedule) -> tuple[Array, Array]:
    """Return the amplitudes of the loads (T, J) and their shapes (J, n)."""
    parts, d, dtype = system.parts, system.dimension, system.dtype
    amplitudes = [jnp.zeros((_steps(schedule), 0), dtype)]
    shapes = [jnp.zeros((0, system.size), dtype)]

    def add(amplitude: Array, forces: Array) -> None:
        amplitudes.append(amplitude)
        shapes.append(system.nodal_load(forces))

    def along_axes(weights: Array) -> Array:
        return weights[None, :, None] * jnp.eye(d, dtype=dtype)[:, None, :]  # (axis, N, i)

    for name, traction in schedule.traction.items():
        add(jnp.asarray(traction), along_axes(nodal_areas(system.points, parts.facets[name])))
    for name, pressure in schedule.pressure.items():
        facets = parts.facets[name]
        inward = -area_vectors(system.points, facets, parts.ends) / d
        forces = jnp.zeros_like(system.points).at[facets].add(inward[:, None, :])
        add(jnp.asarray(pressure)[:, None], forces[None])
    if schedule.body_force is not None:
        volumes = system.nodal_mass @ jnp.ones(system.n_nodes, dtype)
        add(jnp.asarray(schedule.body_force), along_axes(volumes))
    return jnp.concatenate(amplitudes, axis=1), jnp.concatenate(shapes)


def _steps(schedule: Schedule) -> int:
    """Return the number of steps of a checked schedule."""
    forces = jax.tree.leaves((schedule.traction, schedule.pressure, schedule.body_force))
    return len(forces[0]) if forces else len(jax.tree.leaves(schedule)[0]) - 1


@in_full_precision
@jax.jit
def gap_shift(system: System, schedule: Schedule) -> Array | None:
    """Return the change of the gaps at all levels, (T+1, C) [m]; None if nothing moves."""
    parts, shifts, is_known = system.parts, [], jnp.bool_(True)
    for name, translation in schedule.obstacle.items():
        members = parts.obstacles[name]
        is_known = is_known & jnp.all(members <= 1.0)
        shifts.append((translation @ system.directions.T) * members[None])
    for name, translation in schedule.motion.items():
        moved = parts.clamped[name]
        is_known = is_known & moved.is_alone
        shifts.append((translation @ system.directions.T) * moved.shares[None])
    if schedule.gap is not None:
        shifts.append(schedule.gap)
    return poison_unless(is_known, sum(shifts[1:], shifts[0])) if shifts else None


def shifted(system: System, shift: Array) -> System:
    """Return a system whose gaps have changed by a shift (C,) [m]."""
    own = jax.lax.stop_gradient(4.0 * jnp.finfo(shift.dtype).eps * jnp.abs(shift))
    return replace(system, gap=system.gap + shift, gap_rounding=system.gap_rounding + own)


def at_start(
    stepper: Stepper, schedule: Schedule, initial: State | None
) -> tuple[Stepper, State | None]:
    """Return the stepper with the gaps at time zero, and the state without nodes that are moved."""
    system = stepper.system
    # What is concrete stays so and can be checked.
    with jax.ensure_compile_time_eval():
        shift = gap_shift(system, schedule)
        first = system if shift is None else shifted(system, shift[0])
        if initial is not None:
            for name in schedule.motion:
                nodes = system.parts.clamped[name].nodes
                initial = jax.tree.map(
                    lambda x, nodes=nodes: jnp.asarray(x).at[nodes].set(0.0), initial
                )
    return replace(stepper, system=first), initial


def every_step(drive: Drive) -> StepDrive:
    """Return what each step sees, leaves (T, ...)."""
    old, new = (jax.tree.map(lambda x, s=s: x[s], drive[1:]) for s in (slice(-1), slice(1, None)))
    shift = None if drive.shift is None else (old[0], new[0])
    moves = None if drive.moves is None else StepMoves(old[1], new[1])
    return StepDrive(drive.loads, shift, moves)


def apply_drive(
    scheme: Scheme, system: System, dt: Array, shapes: Shapes, step: StepDrive
) -> tuple[System, Array]:
    """Return the system with the gaps at the end of a step, and the load (n,) [N] of the step."""
    load = step.loads @ shapes.loads
    if shapes.supports is not None and step.moves is not None:
        load = load + support_load(scheme, system, dt, shapes.supports, step.moves)
    return system if step.shift is None else shifted(system, step.shift[1]), load


def show_motion(
    system: System, schedule: Schedule, moves: Moves, fields: NodalFields
) -> NodalFields:
    """Return nodal fields (L, N, d) with those of the supports, moves (L, k)."""
    d = system.dimension
    shown = [fields.displacement, fields.velocity]
    for number, name in enumerate(schedule.motion):
        nodes, axes = system.parts.clamped[name].nodes, slice(number * d, number * d + d)
        for kind, values in enumerate(moves):
            shown[kind] = shown[kind].at[:, nodes].set(values[:, None, axes])
    return fields.shown(*shown)


def flow_of_drive(
    scheme: Scheme,
    system: System,
    dt: Array,
    shapes: Shapes,
    step: StepDrive,
    old: StepState,
    new: StepState,
) -> Flow:
    """Return what a schedule adds to the ledger of one step."""
    increment = new.displacement - old.displacement
    zero = jnp.zeros((), increment.dtype)
    flow = Flow(zero, jnp.dot(increment, step.loads @ shapes.loads), zero, zero, zero)
    if step.shift is not None:
        # Of lam . N (y' - y)/tau this is the work of the wall, the rest is lost.
        wall = -jnp.dot(new.impulse, step.shift[1] - step.shift[0]) / dt
        flow = flow._replace(work=flow.work + wall, impact=wall)
    if shapes.supports is None or step.moves is None:
        return flow
    more = support_flow(scheme, system, dt, shapes.supports, step.moves, old, new)
    return jax.tree.map(jnp.add, flow, more)
