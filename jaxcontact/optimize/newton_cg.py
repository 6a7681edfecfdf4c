"""Semismooth Newton with conjugate gradients in a trust region.

    J(p + s) ~ J(p) + dJ.s + 1/2 s.Hs,    |s|_M <= radius

The Hessian product is the derivative of the adjoint gradient with all active sets held fixed: an
element of the generalised Hessian, exact where J is twice differentiable. The minimiser of the
model is sought by CG in the inner product of the parameters, so the number of products does not
grow with the mesh. With bounds, the model is minimised on the free variables and the step is
projected. Source: Conn, Gould, Toint, Trust-Region Methods (2000), Algorithms 6.1.1, 7.5.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxcontact.control.bounds import free_variables, mask, move
from jaxcontact.control.problem import ROUNDING, Point, Problem
from jaxcontact.optimize.method import Ending
from jaxcontact.optimize.trust_region import Path, conjugate_gradient_path


class NewtonCGState(NamedTuple):
    """Point and trust region."""

    point: Point
    """Current iterate."""

    radius: float
    """Radius of the trust region; infinite before the first step."""

    first_norm: float
    """Gradient norm at the start, to which the accuracy of CG refers."""

    curvature: float = 1.0
    """Least curvature s.Hs / |s|_M^2 that conjugate gradients met in the last iteration."""


@dataclass(frozen=True)
class NewtonCG:
    """Trust-region Newton-CG; the value falls in every iteration."""

    forcing: float = 0.1
    """Largest relative residual of CG; it falls with the root of the gradient norm."""

    max_products: int = 100
    """Products with the Hessian per iteration; each keeps one array of the size of the control."""

    acceptance: float = 1e-4
    """Smallest ratio of actual to predicted decrease that is accepted."""

    max_trials: int = 40
    """Trial steps per iteration."""

    is_traceable: ClassVar[bool] = False
    """The length of the path of CG is decided on the host."""

    def init(self, problem: Problem, point: Point) -> NewtonCGState:
        """Return the state at the start."""
        return NewtonCGState(point, math.inf, float(problem.gradient_norm(point)))

    def step(self, problem: Problem, state: NewtonCGState) -> tuple[NewtonCGState, Ending | None]:
        """Return the next state, or why there is none."""
        point, radius, first_norm, _ = state
        value = float(point.value)
        free = free_variables(problem.bounds, point.parameters, point.derivative)
        derivative = mask(free, point.derivative)
        if not bool(jnp.any(derivative != 0.0)):
            return state, Ending.VANISHED

        hessian = problem.hessian(point.parameters)
        norm = float(problem.gradient_norm(point))
        path = conjugate_gradient_path(
            derivative,
            hessian,
            lambda covector: mask(free, problem.riesz(mask(free, covector))),
            radius=radius,
            tolerance=min(self.forcing, math.sqrt(norm / first_norm)) if first_norm else 0.0,
            max_products=self.max_products,
        )
        if radius == math.inf:
            radius = _first_radius(path)
        for _ in range(self.max_trials):
            step, predicted, is_cut = path.cut(radius)
            target, _ = move(problem.bounds, point.parameters, step, 1.0)
            if problem.bounds is not None:
                predicted = _predicted(point, target, hessian)
            if problem.bounds is None and not predicted > ROUNDING * abs(value):
                break
            trial = problem.evaluate(target)
            ratio = (value - float(trial.value)) / predicted if predicted > 0.0 else -math.inf
            if ratio < 0.25:
                step_norm = math.sqrt(max(float(problem.dot(step, step)), 0.0))
                radius = 0.25 * min(radius, step_norm)
            elif ratio > 0.75 and is_cut:
                radius = 2.0 * radius
            if ratio >= self.acceptance and trial.value < value:
                return NewtonCGState(trial, radius, first_norm, path.least_curvature), None
        return state, Ending.NO_DESCENT


def _first_radius(path: Path) -> float:
    """Return the length of the whole path, or without a minimiser that of the gradient step."""
    last = path.segments[-1]
    square = last.start_square
    if last.length < math.inf:
        square += 2.0 * last.length * last.start_dot + last.length**2 * last.direction_square
    return math.sqrt(square if square > 0.0 else last.direction_square)


def _predicted(point: Point, target: Array, hessian: Callable[[Array], Array]) -> float:
    """Return the decrease of the model at a projected step."""
    step = target - point.parameters
    return -float(jnp.vdot(point.derivative, step) + 0.5 * jnp.vdot(step, hessian(step)))
