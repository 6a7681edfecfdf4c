"""Steepest descent with quadratic regularisation, Algorithm 1 of the paper.

Step: the minimiser of the model (G, s) + omega/2 |s|^2, i.e. s = -G / omega with the L2
representative G. With eta = (actual decrease) / (predicted decrease), predicted = |G|^2/(2 omega),
the curvature of J along the step is (2 - eta) omega, which becomes the next omega within limits.
With bounds the step is s = P(p - G / omega) - p. Source: section 5 of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxcontact.control.problem import ROUNDING, Point, Problem
from jaxcontact.optimize.method import Ending, Outcome, outcome
from jaxcontact.transforms.loops import cond, while_loop


class SteepestDescentState(NamedTuple):
    """Point and regularisation parameter."""

    point: Point
    """Current iterate."""

    regularization: Array
    """omega of the next trial, a scalar."""


class Trials(NamedTuple):
    """Trial steps of one iteration."""

    point: Point
    """The last trial."""

    regularization: Array
    """omega of the next trial, a scalar."""

    is_found: Array
    """Whether the last trial is accepted, bool."""

    is_hopeless: Array
    """Whether the decrease to be expected is below rounding, bool."""

    count: Array
    """Number of trials, int32."""


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

    is_traceable: ClassVar[bool] = True
    """Whether `descend` can trace it."""

    def init(self, problem: Problem, point: Point) -> SteepestDescentState:
        """Return the state at the start."""
        del problem
        omega = jnp.asarray(self.regularization, point.parameters.dtype)
        return SteepestDescentState(point, omega)

    def step(
        self, problem: Problem, state: SteepestDescentState
    ) -> tuple[SteepestDescentState, Outcome]:
        """Return the state after the first trial that is accepted, or why there is none."""
        point = state.point

        def is_searching(trials: Trials) -> Array:
            return ~trials.is_found & ~trials.is_hopeless & (trials.count < self.max_trials)

        def attempt(trials: Trials) -> Trials:
            omega = trials.regularization
            target = problem.project(point.parameters - point.gradient / omega)
            step = target - point.parameters
            slope = jnp.vdot(point.derivative, step)
            predicted = -slope - 0.5 * omega * problem.dot(step, step)
            is_hopeless = ~(predicted > ROUNDING * jnp.abs(point.value))
            trial = cond(is_hopeless, lambda _: point, problem.evaluate, target)
            ratio = (point.value - trial.value) / jnp.where(is_hopeless, 1.0, predicted)
            factor = jnp.where(jnp.isfinite(ratio), 2.0 - ratio, jnp.inf)
            factor = jnp.clip(factor, self.reduction, self.increase).astype(omega.dtype)
            is_found = (ratio >= self.acceptance) & (trial.value < point.value)
            return Trials(trial, omega * factor, is_found, is_hopeless, trials.count + 1)

        no, none = jnp.bool_(False), jnp.int32(0)
        trials = while_loop(
            is_searching, attempt, Trials(point, state.regularization, no, no, none)
        )
        new = SteepestDescentState(trials.point, trials.regularization)
        return new, outcome(trials.is_found, Ending.NO_DESCENT)
