"""Any gradient transformation of optax, applied to the L2 representative of the gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxcontact.control.problem import Point, Problem


class OptaxState(NamedTuple):
    """Point and state of the transformation."""

    point: Point
    """Current iterate; not always the best one."""

    transformation: Any
    """State of the gradient transformation."""


@dataclass(frozen=True)
class Optax:
    """A gradient transformation, for instance `jc.Optax(optax.adam(1e-2))`.

    The iterates need not descend; the optimisation returns the best one that it met. With bounds
    every update is projected.
    """

    transformation: optax.GradientTransformation
    """Maps gradients to updates. It must need neither values nor a function to search along."""

    def init(self, problem: Problem, point: Point) -> OptaxState:
        """Return the state at the start."""
        del problem
        return OptaxState(point, self.transformation.init(point.parameters))

    def step(self, problem: Problem, state: OptaxState) -> tuple[OptaxState, str | None]:
        """Return the next state, or the same one and the reason why there is none."""
        target, transformation = _update(self.transformation.update, *state)
        trial = problem.evaluate(problem.project(target))
        if not math.isfinite(trial.value):
            return state, "the objective is not finite after an update; try a smaller learning rate"
        return OptaxState(trial, transformation), None

    def traced_step(self, problem: Any, state: OptaxState) -> tuple[OptaxState, Array]:
        """Return the next state, and whether it is finite; see `descend`."""
        target, transformation = _update(self.transformation.update, *state)
        trial = problem.evaluate(problem.project(target))
        return OptaxState(trial, transformation), jnp.isfinite(trial.value)


@partial(jax.jit, static_argnums=0)
def _update(update, point: Point, state: Any):
    updates, state = update(point.gradient, state, point.parameters)
    return optax.apply_updates(point.parameters, updates), state
