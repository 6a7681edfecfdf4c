"""Checks of what a simulation is given and of what it returns, as far as values are concrete."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import Status
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import State, Trajectory


class SolveError(RuntimeError):
    """A time step was not solved; the message names step, time and what to try."""


def check_steps(stepper: Stepper, control: Array | None, steps: int | None) -> int:
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


def check_initial(stepper: Stepper, initial: State | None) -> State:
    """Return the initial state; None is at rest."""
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
