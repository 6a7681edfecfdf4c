"""Limited-memory BFGS in the inner product of the parameters.

The two-loop recursion runs in the duality pairing: steps s_i are vectors, changes y_i of the
derivative are covectors, and the inner product enters only as the first matrix
H_0 = gamma M^-1, gamma = s.y / (y . M^-1 y). This is BFGS in the Hilbert space, at the price of
one Riesz representative per iteration and no product with the mass in the recursion. With the weak
Wolfe line search it also converges on nonsmooth functions, in practice to their minimisers.
Source: Nocedal and Wright, Numerical Optimization, Algorithm 7.4; Lewis and Overton (2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.control.bounds import free_variables, mask, move
from jaxcontact.control.problem import Point, Problem, select
from jaxcontact.optimize.line_search import Trial, WeakWolfe


class LBFGSState(NamedTuple):
    """Point and memory; m pairs, the newest last, zeros where there is none yet."""

    point: Point
    """Current iterate."""

    steps: Array
    """s_i, differences of the points, (m, ...)."""

    changes: Array
    """y_i, differences of the derivatives, (m, ...)."""

    scale: Any
    """gamma of the first matrix, a number, traced a scalar."""

    count: Any
    """Pairs in the memory, a number, traced a scalar."""


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS with a weak Wolfe line search; the method of choice where nothing else is known."""

    memory: int = 20
    """Number of pairs m; two arrays of the size of the control each."""

    line_search: WeakWolfe = field(default_factory=WeakWolfe)
    """Options of the line search."""

    first_step: float = 1.0
    """The first trial step is this times the negative gradient."""

    def init(self, problem: Problem, point: Point) -> LBFGSState:
        """Return the state at the start."""
        del problem
        return self._forget(point)

    def _forget(self, point: Point) -> LBFGSState:
        nothing = jnp.zeros((self.memory, *point.parameters.shape), point.parameters.dtype)
        return LBFGSState(point, nothing, nothing, self.first_step, 0)

    def step(self, problem: Problem, state: LBFGSState) -> tuple[LBFGSState, str | None]:
        """Return the next state, or the same one and the reason why there is none."""
        new_state = self._try(problem, state)
        if new_state is None and state.count > 0:
            new_state = self._try(problem, self._forget(state.point))
        if new_state is None:
            return state, "the line search found no lower value; this is a kink or a minimum"
        return new_state, None

    def _try(self, problem: Problem, state: LBFGSState) -> LBFGSState | None:
        point = state.point
        free = free_variables(problem.bounds, point.parameters, point.derivative)
        direction, slope = _direction(
            problem.product, point.derivative, state.steps, state.changes, state.scale, free
        )
        if not (math.isfinite(slope) and slope < 0.0):
            return None

        def along(t: float) -> Trial:
            target, tangent = move(problem.bounds, point.parameters, direction, t)
            trial = problem.evaluate(target)
            return Trial(trial.value, float(jnp.vdot(trial.derivative, tangent)), trial)

        found = self.line_search.search(along, point.value, float(slope))
        return None if found is None else self._remember(state, found[1].point)

    def _remember(self, state: LBFGSState, point: Point) -> LBFGSState:
        s = point.parameters - state.point.parameters
        y = point.derivative - state.point.derivative
        change = point.gradient - state.point.gradient
        curvature, size = float(jnp.vdot(s, y)), float(jnp.vdot(y, change))
        # A pair without curvature would make the matrix indefinite; the search gave up then.
        if not (curvature > 0.0 and size > 0.0):
            return state._replace(point=point)
        return LBFGSState(
            point,
            _append(state.steps, s),
            _append(state.changes, y),
            curvature / size,
            min(state.count + 1, self.memory),
        )

    def traced_step(self, problem: Any, state: LBFGSState) -> tuple[LBFGSState, Array]:
        """Return the next state, and whether there is one; see `descend`."""

        def is_searching(carry):
            state, is_found, attempts = carry
            return ~is_found & ((attempts == 0) | ((attempts == 1) & (state.count > 0)))

        def attempt(carry):
            state, _, attempts = carry
            tried = select(attempts == 0, state, self._forget_traced(state))
            new_state, is_found = self._try_traced(problem, tried)
            return select(is_found, new_state, state), is_found, attempts + 1

        carry = state, jnp.bool_(False), jnp.int32(0)
        state, is_found, _ = jax.lax.while_loop(is_searching, attempt, carry)
        return state, is_found

    def _forget_traced(self, state: LBFGSState) -> LBFGSState:
        nothing = jnp.zeros_like(state.steps)
        scale = jnp.full_like(state.scale, self.first_step)
        return LBFGSState(state.point, nothing, nothing, scale, 0 * state.count)

    def _try_traced(self, problem: Any, state: LBFGSState) -> tuple[LBFGSState, Array]:
        point = state.point
        free = free_variables(problem.bounds, point.parameters, point.derivative)
        direction, slope = _direction(
            problem.product, point.derivative, state.steps, state.changes, state.scale, free
        )

        def along(t: Array) -> Trial:
            target, tangent = move(problem.bounds, point.parameters, direction, t)
            trial = problem.evaluate(target)
            return Trial(trial.value, jnp.vdot(trial.derivative, tangent), trial)

        start = Trial(point.value, slope, point)
        found, is_found = self.line_search.traced_search(along, start, slope)
        new = found.point
        s, y = new.parameters - point.parameters, new.derivative - point.derivative
        curvature, size = jnp.vdot(s, y), jnp.vdot(y, new.gradient - point.gradient)
        is_pair = (curvature > 0.0) & (size > 0.0)
        remembered = LBFGSState(
            new,
            _append(state.steps, s),
            _append(state.changes, y),
            curvature / jnp.where(is_pair, size, 1.0),
            jnp.minimum(state.count + 1, self.memory),
        )
        kept = state._replace(point=new)
        is_descent = jnp.isfinite(slope) & (slope < 0.0)
        return select(is_pair, remembered, kept), is_found & is_descent


@jax.jit
def _append(pairs: Array, newest: Array) -> Array:
    return jnp.concatenate([pairs[1:], newest[None]])


@jax.jit
def _direction(product, derivative, steps, changes, scale, free):
    """Return -H dJ on the free variables, and its slope; the two-loop recursion."""

    def inverse(curvature):
        is_positive = curvature > 0.0
        return jnp.where(is_positive, 1.0 / jnp.where(is_positive, curvature, 1.0), 0.0)

    def backward(q, pair):
        s, y = pair[0], mask(free, pair[1])
        weight = inverse(jnp.vdot(s, y)) * jnp.vdot(s, q)
        return q - weight * y, weight

    def forward(r, pair):
        s, y, weight = mask(free, pair[0]), mask(free, pair[1]), pair[2]
        return r + (weight - inverse(jnp.vdot(s, y)) * jnp.vdot(y, r)) * s, None

    derivative = mask(free, derivative)
    q, weights = jax.lax.scan(backward, derivative, (steps, changes), reverse=True)
    r, _ = jax.lax.scan(forward, scale * product.riesz(q), (steps, changes, weights))
    direction = mask(free, -r)
    return direction, jnp.vdot(derivative, direction)
