"""One step as a function of its own, for loops that `simulate` does not know: feedback, events."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.motion.contact_record import ContactRecord
from jaxcontact.motion.simulate import simulate
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import State


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StepRecord:
    """What a step found beside its new state; C contact pairs, P contact problems of the step."""

    gap: Array
    """Distance to the obstacle along the normal at the end of the step, (C,) [m]."""

    contact_impulse: Array
    """Contact impulse lam of the step, (C,) [N s]."""

    contact: ContactRecord
    """How the contact problems ended, (P, C) each."""

    iterations: Array
    """Iterations of the contact solver, int32."""

    status: Array
    """`Status` of the step, int32."""

    residual: Array
    """KKT residual relative to the largest violation of the free motion, scalar."""


def step(
    stepper: Stepper, state: State | None = None, control: Array | None = None
) -> tuple[State, StepRecord]:
    """Advance a state by one step; equal to `simulate` to rounding, step by step.

    Can be the body of a `jax.lax.scan` whose control depends on the state:
    `jax.lax.scan(lambda state, u: jc.step(stepper, state, feedback(state, u)), state, inputs)`.

    Args:
        stepper: from `prepare`.
        state: where the step starts; None is at rest. In a scan it needs both of its arrays.
        control: force density u of the step, (N, d) or (n,) [N/m^d]; None is none.

    Returns:
        The state after the step, and what else was found.

    Raises:
        ValueError: if a shape does not fit, a value is not finite, the state penetrates an obstacle
            or moves a clamped node, or the scheme hands on more than a state (`Trapezoidal`).
        SolveError: if the step was not solved and the result is concrete; under jit, grad or vmap
            the state is NaN instead.

    Derivative: reverse mode by control, state and every value of the stepper.

    Example:
        >>> stepper = jc.prepare(jc.discretize(jc.scenes.bar_on_wall()), 2e-6)
        >>> thrown = jc.State(velocity=jnp.full((21, 1), -202.2))
        >>> state, record = jc.step(stepper, thrown)
        >>> print(f"{float(record.gap[0]):.6f} in")
        0.009596 in
    """
    if jax.tree.leaves(stepper.scheme.first_carry(stepper.system)):
        raise ValueError(
            f"{stepper.scheme} hands on more from step to step than a State holds; use simulate"
        )
    controls = None if control is None else jnp.asarray(control)[None]
    motion = simulate(stepper, controls, steps=1, initial=state)
    record = StepRecord(
        gap=motion.gap[-1],
        contact_impulse=motion.contact_impulse[0],
        contact=jax.tree.map(lambda x: x[0], motion.contact),
        iterations=motion.iterations[0],
        status=motion.status[0],
        residual=motion.residual[0],
    )
    return motion.final, record
