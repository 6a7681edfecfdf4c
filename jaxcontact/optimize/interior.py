"""A problem with bounds as one without: a barrier keeps its iterates inside.

    minimise J(p) - mu sum_i w_i (log(p_i - lower_i) + log(upper_i - p_i)),    mu > 0,

with the weights w of the inner product. Its Newton steps are those of the primal-dual method: the
multipliers z_i of the bounds go their own way, z_i / s_i with the slack s_i stands for the second
derivative of the barrier, and

    c -> c_i / (a w_i + z_i / s_i)

is the metric of trust region and conjugate gradients, with the least curvature a of J that was met:
in it the number of products does not grow with the mesh or with 1 / mu. Where a bound holds its
slack tends to zero like mu. Source: Nocedal, Wright, Numerical Optimization (2006), 19.3 and 19.5;
MATH.md 5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.control.bounds import Bounds
from jaxcontact.control.problem import Point, Problem

#: A step keeps this part of every slack.
KEPT = 5e-3

#: The first iterate keeps this part of the box to each bound.
INSIDE = 1e-2

#: z s / (mu w) stays within this factor of one.
DUAL_SPREAD = 1e2

#: The first barrier is as large at the start as this times the objective.
FIRST_CHANGE = 1.0


class Duals(NamedTuple):
    """What goes with an iterate."""

    mu: float | Array
    """mu, scalar."""

    lower: Array
    """Multipliers of the lower bounds, zero where there is none."""

    upper: Array
    """Multipliers of the upper bounds, likewise."""

    curvature: float | Array
    """a, the least curvature of J that was met, scalar."""


class Barrier(NamedTuple):
    """The barrier at one iterate."""

    bounds: tuple[Array, Array]
    """Lower and upper bounds of the parameters."""

    weights: Array
    """w, the weights of the inner product."""

    center: Array
    """The iterate p."""

    duals: Duals
    """Its multipliers."""


@dataclass(frozen=True)
class Interior(Problem):
    """The problem with the barrier in the place of its bounds."""

    barrier: Barrier = field(kw_only=True)
    """The barrier at the last iterate."""

    @classmethod
    def of(cls, problem: Problem, start: Point) -> tuple[Interior, Point]:
        """Return the problem with a first barrier, and the start with it.

        Args:
            problem: with bounds and a diagonal inner product.
            start: a point of it, see `well_inside`.
        """
        along = jnp.vdot(start.gradient, problem.hessian(start.parameters)(start.gradient))
        square = jnp.vdot(start.derivative, start.gradient)
        curvature = jnp.where((along > 0.0) & (square > 0.0), along / square, 1.0)
        mu = FIRST_CHANGE * jnp.abs(start.value) / jnp.sum(_weights(problem, start.parameters))
        nothing = jnp.zeros_like(start.parameters)
        interior, _ = cls.after(problem, start, Duals(mu, nothing, nothing, curvature))
        lower, upper = _targets(interior.barrier, start.parameters)
        return cls.after(problem, start, Duals(mu, lower, upper, curvature))

    @classmethod
    def after(cls, problem: Problem, start: Point, duals: Duals) -> tuple[Interior, Point]:
        """Return the problem with a barrier, and a point of it without one with it."""
        assert problem.bounds is not None
        parts: dict[str, Any] = {x.name: getattr(problem, x.name) for x in fields(Problem)}
        parts["bounds"] = None
        weights = _weights(problem, start.parameters)
        barrier = Barrier(problem.bounds, weights, start.parameters, duals)
        interior = cls(**parts, barrier=barrier)
        return interior, interior._with_barrier(start)

    def moved(self, point: Point, curvature: float | None) -> tuple[Interior, Point]:
        """Return the problem and the point at the next iterate, with its multipliers and metric.

        Args:
            point: the iterate.
            curvature: least curvature in the metric that was met on the way to it, or None.
        """
        barrier = _moved(self.barrier, point.parameters, 1.0 if curvature is None else curvature)
        problem = replace(self, barrier=barrier)
        return problem, point._replace(gradient=problem.riesz(point.derivative))

    def evaluate(self, parameters: Array) -> Point:
        """Return the point; its value is infinite where a step goes too near to a bound."""
        if not _is_inside(self.barrier, parameters):
            nothing = jnp.full_like(parameters, jnp.nan)
            return Point(parameters, jnp.full((), jnp.inf, parameters.dtype), nothing, nothing)
        return self._with_barrier(super().evaluate(parameters))

    def _with_barrier(self, point: Point) -> Point:
        value, derivative = _barrier_value(self.barrier, point.parameters)
        derivative = point.derivative + derivative
        return Point(point.parameters, point.value + value, derivative, self.riesz(derivative))

    def hessian(self, parameters: Array) -> Callable[[Array], Array]:
        """Return the Hessian with that of the barrier at the last iterate."""
        product, diagonal = super().hessian(parameters), _diagonal(self.barrier)
        return lambda direction: product(direction) + diagonal * direction

    def riesz(self, covector: Array) -> Array:
        """Return the vector that represents a covector in the metric; zero where nothing moves."""
        return _metric_riesz(self.barrier, covector)

    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two vectors in the metric, a scalar."""
        return jnp.vdot(first, _metric(self.barrier) * second)

    def project(self, parameters: Array) -> Array:
        """Return the nearest point that keeps a tenth of every slack of the last iterate."""
        lower, upper = (0.1 * s for s in _slacks(self.barrier.bounds, self.barrier.center))
        low, high = self.barrier.bounds
        kept = jnp.clip(parameters, low + lower, high - upper)
        return jnp.where(low < high, kept, self.barrier.center)

    def gradient_norm(self, point: Point) -> Array:
        """Return the dual norm of the gradient, a scalar; that of J where no bound is near."""
        square = jnp.vdot(point.derivative, point.gradient)
        return jnp.sqrt(self.barrier.duals.curvature * jnp.maximum(square, 0.0))


