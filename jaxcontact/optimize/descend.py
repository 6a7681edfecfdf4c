"""Optimisation as one pure function: many starts, or many problems, under `jax.vmap`.

`optimize` decides between its steps on the host: it can be interrupted, restarted and watched.
Here the same steps run in `lax.scan`, so that the whole optimisation can be transformed. Methods
that can do this have a `traced_step`, equal to their `step` up to rounding; a test holds the two
together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.control.inner_product import InnerProduct
from jaxcontact.control.problem import Point, identity, select, value_and_gradient
from jaxcontact.optimize.driver import check_method, choose_product, make_bounds
from jaxcontact.optimize.lbfgs import LBFGS
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Descent:
    """The best control that was found; under vmap with a leading axis of starts."""

    control: Array = field(repr=False)
    """The control with the lowest value that was met, (T, N, d)."""

    parameters: Array = field(repr=False)
    """What was optimised: the control itself, or the argument of the map `controls`."""

    value: Array
    """Value of the objective at the control, scalar; infinite if it was never finite."""

    values: Array = field(repr=False)
    """Values of the iterates, (K+1,); entry 0 is the start."""

    gradient_norms: Array = field(repr=False)
    """Norms of the gradient, (K+1,); with bounds of u - P(u - G)."""

    iterations: Array
    """Iterations until the method found no better point, scalar int32; else K."""


class TracedProblem(NamedTuple):
    """The reduced problem as a traced step sees it."""

    objective: Callable[[Array], Array]
    """Maps a control to a scalar."""

    controls: Callable[[Array], Array]
    """Linear map from parameters to controls."""

    product: InnerProduct
    """Inner product of the parameters."""

    bounds: tuple[Array, Array] | None
    """Lower and upper bounds of the parameters."""

    def evaluate(self, parameters: Array) -> Point:
        """Return value and gradient; the value is infinite if anything is not finite."""
        value, derivative, gradient, is_finite = value_and_gradient(
            self.objective, self.controls, self.product, parameters
        )
        return Point(parameters, jnp.where(is_finite, value, jnp.inf), derivative, gradient)

    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two vectors."""
        return self.product.dot(first, second)

    def project(self, parameters: Array) -> Array:
        """Return the nearest point within the bounds."""
        return parameters if self.bounds is None else jnp.clip(parameters, *self.bounds)

    def gradient_norm(self, point: Point) -> Array:
        """Return the stationarity measure: |G|, with bounds |p - P(p - G)|."""
        if self.bounds is None:
            return jnp.sqrt(jnp.maximum(jnp.vdot(point.derivative, point.gradient), 0.0))
        step = point.parameters - self.project(point.parameters - point.gradient)
        return jnp.sqrt(self.dot(step, step))


@in_full_precision
def descend(
    objective: Callable[[Array], Array],
    u0: Array,
    *,
    method: Any = None,
    system: System | None = None,
    dt: float | Array | None = None,
    bounds: tuple[Any, Any] | None = None,
    controls: Any = None,
    inner_product: InnerProduct | None = None,
    iterations: int = 200,
) -> Descent:
    """Minimise an objective as `optimize` does, as one function that JAX can transform.

    For many starts, with whatever holds the stepper as an argument of the compiled function::

        @jax.jit
        def best_of(problem, starts):
            def one(u):
                return jc.descend(problem.objective, u, system=problem.system, dt=problem.dt)

            return jax.vmap(one)(starts)

    There is no early stop: all starts make the same number of iterations, and one whose method
    finds no better point stays where it is. A start that is not finite gives an infinite value.

    Args:
        objective: maps a control (T, N, d) to a scalar, differentiable by JAX.
        u0: control to start from, (T, N, d), or the argument of the map `controls`.
        method: `SteepestDescent`, `LBFGS` or `Optax`, default `LBFGS()`. `NewtonCG` and `Homotopy`
            decide on the host and work in `optimize` only.
        system: see `optimize`.
        dt: see `optimize`.
        bounds: see `optimize`.
        controls: see `optimize`.
        inner_product: see `optimize`.
        iterations: number of iterations K.

    Returns:
        The best control with the values of all iterations.

    Raises:
        ValueError: if the method has no traced step, or arguments do not fit, see `optimize`.
    """
    method = LBFGS() if method is None else method
    check_method(method)
    if not hasattr(method, "traced_step"):
        raise ValueError(
            f"{type(method).__name__} decides on the host and cannot be traced; take "
            "jc.SteepestDescent(), jc.LBFGS() or jc.Optax(...), or call jc.optimize for each start"
        )
    start = jnp.asarray(u0)
    problem = TracedProblem(
        objective,
        identity if controls is None else controls,
        choose_product(inner_product, controls, system, dt, is_bounded=bounds is not None),
        make_bounds(bounds, start),
    )

    def advance(carry, _):
        state, best, is_running, count = carry
        new, is_found = method.traced_step(problem, state)
        is_found = is_found & is_running
        state = select(is_found, new, state)
        best = select(state.point.value < best.value, state.point, best)
        record = state.point.value, problem.gradient_norm(state.point)
        return (state, best, is_found, count + is_found), record

    first = problem.evaluate(problem.project(start))
    state = jax.tree.map(lambda leaf: _as_array(leaf, start.dtype), method.init(problem, first))
    (_, best, _, count), (values, norms) = jax.lax.scan(
        advance, (state, first, jnp.bool_(True), jnp.int32(0)), length=iterations
    )
    return Descent(
        control=problem.controls(best.parameters),
        parameters=best.parameters,
        value=best.value,
        values=jnp.concatenate([first.value[None], values]),
        gradient_norms=jnp.concatenate([problem.gradient_norm(first)[None], norms]),
        iterations=count,
    )


def _as_array(leaf: Any, dtype: Any) -> Array:
    """Return a leaf of a state as an array whose type does not change from step to step."""
    if isinstance(leaf, float):
        return jnp.asarray(leaf, dtype)
    return jnp.asarray(leaf, jnp.int32) if isinstance(leaf, int) else jnp.asarray(leaf)
