"""Checks of what a simulation is given and of what it returns, as far as values are concrete."""

from __future__ import annotations

from numbers import Integral
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.contact import Status
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import State, Trajectory
from jaxcontact.schemes.terms import gap_resolution
from jaxcontact.system.pair_set import Pairs, PairSet
from jaxcontact.system.placing import placed
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.traced import is_traced, poison_unless

Tree = TypeVar("Tree")

#: An initial state may reach into an obstacle by so many rounding errors of the gap: a state that
#: another run ended with does.
PENETRATION = 64.0


#: What to do where `Status.PENETRATES`.
KEEP_PAIR = (
    "a pair that is taken to stay open would penetrate; keep it among the pairs of "
    "system.with_pairs(...) or jc.reduce(..., pairs=...)"
)


class SolveError(RuntimeError):
    """A time step was not solved; the message names step, time and what to try."""


def check_steps(
    stepper: Stepper, control: Array | None, steps: int | None, scheduled: int | None = None
) -> int:
    """Return the number of steps that control, steps and schedule agree on."""
    if control is None and steps is None and scheduled is None:
        raise ValueError("give a control (T, N, d) or (T, n), a schedule, or the number of steps")
    if control is not None:
        check_control(control, stepper.system.points.shape, stepper.system.size)
        _check_finite("control", control)
        if steps is not None and steps != np.shape(control)[0]:
            raise ValueError(
                f"steps={steps} does not fit a control of {np.shape(control)[0]} steps; leave "
                "steps out or cut the control"
            )
    if not isinstance(steps, Integral | None) or isinstance(steps, bool):
        raise ValueError(f"steps must be a whole number, got {steps!r}")
    n_steps = np.shape(control)[0] if control is not None else scheduled if steps is None else steps
    if scheduled is not None and n_steps != scheduled:
        raise ValueError(
            f"the schedule is for {scheduled} steps, but the motion has {n_steps}; forces have T "
            "rows and motions T+1"
        )
    if n_steps is None or n_steps < 1:
        raise ValueError(f"a simulation needs at least one step, got {n_steps}")
    return n_steps


def check_control(
    control: Array, nodal: tuple[int, ...], size: int, steps: int | None = None
) -> None:
    """Check the shape of a control: (T, N, d) with (N, d) = nodal, or (T, n) with n = size."""
    shape, T = np.shape(control), "T" if steps is None else steps
    if shape[1:] not in (nodal, (size,)) or steps not in (None, shape[0]):
        raise ValueError(
            f"control must have shape (T, N, d) = ({T}, {nodal[0]}, {nodal[1]}), on all nodes, the "
            f"clamped ones included, or in unknowns (T, n) = ({T}, {size}), got {shape}"
        )


def check_initial(stepper: Stepper, initial: State | None) -> State:
    """Return the initial state; None is at rest.

    A traced state that cannot be one, or one in a traced scene, is NaN instead of an error.
    """
    system = stepper.system
    shape = (system.n_nodes, system.dimension)
    if not isinstance(initial, State | None):
        raise ValueError(
            f"initial must be a State, got a {type(initial).__name__}; write "
            "initial=jc.State(displacement, velocity)"
        )
    if initial is None or initial.displacement is None or initial.velocity is None:
        rest = jnp.asarray(np.zeros(shape, system.dtype))
        initial = (State() if initial is None else initial).filled(rest)
    for name in ("displacement", "velocity"):
        value = getattr(initial, name)
        if np.shape(value) != shape:
            raise ValueError(
                f"initial.{name} must have shape (N, d) = {shape}, got {np.shape(value)}"
            )
        _check_finite(f"initial.{name}", value)
    state = State(
        jnp.asarray(initial.displacement, system.dtype), jnp.asarray(initial.velocity, system.dtype)
    )
    if is_traced((system, state)):
        return _poison_inadmissible(system, state)
    # Concrete values stay concrete, also where the caller is under jit.
    with jax.ensure_compile_time_eval():
        wrong = jax.tree.map(np.asarray, _find_wrong(system, state))
    for name in ("displacement", "velocity"):
        moved = np.flatnonzero(getattr(wrong, name))
        if moved.size:
            raise ValueError(
                f"initial.{name} is not zero on {moved.size} clamped nodes, first "
                f"{moved[:5].tolist()}"
            )
    depth = wrong.depth
    if np.any(depth > 0.0):
        deepest = int(np.argmax(depth))
        raise ValueError(
            f"the initial state penetrates the obstacle at {np.count_nonzero(depth > 0.0)} contact "
            f"nodes, deepest at node {int(system.contact_nodes[deepest])} by {depth[deepest]:.3g} "
            "m; move the obstacle or give an initial displacement with an open gap"
        )
    return state


