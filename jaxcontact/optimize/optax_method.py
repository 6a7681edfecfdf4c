"""Any gradient transformation of optax, applied to the L2 representative of the gradient."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxcontact.control.problem import Point, Problem
from jaxcontact.optimize.method import Ending, Outcome, outcome


class OptaxState(NamedTuple):
    """Point and state of the transformation."""

    point: Point
    """Current iterate; not always the best one."""

    transformation: optax.OptState
    """State of the gradient transformation."""


@dataclass(frozen=True)
class Optax:
    """A gradient transformation, for instance `jc.Optax(optax.adam(1e-2))`.

    The iterates need not descend; the optimisation returns the best one that it met. With bounds
    every update is projected.
    """

    transformation: optax.GradientTransformation
    """Maps gradients to updates. It must need neither values nor a function to search along."""

    is_traceable: ClassVar[bool] = True
    """Whether `descend` can trace it."""

    def init(self, problem: Problem, point: Point) -> OptaxState:
        """Return the state at the start."""
        del problem
        return OptaxState(point, self.transformation.init(point.parameters))

    def step(self, problem: Problem, state: OptaxState) -> tuple[OptaxState, Outcome]:
        """Return the state after one update, or that it is not finite."""
        target, transformation = _update(self.transformation.update, *state)
        new = problem.evaluate(problem.project(target))
        return OptaxState(new, transformation), outcome(jnp.isfinite(new.value), Ending.NOT_FINITE)


@partial(jax.jit, static_argnums=0)
def _update(
    update: optax.TransformUpdateFn, point: Point, state: optax.OptState
) -> tuple[Array, optax.OptState]:
    updates, state = update(point.gradient, state, point.parameters)
    return cast(Array, optax.apply_updates(point.parameters, updates)), state
