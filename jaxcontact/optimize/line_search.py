"""Weak Wolfe line search by bracketing, right for nonsmooth functions.

Find t with  f(t) < f(0) + c1 t f'(0)  and  f'(t) > c2 f'(0). Where f has kinks, the strong
condition |f'(t)| < c2 |f'(0)| may hold nowhere, and interpolation of smooth models is misled;
expansion and bisection end after finitely many steps for every locally Lipschitz, semialgebraic f
that is bounded below. Source: Lewis and Overton, Nonsmooth optimization via quasi-Newton methods,
Math. Program. 141 (2013), Algorithm 2.6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import jax.numpy as jnp
from jax import Array

from jaxcontact.transforms.loops import select, while_loop

P = TypeVar("P")


class Trial(NamedTuple, Generic[P]):
    """A point on the search line."""

    value: Array | float
    """f(t), a scalar; infinite where f is not finite."""

    slope: Array | float
    """f'(t), a scalar, or one of the one-sided derivatives."""

    point: P
    """Whatever the caller needs of the point."""


class Bracket(NamedTuple, Generic[P]):
    """The search so far; all but the trial are scalars."""

    step: Array
    """t of the next trial."""

    lower: Array
    """Longest step with enough decrease."""

    upper: Array
    """Shortest step without; infinite if there is none yet."""

    found: Trial[P]
    """Trial at the lower end, at first the start."""

    is_found: Array
    """Whether a trial had enough decrease, bool."""

    is_done: Array
    """Whether both conditions hold or no number is left in between, bool."""

    count: Array
    """Number of trials, int32."""


@dataclass(frozen=True)
class WeakWolfe:
    """Options of the line search."""

    decrease: float = 1e-4
    """c1, the share of the predicted decrease that is asked for."""

    curvature: float = 0.5
    """c2 > c1; smaller values search more exactly."""

    max_trials: int = 40
    """Evaluations per search."""

    def search(
        self, along: Callable[[Array], Trial[P]], start: Trial[P], step: float = 1.0
    ) -> tuple[Trial[P], Array]:
        """Search from t = 0; on the host or under a trace.

        Args:
            along: evaluates f at t > 0.
            start: f at t = 0; where its slope is not negative, nothing is evaluated.
            step: first t.

        Returns:
            A trial with both conditions, or after `max_trials` the longest step found with the
            first one; and whether there is one, else the trial is the start.
        """

        def is_searching(bracket: Bracket[P]) -> Array:
            return ~bracket.is_done & (bracket.count < self.max_trials)

        def attempt(bracket: Bracket[P]) -> Bracket[P]:
            t = bracket.step
            trial = along(t)
            is_lower = jnp.asarray(trial.value < start.value + self.decrease * t * start.slope)
            lower = jnp.where(is_lower, t, bracket.lower)
            upper = jnp.where(is_lower, bracket.upper, t)
            following = jnp.where(jnp.isinf(upper), 2.0 * lower, 0.5 * (lower + upper))
            is_wolfe = is_lower & (trial.slope > self.curvature * start.slope)
            return Bracket(
                step=following,
                lower=lower,
                upper=upper,
                found=select(is_lower, trial, bracket.found),
                is_found=bracket.is_found | is_lower,
                is_done=is_wolfe | (following == lower) | (following == upper),
                count=bracket.count + 1,
            )

        first = jnp.full_like(start.slope, step)
        is_descent = jnp.isfinite(start.slope) & (start.slope < 0.0)
        bracket = Bracket(
            step=first,
            lower=jnp.zeros_like(first),
            upper=jnp.full_like(first, jnp.inf),
            found=start,
            is_found=jnp.bool_(False),
            is_done=~is_descent,
            count=jnp.int32(0),
        )
        bracket = while_loop(is_searching, attempt, bracket)
        return bracket.found, bracket.is_found
