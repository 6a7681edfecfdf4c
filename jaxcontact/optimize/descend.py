"""Optimisation as one pure function: many starts, or many problems, under `jax.vmap`.

`optimize` decides between its steps on the host: it can be interrupted, restarted and watched.
Here the same steps run in `lax.scan`, so that the whole optimisation can be transformed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.control.bounds import BoundsLike
from jaxcontact.control.inner_product import InnerProduct
from jaxcontact.control.problem import ControlMap, Point, Problem
from jaxcontact.optimize.driver import choose_method
from jaxcontact.optimize.method import Method, MethodState
from jaxcontact.system.system import System
from jaxcontact.transforms.loops import select
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


class Course(NamedTuple):
    """What the scan over the iterations carries."""

    state: MethodState
    """State of the method."""

    best: Point
    """Point with the lowest value so far."""

    is_running: Array
    """Whether the method has always found a next point, bool."""

    iterations: Array
    """Number of iterations so far, int32."""


@in_full_precision
def descend(
    objective: Callable[[Array], Array],
    u0: Array,
    *,
    method: Method | None = None,
    system: System | None = None,
    dt: float | Array | None = None,
    bounds: BoundsLike | None = None,
    controls: ControlMap | Callable[[Array], Array] | None = None,
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
        ValueError: if the method cannot be traced, or arguments do not fit, see `optimize`.
    """
    method = choose_method(method)
    if not method.is_traceable:
        raise ValueError(
            f"{type(method).__name__} decides on the host and cannot be traced; take "
            "jc.SteepestDescent(), jc.LBFGS() or jc.Optax(...), or call jc.optimize for each start"
        )
    start = jnp.asarray(u0)
    problem = Problem.of(
        objective,
        start,
        system=system,
        dt=dt,
        bounds=bounds,
        controls=controls,
        inner_product=inner_product,
    )

    def advance(course: Course, _: None) -> tuple[Course, tuple[Array, Array]]:
        new, ending = method.step(problem, course.state)
        is_found = course.is_running & ~cast(Array, ending)
        state = select(is_found, new, course.state)
        point = state.point
        best = select(point.value < course.best.value, point, course.best)
        following = Course(state, best, is_found, course.iterations + is_found)
        return following, (point.value, problem.gradient_norm(point))

    first = problem.evaluate(problem.project(start))
    state = jax.tree.map(jnp.asarray, method.init(problem, first))
    course, (values, norms) = jax.lax.scan(
        advance, Course(state, first, jnp.bool_(True), jnp.int32(0)), length=iterations
    )
    best = course.best
    return Descent(
        control=problem.controls(best.parameters),
        parameters=best.parameters,
        value=best.value,
        values=jnp.concatenate([first.value[None], values]),
        gradient_norms=jnp.concatenate([problem.gradient_norm(first)[None], norms]),
        iterations=course.iterations,
    )
