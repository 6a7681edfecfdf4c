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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.control.problem import select


class Trial(NamedTuple):
    """A point on the search line."""

    value: Any
    """f(t), a number, traced a scalar; infinite where f is not finite."""

    slope: Any
    """f'(t), a number, traced a scalar; or one of the one-sided derivatives."""

    point: Any
    """Whatever the caller needs of the point."""


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
        self, along: Callable[[float], Trial], value: float, slope: float, step: float = 1.0
    ) -> tuple[float, Trial] | None:
        """Search from t = 0 along a direction of descent.

        Args:
            along: evaluates f at t > 0.
            value: f(0).
            slope: f'(0) < 0.
            step: first t.

        Returns:
            A step and its trial with both conditions; after `max_trials` the longest step found
            with the first one; None if there is none.
        """
        lower, upper = 0.0, float("inf")
        found = None
        for _ in range(self.max_trials):
            trial = along(step)
            if not trial.value < value + self.decrease * step * slope:
                upper = step
            else:
                found = step, trial
                if trial.slope > self.curvature * slope:
                    return found
                lower = step
            step = 2.0 * lower if upper == float("inf") else 0.5 * (lower + upper)
            if step in (lower, upper):
                break
        return found

    def traced_search(
        self, along: Callable[[Array], Trial], start: Trial, slope: Array
    ) -> tuple[Trial, Array]:
        """Search as `search` does from t = 1, in `lax.while_loop`.

        Args:
            along: evaluates f at t > 0, traceable.
            start: f at t = 0.
            slope: f'(0) < 0.

        Returns:
            The trial, and whether it is one with the first condition; else the start.
        """

        def is_searching(carry):
            *_, is_done, trials = carry
            return ~is_done & (trials < self.max_trials)

        def attempt(carry):
            step, lower, upper, found, is_found, _, trials = carry
            trial = along(step)
            is_lower = trial.value < start.value + self.decrease * step * slope
            found = select(is_lower, trial, found)
            lower, upper = jnp.where(is_lower, step, lower), jnp.where(is_lower, upper, step)
            following = jnp.where(jnp.isinf(upper), 2.0 * lower, 0.5 * (lower + upper))
            is_done = is_lower & (trial.slope > self.curvature * slope)
            is_done = is_done | (following == lower) | (following == upper)
            return following, lower, upper, found, is_found | is_lower, is_done, trials + 1

        one, no = jnp.ones_like(start.value), jnp.bool_(False)
        carry = one, 0.0 * one, jnp.inf * one, start, no, no, jnp.int32(0)
        _, _, _, found, is_found, _, _ = jax.lax.while_loop(is_searching, attempt, carry)
        return found, is_found
