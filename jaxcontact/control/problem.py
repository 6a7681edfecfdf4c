"""The reduced problem as a method sees it: evaluate, multiply by the Hessian, project.

    minimise J(E p)  over lower <= p <= upper

with a linear map E from parameters to controls (the identity if there is none) and the inner
product of the parameters. A point carries the derivative as a covector and its Riesz
representative, so that norms and slopes of gradients cost no product with the mass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol, cast, runtime_checkable

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

from jaxcontact.control.bounds import Bounds, BoundsLike, make_bounds
from jaxcontact.control.inner_product import L2, InnerProduct, lumped_l2
from jaxcontact.motion.checks import SolveError
from jaxcontact.system.system import System
from jaxcontact.transforms.options import check_option
from jaxcontact.transforms.trees import as_partial

#: A predicted decrease below this times the value is rounding error.
ROUNDING = 1e-16


@runtime_checkable
class ControlMap(Protocol):
    """Linear map from parameters to controls, a pytree; for instance an `Actuator`."""

    def __call__(self, parameters: Array) -> Array:
        """Return the control (T, N, d) or (T, n)."""
        ...

    def inner_product(
        self, system: System, dt: float | Array, *, is_lumped: bool = False
    ) -> InnerProduct:
        """Return the inner product of the parameters, for bounds a diagonal one."""
        ...


class Point(NamedTuple):
    """A point with value and gradient."""

    parameters: Array
    """The point p."""

    value: Array
    """J(E p), a scalar; infinite where value or gradient are not finite."""

    derivative: Array
    """dJ/dp, entry by entry."""

    gradient: Array
    """Riesz representative of the derivative."""


@dataclass
class Counts:
    """What was evaluated so far; under a trace, what the program contains."""

    evaluations: int = 0
    """Evaluations of value and gradient."""

    hessian_products: int = 0
    """Products with the Hessian; to linearise the motion for them counts as one."""

    rows: int = 0
    """Derivatives of the gap of one pair in one step."""

    motions: int = 0
    """Simulations without a derivative."""


@dataclass(frozen=True)
class Problem:
    """Objective, control map, inner product and bounds; on the host and under a trace."""

    objective: Callable[[Array], Array]
    """Maps a control to a scalar. A `jax.tree_util.Partial` of arrays is compiled with its arrays
    as arguments; any other function runs as it is, since compiling it would bake the arrays it
    holds into the program."""

    product: InnerProduct
    """Inner product of the parameters."""

    controls: Callable[[Array], Array]
    """Linear map from parameters to controls, a pytree."""

    bounds: Bounds
    """Lower and upper bounds of the parameters, or None."""

    counts: Counts = field(default_factory=Counts)
    """Work so far; a problem that is made from this one by `dataclasses.replace` adds to it."""

    @classmethod
    def of(
        cls,
        objective: Callable[[Array], Array],
        start: Array,
        *,
        system: System | None = None,
        dt: float | Array | None = None,
        bounds: BoundsLike | None = None,
        controls: ControlMap | Callable[[Array], Array] | None = None,
        inner_product: InnerProduct | None = None,
    ) -> Problem:
        """Return the problem that the arguments of `optimize` state, or say what is wrong.

        Raises:
            ValueError: if an argument is missing or is not what it should be.
        """
        if not callable(objective):
            raise ValueError(
                f"the objective must be a function of a control, got {type(objective).__name__}"
            )
        if not jnp.issubdtype(start.dtype, jnp.floating):
            raise ValueError(
                f"the start must hold floating point numbers, got {start.dtype}; write "
                "jnp.asarray(u0, float)"
            )
        product = inner_product
        if product is None:
            if bounds is not None and controls is None and start.ndim == 2:
                raise ValueError(
                    "bounds are those of nodal values, and a control in unknowns (T, n) has none; "
                    "optimise the control (T, N, d), or hand over an inner_product"
                )
            product = _product_of(system, dt, controls, is_bounded=bounds is not None)
        check_option("inner_product", product, InnerProduct, "Euclidean()")
        return cls(
            objective=as_partial(objective),
            product=product,
            controls=Partial(identity) if controls is None else controls,
            bounds=make_bounds(bounds, start),
        )

    @cached_property
    def is_compiled(self) -> bool:
        """Whether all parts are pytrees, so that their arrays can be arguments of jit."""
        return not any(
            jax.tree_util.all_leaves([part])
            for part in (self.objective, self.controls, self.product)
        )

    def evaluate(self, parameters: Array) -> Point:
        """Return the point; its value is infinite if a time step fails or if it is not finite."""
        self.counts.evaluations += 1
        evaluate = _evaluate_compiled if self.is_compiled else _evaluate
        try:
            value, derivative, gradient, is_finite = evaluate(
                self.objective, self.controls, self.product, parameters
            )
        except SolveError:
            nothing = jnp.full_like(parameters, jnp.nan)
            return Point(parameters, jnp.full((), jnp.inf, parameters.dtype), nothing, nothing)
        value = jnp.where(is_finite, value, jnp.inf)
        return Point(parameters, value, derivative, gradient)

    def hessian(self, parameters: Array) -> Callable[[Array], Array]:
        """Return the Hessian (one of a semismooth J): maps a direction to a covector.

        The motion is linearised once, so that a product is one sweep forward and one back.
        """
        self.counts.hessian_products += 1
        linearize = _linearized_gradient_compiled if self.is_compiled else _linearized_gradient
        linear = linearize(self.objective, self.controls, parameters)
        apply = _apply_compiled if self.is_compiled else _apply

        def product(direction: Array) -> Array:
            self.counts.hessian_products += 1
            return apply(linear, direction)

        return product

    def riesz(self, covector: Array) -> Array:
        """Return the vector that represents a covector."""
        return _riesz(self.product, covector)

    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two vectors, a scalar."""
        return _dot(self.product, first, second)

    def project(self, parameters: Array) -> Array:
        """Return the nearest point within the bounds."""
        return parameters if self.bounds is None else jnp.clip(parameters, *self.bounds)

    def gradient_norm(self, point: Point) -> Array:
        """Return the stationarity measure, a scalar: |G|, with bounds |p - P(p - G)|."""
        if self.bounds is None:
            return jnp.sqrt(jnp.maximum(jnp.vdot(point.derivative, point.gradient), 0.0))
        step = point.parameters - self.project(point.parameters - point.gradient)
        return jnp.sqrt(self.dot(step, step))