class _Wrong(NamedTuple):
    """Where a state cannot be an initial one."""

    displacement: Array
    """Clamped nodes that are displaced, (N,) bool."""

    velocity: Array
    """Clamped nodes that move, (N,) bool."""

    depth: Array
    """Depth of each pair in the obstacle, (C,) [m]; zero up to rounding."""


@in_full_precision
@jax.jit
def _find_wrong(system: System, state: State) -> _Wrong:
    assert state.displacement is not None
    assert state.velocity is not None
    return _Wrong(
        _moved(system, state.displacement),
        _moved(system, state.velocity),
        _penetration(system, state.displacement),
    )


@in_full_precision
@jax.jit
def _poison_inadmissible(system: System, state: State) -> State:
    wrong = jax.lax.stop_gradient(_find_wrong(system, state))
    is_held = ~jnp.any(wrong.displacement) & ~jnp.any(wrong.velocity)
    return poison_unless(is_held & jnp.all(wrong.depth <= 0.0), state)


def _moved(system: System, values: Array) -> Array:
    """Return the clamped nodes where a nodal field (N, d) is not zero, (N,) bool."""
    is_clamped = system.node_numbers == len(system.free_nodes)
    return is_clamped & jnp.any(values != 0.0, axis=1)


def _penetration(system: System, displacement: Array) -> Array:
    """Return the depth of each pair in the obstacle, (C,) [m]; zero up to rounding.

    Of the field itself: its projection on the space of a reduced model may penetrate.
    """
    pairs = system
    if system.basis is not None:
        normals, rest = system.basis.normals, (system.gap_rounding, system.contact_nodes)
        pairs = PairSet(normals, system.gap, *rest)
    elif system.frames is not None:
        pairs = placed(system, system.free_components(displacement))
    return depth(pairs, system.free_components(displacement))


def depth(pairs: Pairs, y: Array) -> Array:
    """Return how deep pairs are in their obstacle, (C,) [m], for y (n,); zero up to rounding."""
    gap = pairs.gap - pairs.normals @ y
    return jnp.where(gap < -PENETRATION * gap_resolution(pairs, y), -gap, 0.0)


def refuse_closed(system: System, y: Array, values: Tree, status: Array) -> tuple[Tree, Array]:
    """Return values and status of unknowns (n,); NaN where a pair that stays open penetrates."""
    if system.open_pairs is None:
        return values, status
    is_open = jnp.all(jax.lax.stop_gradient(depth(system.open_pairs, y)) <= 0.0)
    return poison_unless(is_open, values), jnp.where(is_open, status, Status.PENETRATES)


def _check_finite(name: str, value: Array) -> None:
    if not is_traced(value) and not np.all(np.isfinite(np.asarray(value))):
        bad = np.argwhere(~np.isfinite(np.asarray(value)))
        raise ValueError(
            f"{name} holds {len(bad)} values that are not finite, first at {tuple(bad[0].tolist())}"
        )


def check_every_step(trajectory: Trajectory) -> None:
    """Raise a ValueError if a trajectory does not hold the state of every step; see `simulate`."""
    levels, steps = trajectory.unknowns.shape[-2], trajectory.contact_impulse.shape[-2]
    if levels != steps + 1:
        raise ValueError(
            f"the trajectory holds {levels} states of {steps} steps, but all {steps + 1} are "
            "needed here; simulate it with save_every=1"
        )


def raise_if_failed(trajectory: Trajectory) -> None:
    """Raise a `SolveError` if a step of a trajectory with a concrete status was not solved."""
    status = np.asarray(trajectory.status)
    failed = np.flatnonzero(status > Status.FALLBACK)
    if not failed.size:
        return
    step = int(failed[0])
    if status[step] == Status.PENETRATES:
        raise SolveError(f"step {step + 1} of {status.size}: {KEEP_PAIR}")
    reason = Status(int(status[step])).name.lower().replace("_", " ")
    details = [f"step {step + 1} of {status.size}"]
    # Under grad the status is concrete, but what can be differentiated is not.
    if not is_traced(trajectory.dt):
        details.append(f"(time {(step + 1) * float(trajectory.dt):.6g} s)")
    details.append(f"ended as {reason} after {int(trajectory.iterations[step])} iterations of the")
    details.append("contact solver")
    if not is_traced(trajectory.residual):
        details.append(f"with a relative KKT residual of {float(trajectory.residual[step]):.2e}")
    raise SolveError(
        " ".join(details) + "; reduce dt, check the loads for overflow, or allow more steps, for "
        "instance contact_solver=jc.SemismoothNewton(max_steps=100)"
    )
