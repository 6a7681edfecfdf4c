"""Limited-memory BFGS in the inner product of the parameters.

The two-loop recursion runs in the duality pairing: steps s_i are vectors, changes y_i of the
derivative are covectors, and the inner product enters only as the first matrix
H_0 = gamma M^-1, gamma = s.y / (y . M^-1 y). This is BFGS in the Hilbert space, at the price of
one Riesz representative per iteration and no product with the mass in the recursion. With the weak
Wolfe line search it also converges on nonsmooth functions, in practice to their minimisers.
Source: Nocedal, Wright, Numerical Optimization (2006), Algorithm 7.4; Lewis, Overton (2013).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.control.bounds import free_variables, mask, move
from jaxcontact.control.problem import Point, Problem
from jaxcontact.optimize.line_search import Trial, WeakWolfe
from jaxcontact.optimize.method import Ending, Outcome, outcome
from jaxcontact.transforms.loops import cond, select, while_loop


class LBFGSState(NamedTuple):
    """Point and memory; m pairs, the newest last, zeros where there is none yet."""

    point: Point
    """Current iterate."""

    steps: Array
    """s_i, differences of the points, (m, ...)."""

    changes: Array
    """y_i, differences of the derivatives, (m, ...)."""

    scale: Array
    """gamma of the first matrix, a scalar."""

    count: Array
    """Pairs in the memory, int32."""


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS with a weak Wolfe line search; the method of choice where nothing else is known."""

    memory: int = 20
    """Number of pairs m; two arrays of the size of the control each."""

    line_search: WeakWolfe = field(default_factory=WeakWolfe)
    """Options of the line search."""

    first_step: float = 1.0
    """The first trial step is this times the negative gradient."""

    is_traceable: ClassVar[bool] = True
    """Whether `descend` can trace it."""

    def init(self, problem: Problem, point: Point) -> LBFGSState:
        """Return the state at the start."""
        del problem
        return self._without_memory(point)

    def _without_memory(self, point: Point) -> LBFGSState:
        dtype = point.parameters.dtype
        nothing = jnp.zeros((self.memory, *point.parameters.shape), dtype)
        scale = jnp.asarray(self.first_step, dtype)
        return LBFGSState(point, nothing, nothing, scale, jnp.int32(0))

    def step(self, problem: Problem, state: LBFGSState) -> tuple[LBFGSState, Outcome]:
        """Return the state after a line search, if need be a second one without the memory."""

        def is_searching(carry: tuple[LBFGSState, Array, Array]) -> Array:
            state, is_found, searches = carry
            return ~is_found & ((searches == 0) | ((searches == 1) & (state.count > 0)))

        def search(carry: tuple[LBFGSState, Array, Array]) -> tuple[LBFGSState, Array, Array]:
            state, _, searches = carry
            state = cond(searches == 0, lambda s: s, lambda s: self._without_memory(s.point), state)
            found, is_found = self._search(problem, state)
            return select(is_found, found, state), is_found, searches + 1

        carry = state, jnp.bool_(False), jnp.int32(0)
        state, is_found, _ = while_loop(is_searching, search, carry)
        return state, outcome(is_found, Ending.NO_DESCENT)

    def _search(self, problem: Problem, state: LBFGSState) -> tuple[LBFGSState, Array]:
        """Return the state after one line search, and whether it found a lower value."""
        point = state.point
        free = free_variables(problem.bounds, point.parameters, point.derivative)
        direction, slope = _direction(
            problem.product, point.derivative, state.steps, state.changes, state.scale, free
        )

        def along(t: Array) -> Trial[Point]:
            target, tangent = move(problem.bounds, point.parameters, direction, t)
            trial = problem.evaluate(target)
            return Trial(trial.value, jnp.vdot(trial.derivative, tangent), trial)

        start = Trial(point.value, slope, point)
        found, is_found = self.line_search.search(along, start)
        new = found.point
        s, y = new.parameters - point.parameters, new.derivative - point.derivative
        curvature, size = jnp.vdot(s, y), jnp.vdot(y, new.gradient - point.gradient)

        def remember(state: LBFGSState) -> LBFGSState:
            return LBFGSState(
                new,
                _append(state.steps, s),
                _append(state.changes, y),
                curvature / size,
                jnp.minimum(state.count + 1, self.memory),
            )

        # A pair without curvature would make the matrix indefinite; the search gave up then.
        is_pair = (curvature > 0.0) & (size > 0.0)
        return cond(is_pair, remember, lambda state: state._replace(point=new), state), is_found


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