def identity(parameters: Array) -> Array:
    """Return the control itself."""
    return parameters


def _product_of(
    system: System | None,
    dt: float | Array | None,
    controls: ControlMap | Callable[[Array], Array] | None,
    *,
    is_bounded: bool,
) -> InnerProduct:
    """Return the inner product that follows from the scene and the control map."""
    if system is None or dt is None:
        raise ValueError(
            "an optimisation needs system= and dt= to measure steps of a control in, or "
            "inner_product=jc.Euclidean() for parameters that are no control"
        )
    if controls is None:
        return lumped_l2(system, dt) if is_bounded else L2(system, dt)
    check_option("controls", controls, ControlMap, "actuator(system, steps)")
    return cast(ControlMap, controls).inner_product(system, dt, is_lumped=is_bounded)


def _evaluate(objective, controls, product, parameters):
    """Return value, derivative, gradient, and whether all of them are finite."""
    value, derivative = jax.value_and_grad(lambda p: objective(controls(p)))(parameters)
    gradient = product.riesz(derivative)
    is_finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))
    return value, derivative, gradient, is_finite


def _linearized_gradient(objective, controls, parameters):
    return jax.linearize(jax.grad(lambda p: objective(controls(p))), parameters)[1]


def _apply(linear, direction):
    return linear(direction)


@jax.jit
def _dot(product, first, second):
    return product.dot(first, second)


@jax.jit
def _riesz(product, covector):
    return product.riesz(covector)


# Module-level, so that a second optimisation of the same problem compiles nothing.
_evaluate_compiled = jax.jit(_evaluate)
_linearized_gradient_compiled = jax.jit(_linearized_gradient)
_apply_compiled = jax.jit(_apply)
