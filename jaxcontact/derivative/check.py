"""Is the gradient right? Taylor remainders on both sides of a point.

Along a direction d the remainders of a correct derivative J'(u) d,

    R+(h) = J(u + h d) - J(u) - h J'(u) d,    R-(h) = J(u - h d) - J(u) + h J'(u) d,

fall like h^2, on both sides where J is differentiable and on one side at a kink; those of a wrong
one fall like h, those across a jump not at all. Remainders within the rounding of J say nothing and
are left out; if that leaves nothing, the check is undecided.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from jaxcontact.derivative.phase import phase_dependence, phase_words
from jaxcontact.derivative.verdict import Verdict, verdict_of_orders
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.trees import Tree

#: A remainder below this many rounding errors of J is noise; long sums lose a few digits.
NOISE = 64.0

#: Nearby points at which the noise of J is measured, in rounding errors of u, and the power of a
#: rounding error that it cannot exceed: more is a jump.
NEARBY, LARGEST_NOISE = (-16.0, -4.0, 4.0, 16.0), 0.6

#: Remainders that fall by less than this order over all steps are those of a jump.
NO_ORDER = 0.5


@dataclass(frozen=True)
class GradientCheck:
    """The Taylor remainders of a gradient along D directions with H steps, and a verdict."""

    value: float
    """J(u)."""

    steps: np.ndarray
    """Step lengths h, (H,), falling by factors of two."""

    derivative: np.ndarray
    """J'(u) d by the gradient, (D,); the first direction is the gradient, by the scale of u."""

    remainder: np.ndarray
    """|R+| and |R-|, (D, 2, H)."""

    central_error: np.ndarray
    """|[J(u + h d) - J(u - h d)] / (2h) - J'(u) d|, (D, H)."""

    order: np.ndarray
    """Order of R+ and R- at small steps, (D, 2); infinite if R is rounding: J is affine there, or
    rounding hides its change, see `resolution`."""

    noise: float
    """Size below which a remainder is rounding."""

    weak_contacts: int | None
    """Number of (step, contact problem, pair) in weak contact at u; None if no trajectory was
    given."""

    contact_changes: int | None
    """Number of (step, contact problem, pair) whose contact differs at the largest step; None
    like above."""

    verdict: Verdict
    """What follows."""

    closing_speed: float | None
    """Speed at which a gap closes in the step before a touch, [m/s]; None if the objective holds no
    stepper, or nothing touches."""

    phase_spread: float | None
    """Standard deviation of the gradient over the phases of the touch relative to their mean; None
    like above. See `phase_mean` and `SmoothedContact`."""

    @property
    def is_right(self) -> bool:
        """Whether the gradient is the derivative, on both sides and along every direction."""
        return self.verdict in (Verdict.RIGHT, Verdict.CONSTANT)

    @property
    def central_relative_error(self) -> np.ndarray:
        """Smallest error of the central differences relative to the derivative, (D,).

        Absolute where the derivative is zero.
        """
        return np.min(self.central_error, axis=1) / _scale(self.derivative)

    @property
    def resolution(self) -> np.ndarray:
        """Relative error of the derivative that the remainders cannot exclude, (D,).

        Absolute where the derivative is zero.
        """
        return _resolution(self.remainder, self.steps, self.derivative, self.noise)

    def __str__(self) -> str:
        """Return the table of remainders and the verdict."""
        lines = [f"J(u) = {self.value:.10g}"]
        for i, derivative in enumerate(self.derivative):
            name = "gradient" if i == 0 else f"random direction {i}"
            lines.append(f"along the {name}: J'(u) d = {derivative:.8g}")
            lines.append("        h       |R+(h)|      |R-(h)|   central error")
            rows = zip(self.steps, *self.remainder[i], self.central_error[i], strict=True)
            lines += [f"  {h:9.2e}  {a:11.3e}  {b:11.3e}  {c:11.3e}" for h, a, b, c in rows]
            orders = " and ".join(_order_words(order) for order in self.order[i])
            lines.append(f"  order {orders}, central difference to {self._central(i)}")
        if self.weak_contacts is not None:
            lines.append(
                f"weak contact on {self.weak_contacts} (step, pair); "
                f"{self.contact_changes} change within the largest step"
            )
        if self.closing_speed is not None and self.phase_spread is not None:
            lines += phase_words(self.closing_speed, self.phase_spread)
        if self.verdict is Verdict.RIGHT:
            lines.append(f"J' d is exact to {np.max(self.resolution):.0e} or better")
        if self.verdict is Verdict.UNDECIDED:
            lines.append(f"rounding hides errors of {np.min(self.resolution):.0e} of J' d")
        return "\n".join([*lines, self.verdict])

    def _central(self, i: int) -> str:
        return f"{self.central_relative_error[i]:.1e} relative"


