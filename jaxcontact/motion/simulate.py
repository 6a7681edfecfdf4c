"""The time loop: one contact problem per step, scanned."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import AlongDirection, WeakContact
from jaxcontact.contact.branch import (
    along_direction,
    check_weak_contact,
    float_leaves,
    forward_mode_advice,
    tangent_of,
    with_weak_contact,
)
from jaxcontact.contact.probe import at_step
from jaxcontact.motion.checks import check_initial, check_steps, raise_if_failed
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import State, Trajectory
from jaxcontact.schemes import StepState
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.time_loop import Checkpoint, scan_steps


def simulate(
    stepper: Stepper,
    control: Array | None = None,
    *,
    steps: int | None = None,
    initial: State | None = None,
    save_every: int = 1,
    checkpoint: Checkpoint | None = None,
    weak_contact: WeakContact | AlongDirection | None = None,
) -> Trajectory:
    """Simulate the motion of the body.

    Pure: can be put under jit, grad, vmap (over control, initial state and the values of the
    stepper) with the stepper as an argument. A new control of the same shape compiles nothing.

    Args:
        stepper: from `prepare`.
        control: force density u, (T, N, d) [N/m^d], constant in a step and P1 in space; or None.
        steps: number of steps T; default the length of the control.
        initial: state at time zero; default at rest without displacement.
        save_every: number of steps k between recorded states, a divisor of T: displacement,
            velocity, gap and time then have T/k + 1 levels; contact records keep all T steps.
        checkpoint: `Checkpoint(segments)` lets the backward pass recompute the steps of a segment
            instead of storing them; same gradient to rounding, about one more forward run.
        weak_contact: what the derivative means where gap and impulse of a pair are both zero:
            `Strong()` (default, Algorithm 1), `Inactive()`, `AlongDirection(control)`, or
            `CriticalCone()`, the exact one-sided derivative, in forward mode.

    Returns:
        The trajectory of T steps.

    Raises:
        ValueError: if shapes do not fit, a value is not finite, or the initial state penetrates
            an obstacle or moves a clamped node.
        SolveError: if a step was not solved and the result is concrete; under jit, grad or vmap
            the trajectory is NaN from that step on instead.

    Derivative: reverse mode of every order by control, initial state and every value of the
    stepper; forward mode, as by `jax.jvp`, if `weak_contact` names a treatment (the default is
    a `jax.custom_vjp`); at weak contact the derivative that it names.
    """
    steps = check_steps(stepper, control, steps)
    if save_every < 1 or steps % save_every:
        raise ValueError(
            f"save_every={save_every} must be a positive divisor of the number of steps, {steps}"
        )
    initial = check_initial(stepper, initial)
    if control is not None:
        control = jnp.asarray(control, stepper.system.dtype)
    check_weak_contact(weak_contact)
    with forward_mode_advice():
        trajectory = _run(stepper, control, initial, weak_contact, steps, save_every, checkpoint)
    if not isinstance(trajectory.status, Tracer):
        raise_if_failed(trajectory)
    return trajectory


class StepShift(NamedTuple):
    """A perturbation of the data of every step; zero, to be differentiated by."""

    load: Array
    """Added to the load, (T, n) [N]."""

    gap: Array
    """Added to the gap psi in the contact problem of the step, (T, C) [m]."""


def simulate_shifted(
    stepper: Stepper,
    control: Array | None,
    initial: State | None,
    shift: StepShift,
    weak_contact: WeakContact | AlongDirection,
) -> Trajectory:
    """Simulate with perturbed loads and gaps: their derivative are the adjoint states."""
    initial = check_initial(stepper, initial)
    steps = shift.load.shape[0]
    return _run(stepper, control, initial, weak_contact, steps, 1, None, shift)


@in_full_precision
@partial(jax.jit, static_argnames=("steps", "save_every", "checkpoint"))
def _run(
    stepper: Stepper,
    control: Array | None,
    initial: State,
    weak_contact: Any,
    steps: int,
    save_every: int,
    checkpoint: Checkpoint | None,
    shift: StepShift | None = None,
) -> Trajectory:
    system, dt, operators = stepper.system, stepper.dt, stepper.operators
    if weak_contact is not None:
        operators = with_weak_contact(operators, weak_contact)
    start = StepState(
        displacement=system.restrict(initial.displacement),
        velocity=system.restrict(initial.velocity),
        impulse=jnp.zeros(system.normals.count, system.dtype),
        guess=operators.problem.first_guess(),
        memory=stepper.scheme.memory(system, operators),
    )

    def advance(state: StepState, inputs: tuple[Array | None, Array, StepShift | None]):
        force, step, shift = inputs
        now = system if shift is None else replace(system, gap=system.gap + shift.gap)
        load = system.load if force is None else system.load + system.control_load(force)
        load = load if shift is None else load + shift.load
        state, info = stepper.scheme.step(now, at_step(operators, step), dt, state, load)
        return state, (state.impulse, state.guess.active, info)

    inputs = (control, jnp.arange(steps), shift)
    if isinstance(weak_contact, AlongDirection):
        start_dot, control_dot = _direction(system, start, control, weak_contact)
        (states, _), (impulse, active, info) = scan_steps(
            along_direction(advance),
            (start, start_dot),
            (inputs, control_dot),
            steps,
            save_every,
            checkpoint,
        )
    else:
        states, (impulse, active, info) = scan_steps(
            advance, start, inputs, steps, save_every, checkpoint
        )

    displacement = jnp.concatenate([start.displacement[None], states.displacement])
    velocity = jnp.concatenate([start.velocity[None], states.velocity])
    normal_displacement = jax.vmap(lambda y: system.normals @ y)(displacement)
    return Trajectory(
        time=dt * jnp.arange(0, steps + 1, save_every),
        displacement=system.lift(displacement),
        velocity=system.lift(velocity),
        gap=system.gap[None, :] - normal_displacement,
        contact_impulse=impulse,
        active=active,
        iterations=info.iterations,
        status=info.status,
        residual=info.residual,
        weak=info.weak,
    )


def _direction(
    system: System, start: StepState, control: Array | None, along: AlongDirection
) -> tuple[list, Array | None]:
    """Return the tangents of the start and of the control that decide about weak contact."""
    start_dot = tangent_of(start, None)
    if along.initial is not None:
        start_dot = start_dot._replace(
            displacement=system.restrict(along.initial.displacement),
            velocity=system.restrict(along.initial.velocity),
        )
    control_dot = along.control
    if control_dot is not None and control is None:
        raise ValueError("AlongDirection(control) needs a control; give a control of zeros")
    if control_dot is None and control is not None:
        control_dot = jnp.zeros_like(control)
    return jax.lax.stop_gradient((float_leaves(start, start_dot), control_dot))
