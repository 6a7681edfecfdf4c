"""How much a gradient depends on the phase of the touch, and its mean over one period of it.

The energy that a discrete motion loses at a touch depends on the place of the touch within its
step with amplitude O(h), and that place on the data with slope O(1/h): the exact derivative of a
motion through an impact has an error that no refinement removes. A gap that is larger by v dt, v
the closing speed, moves the touch by one step: one period. Source: MATH.md 8.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from jaxcontact.contact.closing_speed import closing_speed
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.transforms.trees import PyTree, Tree, as_partial, exchange, nodes

#: Phases that one period is sampled at.
PHASES = 8

#: A spread over the phases above which a gradient is said to depend on the phase.
LARGE_SPREAD = 0.05

ADVICE = (
    "PHASE: through this impact the exact derivative of one motion does not converge with the "
    "mesh; use jc.with_contact(..., jc.SmoothedContact.for_scene(stepper, speed={speed:.3g}))"
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PhaseMean:
    """The mean of an objective over one period of the phase of the touch; see `phase_mean`."""

    objective: Callable[..., Array]
    """The objective, which holds a stepper."""

    speed: Array
    """Closing speed at touch, scalar [m/s]."""

    phases: int = field(default=PHASES, metadata={"static": True})
    """Number of motions, equally spaced over the period."""

    def __call__(self, u: PyTree) -> Array:
        """Return the mean of J(u), a scalar, over gaps that differ by up to v dt / 2."""
        fractions = (jnp.arange(self.phases) + 0.5) / self.phases - 0.5
        return jnp.mean(jax.vmap(lambda x: moved(self.objective, x * self.speed)(u))(fractions))


def phase_mean(
    objective: Callable[..., Array],
    speed: float | Array | None = None,
    *,
    phases: int = PHASES,
) -> PhaseMean:
    """Return the mean of an objective over the phases of the touch, whose gradient converges.

    All phases run together as one batch. `SmoothedContact` needs one run for the same, and is
    smoother; this keeps exact contact.

    Args:
        objective: maps u to a scalar; a pytree that holds a stepper, or a bound method of one.
        speed: closing speed at touch, [m/s]; default that of the free flight from rest, see
            `SmoothedContact.for_scene`.
        phases: number of motions.

    Returns:
        The mean as an objective of the same kind. Every gap is moved by up to speed dt / 2 to both
        sides: an initial state that is closer to an obstacle penetrates it.

    Raises:
        ValueError: if the objective holds no stepper, the speed is not positive or not to be found,
            or there is no phase.
    """
    if phases < 1:
        raise ValueError(f"phases must be 1 or more, got {phases}; leave it out for {PHASES}")
    objective = as_partial(objective)
    steppers = nodes(objective, Stepper)
    if not steppers:
        exchange(objective, Stepper, lambda stepper: stepper)  # raises
    return PhaseMean(objective, closing_speed(steppers[0], None, speed), phases)


def phase_spread(gradient: Callable[[Array], object], speed: float | Array) -> Array:
    """Return the standard deviation of a gradient over one period of the phase, over its mean.

    Args:
        gradient: maps a distance in units of dt, [m/s], by which every gap is larger, to a pytree.
        speed: closing speed at touch, scalar [m/s].

    Returns:
        A scalar; NaN if the mean is zero or a gradient is not finite.
    """

    def add(sums: tuple[Array, Array], fraction: Array) -> tuple[tuple[Array, Array], None]:
        flat, _ = ravel_pytree(gradient(fraction * speed))
        return (sums[0] + flat, sums[1] + jnp.vdot(flat, flat)), None

    fractions = jnp.arange(PHASES) / PHASES
    zero = jax.tree.map(
        jnp.zeros_like, jax.eval_shape(lambda x: ravel_pytree(gradient(x))[0], fractions[0])
    )
    (total, squares), _ = jax.lax.scan(add, (zero, jnp.zeros((), zero.dtype)), fractions)
    size = jnp.vdot(total, total) / PHASES**2
    return jnp.sqrt(jnp.maximum(squares / PHASES - size, 0.0) / size)


def phase_dependence(
    objective: Callable[[Tree], Array], u: Tree, motion: Trajectory | None
) -> tuple[float | None, float | None]:
    """Return closing speed and `phase_spread` of the gradient of an objective.

    Args:
        objective: maps u to a scalar.
        u: the point.
        motion: the motion of u, whose touches have the speed; None is the free flight from rest.

    Returns:
        None and None if the objective holds no stepper, or nothing touches.
    """
    steppers = nodes(objective, Stepper)
    speed = None
    if steppers and motion is not None:
        speed = float(motion.closing_speed)
    elif steppers:
        with suppress(ValueError):  # nothing flies at an obstacle
            speed = float(closing_speed(steppers[0], None, None))
    if not speed:
        return None, None
    return speed, float(_spread_of_gradient(as_partial(objective), u, speed))


@jax.jit
def _spread_of_gradient(objective: Callable[[Tree], Array], u: Tree, speed: float) -> Array:
    return phase_spread(lambda x: jax.grad(lambda v: moved(objective, x)(v))(u), speed)


def phase_words(speed: float, spread: float) -> list[str]:
    """Return what a spread over the phases means, and what to do about a large one."""
    lines = [f"phase of the touch at {speed:.3g} m/s: the gradient varies by {spread:.1%}"]
    return lines if spread <= LARGE_SPREAD else [*lines, ADVICE.format(speed=speed)]


def moved(tree: Tree, distance: Array | float) -> Tree:
    """Return a pytree whose steppers have every gap larger by a distance in units of dt [m/s]."""

    def move(stepper: Stepper) -> Stepper:
        system = stepper.system
        return replace(stepper, system=system.with_gap(system.gap + stepper.dt * distance))

    return exchange(tree, Stepper, move)