@in_full_precision
@np.errstate(invalid="ignore", over="ignore")  # a NaN is a finding, not a warning
def check_gradient(
    objective: Callable[[Tree], Array],
    u: Tree,
    *,
    gradient: Tree | None = None,
    directions: int = 2,
    step: float = 1e-3,
    n_steps: int = 10,
    seed: int = 0,
    trajectory: Callable[[Tree], Trajectory] | None = None,
) -> GradientCheck:
    """Check the gradient of an objective along itself and along random directions.

    Args:
        objective: maps u to a scalar. If it is a pytree that holds a stepper, or a bound method of
            one, the check also says how much the gradient depends on the phase of the touch.
        u: an array, or a pytree of arrays such as the parameters of a network.
        gradient: what to check, shaped like u; default `jax.grad(objective)(u)`.
        directions: number of random directions beside the gradient.
        step: largest step, relative to the norm of every array in u (absolute for a zero array).
        n_steps: number of steps, each half of the one before, at least 2.
        seed: of the random directions.
        trajectory: maps u to the trajectory, to count weak contact and to find the closing speed;
            without it that is the speed of the free flight from rest.

    Returns:
        Remainders, orders and a verdict; print it.

    Raises:
        ValueError: if the objective is not a scalar or the gradient not shaped like u.
    """
    flat, unravel = ravel_pytree(u)
    shape = jax.eval_shape(objective, u)
    if getattr(shape, "shape", None) != ():
        raise ValueError(f"the objective must return one scalar, got {shape}")
    if n_steps < 2:
        raise ValueError(f"an order needs two steps, got n_steps={n_steps}")
    evaluate = jax.jit(lambda x: objective(unravel(x)))
    gradient = jax.jit(jax.grad(objective))(u) if gradient is None else gradient
    if jax.tree.map(np.shape, gradient) != jax.tree.map(np.shape, u):
        raise ValueError(
            f"the gradient must be shaped like u, {jax.tree.map(np.shape, u)}, got "
            f"{jax.tree.map(np.shape, gradient)}"
        )
    slope = np.asarray(ravel_pytree(gradient)[0], float)
    value = float(evaluate(flat))

    # Moduli and ratios side by side: each array moves by the same share of itself.
    leaves = [np.ravel(np.asarray(x, float)) for x in jax.tree.leaves(u)]
    size = np.concatenate([np.full(x.size, np.linalg.norm(x) or 1.0) for x in leaves])
    random = np.random.default_rng(seed).normal(size=(directions, flat.size))
    rows = np.concatenate([(size * slope)[None], random])
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = size * rows / np.where(norms > 0.0, norms, 1.0)
    rows = rows.astype(flat.dtype)

    steps = step * 0.5 ** np.arange(n_steps)
    derivative = rows @ slope
    plus, minus = (
        np.array([[float(evaluate(flat + sign * h * row)) for h in steps] for row in rows])
        for sign in (1.0, -1.0)
    )
    linear = derivative[:, None] * steps
    remainder = np.abs(np.stack([plus - value - linear, minus - value + linear], axis=1))
    central = np.abs((plus - minus) / (2.0 * steps) - derivative[:, None])
    magnitude = max(abs(value), float(np.max(np.abs(derivative))))
    eps = float(np.finfo(flat.dtype).eps)
    nearby = (float(evaluate(flat + x * eps * rows[-1])) - x * eps * derivative[-1] for x in NEARBY)
    measured = max(abs(x - value) for x in nearby)
    is_rounding = measured <= eps**LARGEST_NOISE * magnitude
    noise = max(NOISE * eps * magnitude, 4.0 * measured if is_rounding else 0.0)
    order = np.array([[_order(side, noise) for side in both] for both in remainder])
    quotients = (plus[:, -1] - value) / steps[-1], (value - minus[:, -1]) / steps[-1]
    weak, changes = _count_contacts(trajectory, unravel, flat, step * rows)
    is_constant = not np.any(slope) and np.all(plus == value) and np.all(minus == value)
    resolution = _resolution(remainder, steps, derivative, noise)
    limit = np.maximum(8.0 * noise, np.max(remainder, axis=2) * (steps[-1] / steps[0]) ** NO_ORDER)
    is_jump = np.any(remainder[:, :, -1] > limit)
    if not np.isfinite(value):
        verdict = Verdict.VALUE_NOT_FINITE
    elif not np.all(np.isfinite(slope)):
        verdict = Verdict.GRADIENT_NOT_FINITE
    elif is_constant:
        verdict = Verdict.CONSTANT
    elif is_jump:
        verdict = Verdict.JUMP
    else:
        verdict = verdict_of_orders(order, resolution, quotients, noise / steps[-1], weak)
    speed, spread = phase_dependence(objective, u, None if trajectory is None else trajectory(u))
    return GradientCheck(
        value=value,
        steps=steps,
        derivative=derivative,
        remainder=remainder,
        central_error=central,
        order=order,
        noise=noise,
        weak_contacts=weak,
        contact_changes=changes,
        verdict=verdict,
        closing_speed=speed,
        phase_spread=spread,
    )


def _scale(derivative: np.ndarray) -> np.ndarray:
    return np.where(derivative == 0.0, 1.0, np.abs(derivative))


def _resolution(remainder, steps, derivative, noise: float) -> np.ndarray:
    errors = np.min(np.maximum(np.max(remainder, axis=1), noise) / steps, axis=1)
    return np.maximum(errors / _scale(derivative), np.finfo(float).eps)


def _order(remainder: np.ndarray, noise: float) -> float:
    """Return the order at the smallest steps whose remainder is not rounding."""
    if not np.all(np.isfinite(remainder)):
        return np.nan
    is_noise = np.append(remainder <= noise, True)
    usable = remainder[: int(np.argmax(is_noise))]
    if usable.size < 2:
        # Rounding from the first or second step on: J is affine here.
        return np.inf
    if usable.size < remainder.size and usable[-1] > 8.0 * noise:
        # From far above straight into rounding: affine from this step on, a kink lies beyond.
        return np.inf
    return float(np.median(np.log2(usable[:-1] / usable[1:])[-3:]))


def _order_words(order: float) -> str:
    return "exact" if np.isinf(order) else f"{order:.2f}"


def _count_contacts(trajectory, unravel, flat, longest) -> tuple[int | None, int | None]:
    if trajectory is None:
        return None, None
    here = trajectory(unravel(flat))
    changes = 0
    for row in longest:
        for sign in (1.0, -1.0):
            there = trajectory(unravel(flat + sign * row))
            changed = np.asarray(there.contact.strong) != np.asarray(here.contact.strong)
            changes = max(changes, int(np.sum(changed)))
    return int(np.sum(np.asarray(here.contact.weak))), changes
