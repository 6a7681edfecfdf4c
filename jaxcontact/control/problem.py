"""The reduced problem as a method sees it: evaluate, multiply by the Hessian, project.

    minimise J(E p)  over lower <= p <= upper

with a linear map E from parameters to controls (the identity if there is none) and the inner
product of the parameters. A point carries the derivative as a covector and its Riesz
representative, so that norms and slopes of gradients cost no product with the mass.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

from jaxcontact.control.inner_product import InnerProduct
from jaxcontact.motion.checks import SolveError

#: A predicted decrease below this times the value is rounding error.
ROUNDING = 1e-16


class Point(NamedTuple):
    """A point with value and gradient."""

    parameters: Array
    """The point p."""

    value: Any
    """J(E p), a number, traced a scalar; infinite where the objective is not finite."""

    derivative: Array
    """dJ/dp, entry by entry."""

    gradient: Array
    """Riesz representative of the derivative."""


def select(condition: Array, first: Any, second: Any) -> Any:
    """Return one of two pytrees of arrays, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), first, second)


def identity(parameters: Array) -> Array:
    """Return the control itself."""
    return parameters


def as_partial(objective: Callable[[Array], Any]) -> Callable[[Array], Any]:
    """Return a bound method of a pytree as `Partial`, so that its arrays are arguments of jit."""
    if inspect.ismethod(objective) and _is_pytree(objective.__self__):
        return Partial(objective.__func__, objective.__self__)
    return objective


def _is_pytree(value: Any) -> bool:
    return not jax.tree_util.all_leaves([value])


class Problem:
    """Objective, control map, inner product and bounds, with a count of what was evaluated."""

    def __init__(
        self,
        objective: Callable[[Array], Array],
        product: InnerProduct,
        *,
        controls: Any = None,
        bounds: tuple[Array, Array] | None = None,
    ):
        """State the problem.

        Args:
            objective: maps a control to a scalar. A `jax.tree_util.Partial` of arrays (or a bound
                method of a pytree) is compiled with its arrays as arguments; any other function
                runs as it is, since compiling it would bake the arrays it holds into the program.
            product: inner product of the parameters.
            controls: linear map from parameters to controls, a pytree; None is the identity.
            bounds: lower and upper bounds of the parameters.
        """
        self.objective = as_partial(objective)
        self.product = product
        self.controls = Partial(identity) if controls is None else controls
        self.bounds = bounds
        self.evaluations = 0
        self.hessian_products = 0
        is_compiled = all(_is_pytree(part) for part in (self.objective, self.controls, product))
        self._evaluate = _evaluate_compiled if is_compiled else value_and_gradient
        self._hessian_product = _hessian_product_compiled if is_compiled else _hessian_product

    def evaluate(self, parameters: Array) -> Point:
        """Return value and gradient; the value is infinite if anything is not finite."""
        self.evaluations += 1
        try:
            value, derivative, gradient, is_finite = self._evaluate(
                self.objective, self.controls, self.product, parameters
            )
        except SolveError:
            nothing = jnp.full_like(parameters, jnp.nan)
            return Point(parameters, math.inf, nothing, nothing)
        return Point(parameters, float(value) if is_finite else math.inf, derivative, gradient)

    def hessian_product(self, parameters: Array, direction: Array) -> Array:
        """Return the Hessian (one of a semismooth J) times a direction, a covector."""
        self.hessian_products += 1
        return self._hessian_product(self.objective, self.controls, parameters, direction)

    def riesz(self, covector: Array) -> Array:
        """Return the vector that represents a covector."""
        return _riesz(self.product, covector)

    def dot(self, first: Array, second: Array) -> float:
        """Return the inner product of two vectors."""
        return float(_dot(self.product, first, second))

    def project(self, parameters: Array) -> Array:
        """Return the nearest point within the bounds."""
        return parameters if self.bounds is None else jnp.clip(parameters, *self.bounds)

    def gradient_norm(self, point: Point) -> float:
        """Return the stationarity measure: |G|, with bounds |p - P(p - G)|."""
        if self.bounds is None:
            return math.sqrt(max(float(jnp.vdot(point.derivative, point.gradient)), 0.0))
        step = point.parameters - self.project(point.parameters - point.gradient)
        return math.sqrt(self.dot(step, step))


def value_and_gradient(
    objective: Any, controls: Any, product: InnerProduct, parameters: Array
) -> tuple[Array, Array, Array, Array]:
    """Return value, derivative, gradient, and whether all of them are finite; traceable."""
    value, derivative = jax.value_and_grad(lambda p: objective(controls(p)))(parameters)
    gradient = product.riesz(derivative)
    is_finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))
    return value, derivative, gradient, is_finite


def _hessian_product(objective, controls, parameters, direction):
    derivative = jax.grad(lambda p: objective(controls(p)))
    return jax.jvp(derivative, (parameters,), (direction,))[1]


@jax.jit
def _dot(product, first, second):
    return product.dot(first, second)


@jax.jit
def _riesz(product, covector):
    return product.riesz(covector)


# Module-level, so that a second optimisation of the same problem compiles nothing.
_evaluate_compiled = jax.jit(value_and_gradient)
_hessian_product_compiled = jax.jit(_hessian_product)