def well_inside(bounds: tuple[Array, Array], parameters: Array) -> Array:
    """Return the nearest parameters well within the bounds."""
    low, high = bounds
    # A side without a bound has no width: the numbers that are there tell the size.
    sizes = jnp.abs(jnp.stack([parameters, low, high]))
    largest = jnp.max(jnp.where(jnp.isfinite(sizes), sizes, 0.0))
    width = jnp.where(jnp.isfinite(high - low), high - low, jnp.where(largest > 0.0, largest, 1.0))
    return jnp.clip(parameters, low + INSIDE * width, high - INSIDE * width)


def snapped(bounds: Bounds, last: Array, before: Array, reduction: float) -> Array:
    """Return the last of two minimisers with what tends to a bound like mu put on it."""
    if bounds is None:
        return last
    low, high = bounds
    at_low, at_high = (
        now < reduction**0.5 * then
        for now, then in zip(_slacks(bounds, last), _slacks(bounds, before), strict=True)
    )
    return jnp.where(at_low, low, jnp.where(at_high, high, last))


def _weights(problem: Problem, like: Array) -> Array:
    """Return the weights of a diagonal inner product."""
    return 1.0 / problem.riesz(jnp.ones_like(like))


def _slacks(bounds: tuple[Array, Array], parameters: Array) -> tuple[Array, Array]:
    """Return the distances to both bounds; infinite where there is none, or nothing can move."""
    low, high = bounds
    moves = low < high
    return (
        jnp.where(moves, parameters - low, jnp.inf),
        jnp.where(moves, high - parameters, jnp.inf),
    )


def _targets(barrier: Barrier, parameters: Array) -> tuple[Array, Array]:
    """Return mu w / s at both bounds."""
    first, second = _slacks(barrier.bounds, parameters)
    size = barrier.duals.mu * barrier.weights
    return size / first, size / second


@jax.jit
def _is_inside(barrier: Barrier, parameters: Array) -> Array:
    old, new = (jnp.stack(_slacks(barrier.bounds, p)) for p in (barrier.center, parameters))
    return jnp.all(new >= KEPT * old)


@jax.jit
def _barrier_value(barrier: Barrier, parameters: Array) -> tuple[Array, Array]:
    """Return value and derivative of the barrier."""
    slacks = jnp.stack(_slacks(barrier.bounds, parameters))
    logs = jnp.where(jnp.isfinite(slacks), jnp.log(slacks), 0.0)
    lower, upper = _targets(barrier, parameters)
    return -barrier.duals.mu * jnp.sum(barrier.weights[None] * logs), upper - lower


@jax.jit
def _diagonal(barrier: Barrier) -> Array:
    """Return z / s of both bounds."""
    first, second = _slacks(barrier.bounds, barrier.center)
    return barrier.duals.lower / first + barrier.duals.upper / second


@jax.jit
def _metric(barrier: Barrier) -> Array:
    return barrier.duals.curvature * barrier.weights + _diagonal(barrier)


@jax.jit
def _metric_riesz(barrier: Barrier, covector: Array) -> Array:
    low, high = barrier.bounds
    return jnp.where(low < high, covector / _metric(barrier), 0.0)


@jax.jit
def _moved(barrier: Barrier, parameters: Array, step_curvature: float) -> Barrier:
    """Return the barrier at the next iterate: z + dz solves s dz + z ds = mu w - s z."""
    duals, step = barrier.duals, parameters - barrier.center
    moved = barrier._replace(center=parameters)
    old, targets = _slacks(barrier.bounds, barrier.center), _targets(moved, parameters)

    def follow(side: int, z: Array, change: Array) -> Array:
        following = duals.mu * barrier.weights / old[side] - z / old[side] * change
        return jnp.clip(following, targets[side] / DUAL_SPREAD, targets[side] * DUAL_SPREAD)

    lower, upper = follow(0, duals.lower, step), follow(1, duals.upper, -step)
    curvature = duals.curvature * jnp.clip(step_curvature, 1e-3, 1.0)
    return moved._replace(duals=Duals(duals.mu, lower, upper, curvature))
