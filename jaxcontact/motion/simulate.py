"""The time loop: one step of the scheme after the other, scanned."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import AlongDirection, ClosedBranch, CriticalCone, WeakContact
from jaxcontact.motion.checks import check_initial, check_steps, raise_if_failed, refuse_closed
from jaxcontact.motion.contact_record import ContactRecord, record_of, worst_of
from jaxcontact.motion.drive import (
    StepDrive,
    apply_drive,
    at_start,
    drive_of,
    every_step,
    shifted,
    show_motion,
)
from jaxcontact.motion.frame_motion import FrameMotion, check_frames, frame_motion
from jaxcontact.motion.initial import first_displacement
from jaxcontact.motion.memory import check_run_memory
from jaxcontact.motion.nodal_fields import NodalFields
from jaxcontact.motion.progress import Progress
from jaxcontact.motion.schedule import Schedule, check_schedule
from jaxcontact.motion.stepper import Stepper, StepPerturbation
from jaxcontact.motion.supports import Moves
from jaxcontact.motion.trajectory import State, Trajectory
from jaxcontact.motion.turned_bodies import warn_of_rotation
from jaxcontact.schemes import StepState
from jaxcontact.schemes.interface import first_state
from jaxcontact.schemes.turning import make_step
from jaxcontact.system.control_space import control_loads
from jaxcontact.system.placing import gap_and_rows
from jaxcontact.transforms.options import check_kind, check_option
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.tangents import tangent_of
from jaxcontact.transforms.time_loop import Checkpoint, scan_steps
from jaxcontact.transforms.traced import is_traced


def simulate(
    stepper: Stepper,
    control: Array | None = None,
    *,
    steps: int | None = None,
    initial: State | None = None,
    save_every: int = 1,
    checkpoint: Checkpoint | None = None,
    weak_contact: WeakContact | AlongDirection | None = None,
    schedule: Schedule | None = None,
    progress: Progress | None = None,
) -> Trajectory:
    """Simulate the motion of the body.

    Pure: can be put under jit, grad, vmap (over control, initial state and the values of the
    stepper) with the stepper as an argument. A new control of the same shape compiles nothing.

    Args:
        stepper: from `prepare`.
        control: force density u, (T, N, d) [N/m^d], constant in a step and P1 in space; or in
            the unknowns of the system, (T, n), see `System.restrict_control`; or None.
        steps: number of steps T; default the length of the control or of the schedule.
        initial: state at time zero; default at rest without displacement. Where a schedule moves
            clamped nodes, they follow the schedule from the start.
        save_every: number of steps k between recorded states, a divisor of T: displacement,
            velocity, gap and time then have T/k + 1 levels; contact records keep all T steps.
        checkpoint: `Checkpoint(segments)` lets the backward pass recompute the steps of a segment
            instead of storing them; same gradient to rounding, about one more forward run.
        weak_contact: what the derivative means where gap and impulse of a pair are both zero:
            `ClosedBranch()` (default, Algorithm 1), `OpenBranch()`, `AlongDirection(control)`, or
            `CriticalCone()`, the exact one-sided derivative, in forward mode.
        schedule: loads on facet sets, obstacles and supports that change in time.
        progress: `Progress(every, report)` reports the number of steps while they are made.

    Returns:
        The trajectory of T steps.

    Warns if the result is concrete and a body without clamped nodes has turned by more than five
    degrees without `Scene.large_rotation`.

    Raises:
        ValueError: if shapes do not fit, an option is not an object of its kind, a value is not
            finite, the recorded states are more than twice the memory of all devices, or the
            initial state penetrates an obstacle or moves a clamped node.
        SolveError: if a step was not solved, or closes a pair that is taken to stay open, and the
            result is concrete; under jit, grad or vmap the trajectory is NaN from that step on
            instead.

    Derivative: reverse mode of every order by control, initial state, schedule and every value of
    the stepper; forward mode, as by `jax.jvp`, if `weak_contact` names a treatment (the default is
    a `jax.custom_vjp`); at weak contact the derivative that it names.
    """
    check_kind("simulate", stepper, Stepper, "stepper = jc.prepare(jc.discretize(scene), dt)")
    start, scheduled = stepper, None
    if schedule is not None:
        schedule, scheduled = check_schedule(stepper.system, schedule)
        start, initial = at_start(stepper, schedule, initial)
    steps = check_steps(stepper, control, steps, scheduled)
    if isinstance(save_every, bool) or save_every < 1 or steps % save_every:
        raise ValueError(
            f"save_every={save_every} must be a positive divisor of the number of steps, {steps}"
        )
    # Under jit the program may be for another machine, and its shapes are those of one of a batch.
    if not is_traced(stepper):
        check_run_memory(stepper, steps, save_every=save_every)
    if checkpoint is not None:
        check_option("checkpoint", checkpoint, Checkpoint, "Checkpoint()")
    if weak_contact is not None:
        kinds = (WeakContact, AlongDirection)
        check_option("weak_contact", weak_contact, kinds, "ClosedBranch()")
    check_frames(stepper.system, schedule, weak_contact)
    if progress is not None:
        check_option("progress", progress, Progress, "Progress()")
    initial = check_initial(start, initial)
    if control is not None:
        control = jnp.asarray(control, stepper.system.dtype)
    if isinstance(weak_contact, AlongDirection):
        stepper = _open_along(stepper, control, initial, steps, weak_contact, schedule)
        weak_contact = ClosedBranch()
    with _forward_mode_advice():
        parts = (stepper, control, initial, weak_contact, steps, save_every, checkpoint, schedule)
        motion, moves = _run(*parts, progress)
    values = motion._asdict()
    nodal = NodalFields(stepper.system.lifting, values.pop("unknowns"), values.pop("rates"))
    if schedule is not None and moves is not None:
        nodal = show_motion(stepper.system, schedule, moves, nodal)
    mark = stepper.system.mark
    trajectory = Trajectory(**values, nodal=nodal, schedule=schedule, mark=mark)
    if not isinstance(trajectory.status, Tracer):
        raise_if_failed(trajectory)
        warn_of_rotation(stepper.system, motion.unknowns, save_every)
    return trajectory


class _Motion(NamedTuple):
    """A `Trajectory` whose nodal fields are not lifted yet."""

    dt: Array
    time: Array
    unknowns: Array
    rates: Array
    gap: Array
    contact_impulse: Array
    contact: ContactRecord
    iterations: Array
    status: Array
    residual: Array
    frames: FrameMotion | None


@in_full_precision
@partial(jax.jit, static_argnames=("weak_contact", "steps", "save_every", "checkpoint", "progress"))
def _run(
    stepper: Stepper,
    control: Array | None,
    initial: State,
    weak_contact: WeakContact | None,
    steps: int,
    save_every: int,
    checkpoint: Checkpoint | None,
    schedule: Schedule | None,
    progress: Progress | None = None,
) -> tuple[_Motion, Moves | None]:
    system, dt, operators = stepper.system, stepper.dt, stepper.operators
    operators = operators.changed(lambda _, problem: replace(problem, weak_contact=weak_contact))
    drive = shapes = None
    if schedule is not None:
        drive, shapes = drive_of(system, dt, schedule)
    first = system
    if drive is not None and drive.shift is not None:
        first = shifted(system, drive.shift[0])
    assert initial.displacement is not None
    start = first_state(
        stepper.scheme,
        system,
        operators,
        first_displacement(first, initial.displacement, weak_contact),
        system.restrict(initial.velocity),
    )

    if control is not None and system.basis is not None:
        # One product with the basis for all steps, not one in each of them. The sparse product of a
        # full model takes as long in the step, and leaves no second array of all controls.
        control = control_loads(system, control)

    def advance(state: StepState, inputs: tuple[Array | None, StepPerturbation, StepDrive | None]):
        force, perturbation, driven = inputs
        load = system.load
        if force is not None:
            load = load + (force if system.basis is not None else system.control_load(force))
        load = load if perturbation.load is None else load + perturbation.load
        now = system
        if shapes is not None and driven is not None:
            now, more = apply_drive(stepper.scheme, system, dt, shapes, driven)
            load = load + more
        perturbed = perturbation.on(operators, dt)
        result = make_step(stepper.scheme, now, perturbed, dt, state, load)
        iterations, status, residual = worst_of(result.solutions)
        result, status = refuse_closed(system, result.displacement, result, status)
        return result.state(), (
            result.impulse,
            (iterations, status, residual),
            record_of(dt, result.solutions),
        )

    inputs = (control, stepper.perturbation, None if drive is None else every_step(drive))
    loop = (advance, inputs) if progress is None else progress.watch(advance, inputs, steps)
    states, (impulse, (iterations, status, residual), contact) = scan_steps(
        loop[0], start, loop[1], steps, save_every, checkpoint
    )

    displacement = jnp.concatenate([start.displacement[None], states.displacement])
    gap = jax.vmap(lambda y: gap_and_rows(system, y)[0])(displacement)
    moves = None
    if drive is not None:
        recorded = jax.tree.map(lambda x: x[::save_every], drive._replace(loads=None))
        gap, moves = gap if recorded.shift is None else gap + recorded.shift, recorded.moves
    motion = _Motion(
        dt=dt,
        time=dt * jnp.arange(0, steps + 1, save_every),
        unknowns=displacement,
        rates=jnp.concatenate([start.velocity[None], states.velocity]),
        gap=gap,
        contact_impulse=impulse,
        contact=contact,
        iterations=iterations,
        status=status,
        residual=residual,
        frames=frame_motion(system, start, states, displacement),
    )
    return motion, moves


def _open_along(
    stepper: Stepper,
    control: Array | None,
    initial: State,
    steps: int,
    along: AlongDirection,
    schedule: Schedule | None,
) -> Stepper:
    """Return a stepper in whose derivative those weak pairs are open that a direction opens."""
    if along.control is not None and control is None:
        raise ValueError("AlongDirection(control) needs a control; give a control of zeros")
    direction = along.initial
    if isinstance(direction, State):
        direction = direction.filled(jnp.zeros_like(stepper.system.points))
    # What the direction decides is constant for the gradient.
    primals, directions, schedule = jax.lax.stop_gradient(
        ((stepper, control, initial), (None, along.control, direction), schedule)
    )
    tangents = tuple(tangent_of(x, dx) for x, dx in zip(primals, directions, strict=True))

    def contact(stepper: Stepper, control: Array | None, initial: State) -> ContactRecord:
        return _run(stepper, control, initial, CriticalCone(), steps, 1, None, schedule)[0].contact

    record, tangent = jax.jvp(contact, primals, tangents)
    is_open = record.weak & ~(tangent.multiplier > 0.0)
    if stepper.perturbation.is_open is not None:
        is_open = is_open | stepper.perturbation.is_open
    return replace(stepper, perturbation=stepper.perturbation._replace(is_open=is_open))


@contextmanager
def _forward_mode_advice() -> Iterator[None]:
    """Say how forward mode is had where JAX only says that a custom_vjp has none."""
    try:
        yield
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
        raise TypeError(
            "simulate has reverse mode only, as jax.grad uses it, unless weak_contact names what "
            "forward mode means at weak contact: simulate(..., weak_contact=jc.ClosedBranch()), "
            "the derivative that jax.grad takes, or jc.CriticalCone(), the exact one-sided one; "
            "see also jc.directional_derivative"
        ) from error
