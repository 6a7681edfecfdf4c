"""The time loop: one contact problem per step, scanned."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import AlongDirection, Status, WeakContact
from jaxcontact.contact.branch import (
    along_direction,
    check_weak_contact,
    float_leaves,
    forward_mode_advice,
    tangent_of,
    with_weak_contact,
)
from jaxcontact.contact.probe import at_step
from jaxcontact.precision import in_full_precision
from jaxcontact.schemes import StepState
from jaxcontact.stepper import Stepper
from jaxcontact.system import System
from jaxcontact.time_loop import Checkpoint, scan_steps
from jaxcontact.trajectory import State, Trajectory


class SolveError(RuntimeError):
    """A time step was not solved; the message names step, time and what to try."""


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
    steps = _check_steps(stepper, control, steps)
    if save_every < 1 or steps % save_every:
        raise ValueError(
            f"save_every={save_every} must be a positive divisor of the number of steps, {steps}"
        )
    initial = _check_initial(stepper, initial)
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
    initial = _check_initial(stepper, initial)
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


def _check_steps(stepper: Stepper, control: Array | None, steps: int | None) -> int:
    """Return the number of steps that control and steps agree on."""
    if control is None and steps is None:
        raise ValueError("give a control (T, N, d) or the number of steps")
    if control is not None:
        system = stepper.system
        expected = (system.n_nodes, system.dimension)
        if np.ndim(control) != 3 or np.shape(control)[1:] != expected:
            raise ValueError(
                f"control must have shape (T, N, d) = (T, {expected[0]}, {expected[1]}), got "
                f"{np.shape(control)}; it lives on all nodes, the clamped ones included"
            )
        _check_finite("control", control)
        if steps is not None and steps != np.shape(control)[0]:
            raise ValueError(
                f"steps={steps} does not fit a control of {np.shape(control)[0]} steps; leave "
                "steps out or cut the control"
            )
    n_steps = steps if control is None else np.shape(control)[0]
    if n_steps is None or n_steps < 1:
        raise ValueError(f"a simulation needs at least one step, got {n_steps}")
    return n_steps


def _check_initial(stepper: Stepper, initial: State | None) -> State:
    system = stepper.system
    shape = (system.n_nodes, system.dimension)
    if initial is None:
        rest = jnp.zeros(shape, system.dtype)
        initial = State(rest, rest)
    for name in ("displacement", "velocity"):
        value = getattr(initial, name)
        if np.shape(value) != shape:
            raise ValueError(
                f"initial.{name} must have shape (N, d) = {shape}, got {np.shape(value)}"
            )
        _check_finite(f"initial.{name}", value)
        _check_clamped(system, name, value)
    _check_penetration(system, initial.displacement)
    return State(
        jnp.asarray(initial.displacement, system.dtype), jnp.asarray(initial.velocity, system.dtype)
    )


def _is_concrete(*values) -> bool:
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def _check_finite(name: str, value: Array) -> None:
    if _is_concrete(value) and not np.all(np.isfinite(np.asarray(value))):
        bad = np.argwhere(~np.isfinite(np.asarray(value)))
        raise ValueError(
            f"{name} holds {len(bad)} values that are not finite, first at {tuple(bad[0].tolist())}"
        )


def _check_clamped(system, name: str, value: Array) -> None:
    if not _is_concrete(value, system.node_numbers):
        return
    is_clamped = np.asarray(system.node_numbers) == len(system.free_nodes)
    moved = np.flatnonzero(is_clamped & np.any(np.asarray(value) != 0.0, axis=1))
    if moved.size:
        raise ValueError(
            f"initial.{name} is not zero on {moved.size} clamped nodes, first {moved[:5].tolist()}"
        )


def _check_penetration(system, displacement: Array) -> None:
    if not _is_concrete(system, displacement):
        return
    # Concrete values stay concrete, also where the caller is under jit.
    with jax.ensure_compile_time_eval():
        y = system.restrict(jnp.asarray(displacement, system.dtype))
        gap = np.asarray(system.gap - system.normals @ y)
    size = np.max(np.abs(np.asarray(system.gap)), initial=0.0) + np.max(np.abs(np.asarray(y)))
    deepest = int(np.argmin(gap)) if gap.size else 0
    if gap.size and gap[deepest] < -64 * np.finfo(gap.dtype).eps * size:
        count = np.count_nonzero(gap < 0.0)
        raise ValueError(
            f"the initial state penetrates the obstacle at {count} contact nodes, deepest at node "
            f"{int(system.contact_nodes[deepest])} by {-gap[deepest]:.3g} m; move the obstacle or "
            "give an initial displacement with an open gap"
        )


def raise_if_failed(trajectory: Trajectory) -> None:
    """Raise a `SolveError` if a step of a concrete trajectory was not solved."""
    status = np.asarray(trajectory.status)
    failed = np.flatnonzero(status > Status.FALLBACK)
    if not failed.size:
        return
    step = int(failed[0])
    time = float(trajectory.time[-1]) * (step + 1) / status.size
    reason = Status(int(status[step])).name.lower().replace("_", " ")
    raise SolveError(
        f"step {step + 1} of {status.size} (time {time:.6g} s) ended "
        f"as {reason} after {int(trajectory.iterations[step])} iterations of the contact solver, "
        f"relative KKT residual {float(trajectory.residual[step]):.2e}; "
        "reduce dt, check the loads for overflow, or allow more steps, for instance "
        "contact_solver=jc.SemismoothNewton(max_steps=100)"
    )
