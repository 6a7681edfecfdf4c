"""How near every contact is to weak contact, and what a cost would gain there.

Weak contact, gap and multiplier both zero, is judged against the sizes of the motion, so that one
tolerance serves every scene. What a cost gains when an impulse pushes a weak pair apart, or when
its gap widens, are the multipliers of (4.32)-(4.33). Source: paper, section 4.5.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.motion.stepper import Stepper, StepPerturbation
from jaxcontact.motion.trajectory import Trajectory


class ContactSizes(NamedTuple):
    """What gaps and multipliers of a motion are compared with."""

    gap: float
    """Largest gap of the motion, [m]."""

    impulse: float
    """Largest multiplier of the motion, or the momentum of a node if that is larger, [N s]."""


def contact_sizes(stepper: Stepper, trajectory: Trajectory) -> ContactSizes:
    """Return the sizes of a motion, positive also where there is neither gap nor impulse."""
    momentum = jnp.max(stepper.operators.mass.diagonal()) * jnp.max(jnp.abs(trajectory.velocity))
    impulse = max(float(jnp.max(trajectory.contact.multiplier, initial=0.0)), float(momentum))
    gap = float(jnp.max(jnp.abs(trajectory.gap), initial=0.0))
    return ContactSizes(gap or 1.0, impulse or 1.0)


def margins(trajectory: Trajectory, sizes: ContactSizes) -> np.ndarray:
    """Return the strict complementarity of every step, contact problem and pair, (T, P, C).

    It is the larger of gap and multiplier, each relative to its size in the motion.
    """
    gap = np.abs(np.asarray(trajectory.contact.gap)) / sizes.gap
    return np.maximum(gap, np.asarray(trajectory.contact.multiplier) / sizes.impulse)


class Sensitivity(NamedTuple):
    """The derivative of a cost by what perturbs every step; see `StepPerturbation`."""

    load: Array
    """By the load, (T, n) [cost/N]: the adjoint state p of (4.40)-(4.41)."""

    gap: Array
    """By the gap of every contact problem, (T, P, C) [cost/m]."""

    push: Array
    """By an impulse that pushes the body away, (T, P, C) [cost/(N s)]."""


def sensitivity(
    cost: Callable[[StepPerturbation], Array],
    stepper: Stepper,
    steps: int,
    is_open: Array | None = None,
) -> Sensitivity:
    """Return the derivative of a cost by load, gap and push of every step.

    Args:
        cost: maps a perturbation of the motion to a scalar.
        stepper: the stepper that makes the motion.
        steps: number of steps T.
        is_open: pairs that are open in the derivative, (T, P, C) bool.
    """
    system, n_problems = stepper.system, len(stepper.operators.problems)
    nothing = jnp.zeros((steps, n_problems, system.normals.count), system.dtype)
    zero = Sensitivity(jnp.zeros((steps, system.size), system.dtype), nothing, nothing)
    return jax.grad(lambda by: cost(StepPerturbation(by.load, by.gap, by.push, is_open)))(zero)
