"""Steepest descent with quadratic regularisation, Algorithm 1 of the paper.

Step: the minimiser of the model (G, s) + omega/2 |s|^2, i.e. s = -G / omega with the L2
representative G. With eta = (actual decrease) / (predicted decrease), predicted = |G|^2/(2 omega),
the curvature of J along the step is (2 - eta) omega, which becomes the next omega within limits.
With bounds the step is s = P(p - G / omega) - p. Source: section 5 of the paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.control.problem import ROUNDING, Point, Problem, select


class SteepestDescentState(NamedTuple):
    """Point and regularisation parameter."""

    point: Point
    """Current iterate."""

    regularization: float
    """omega of the next trial."""


@dataclass(frozen=True)
class SteepestDescent:
    """Steepest descent; the value falls in every iteration."""

    regularization: float = 1.0
    """First omega; the first trial step is -G / omega."""

    acceptance: float = 1e-3
    """Smallest ratio of actual to predicted decrease that is accepted."""

    reduction: float = 0.25
    """Most that omega shrinks at once."""

    increase: float = 2.0
    """Most that omega grows at once."""

    max_trials: int = 40
    """Trial steps per iteration."""

    def init(self, problem: Problem, point: Point) -> SteepestDescentState:
        """Return the state at the start."""
        del problem
        return SteepestDescentState(point, self.regularization)

    def step(
        self, problem: Problem, state: SteepestDescentState
    ) -> tuple[SteepestDescentState, str | None]:
        """Return the next state, or the same one and the reason why there is none."""
        point, omega = state
        for _ in range(self.max_trials):
            target = problem.project(point.parameters - point.gradient / omega)
            step = target - point.parameters
            slope = float(jnp.vdot(point.derivative, step))
            predicted = -slope - 0.5 * omega * problem.dot(step, step)
            if not predicted > ROUNDING * abs(point.value):
                break
            trial = problem.evaluate(target)
            ratio = (point.value - trial.value) / predicted
            factor = 2.0 - ratio if math.isfinite(ratio) else math.inf
            next_omega = omega * min(max(factor, self.reduction), self.increase)
            if ratio >= self.acceptance and trial.value < point.value:
                return SteepestDescentState(trial, next_omega), None
            omega = next_omega
        return state, "no step along the gradient reduces the value; this is a kink or a minimum"

    def traced_step(
        self, problem: Any, state: SteepestDescentState
    ) -> tuple[SteepestDescentState, Array]:
        """Return the next state, and whether there is one; see `descend`."""
        point, first_omega = state

        def is_searching(carry):
            _, _, is_found, is_hopeless, trials = carry
            return ~is_found & ~is_hopeless & (trials < self.max_trials)

        def attempt(carry):
            _, omega, _, _, trials = carry
            target = problem.project(point.parameters - point.gradient / omega)
            step = target - point.parameters
            slope = jnp.vdot(point.derivative, step)
            predicted = -slope - 0.5 * omega * problem.dot(step, step)
            is_hopeless = ~(predicted > ROUNDING * jnp.abs(point.value))
            trial = problem.evaluate(target)
            ratio = (point.value - trial.value) / jnp.where(is_hopeless, 1.0, predicted)
            factor = jnp.where(jnp.isfinite(ratio), 2.0 - ratio, jnp.inf)
            omega = omega * jnp.clip(factor, self.reduction, self.increase)
            is_found = (ratio >= self.acceptance) & (trial.value < point.value) & ~is_hopeless
            return trial, omega, is_found, is_hopeless, trials + 1

        no, none = jnp.bool_(False), jnp.int32(0)
        trial, omega, is_found, _, _ = jax.lax.while_loop(
            is_searching, attempt, (point, first_omega, no, no, none)
        )
        return SteepestDescentState(select(is_found, trial, point), omega), is_found
