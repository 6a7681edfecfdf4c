"""The loop around every optimisation method: record, report, stop, return the best."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.control.inner_product import L2, InnerProduct, lumped_l2
from jaxcontact.control.problem import Point, Problem
from jaxcontact.optimize.certificate import Stationarity, certify, motion_of
from jaxcontact.optimize.lbfgs import LBFGS
from jaxcontact.optimize.progress import progress_bar
from jaxcontact.optimize.result import History, Result, rebuild_state
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision


class Method(Protocol):
    """An optimisation method: an option object with a pure step.

    A state is a tuple with a field `point`; its leaves are arrays and Python numbers whose shapes
    and types never change, so that it can be kept in a file.
    """

    def init(self, problem: Problem, point: Point) -> Any:
        """Return the state at the start."""
        ...

    def step(self, problem: Problem, state: Any) -> tuple[Any, str | None]:
        """Return the next state, and in words why it is the last one or None."""
        ...


@in_full_precision
def optimize(
    objective: Callable[[Array], Array],
    u0: Array | Result,
    *,
    method: Method | None = None,
    system: System | None = None,
    dt: float | Array | None = None,
    bounds: tuple[Any, Any] | None = None,
    controls: Any = None,
    inner_product: InnerProduct | None = None,
    iterations: int = 200,
    tolerance: float = 0.0,
    progress: bool = False,
    callback: Callable[[int, Array, float, float], None] | None = None,
) -> Result:
    """Minimise an objective over controls in the inner product of L2(0,T; L2).

    Ctrl-C ends the run and returns the best iterate so far. The result is never worse than the
    start (projected to the bounds, if there are any).

    Args:
        objective: maps a control (T, N, d) to a scalar, differentiable by JAX. A bound method of
            a pytree such as `problem.objective`, or a `jax.tree_util.Partial` of arrays, is
            compiled as a whole; any other function runs as it is.
        u0: control to start from, (T, N, d), or the argument of the map `controls`; or a
            `Result` of the same method, which is continued as if it had never stopped.
        method: the method; default `LBFGS()`.
        system: the discretised scene, which defines the inner product.
        dt: length of a time step, [s].
        bounds: lower and upper bound of what is optimised, numbers or arrays that broadcast to
            it; infinite is none. The inner product is then the lumped one.
        controls: linear map from parameters to controls, for instance an `Actuator`.
        inner_product: used instead of the one of system and dt, see `InnerProduct`.
        iterations: number of (further) iterations.
        tolerance: stop when the gradient norm is below this times the one at the start.
        progress: show a progress bar.
        callback: called after every iteration, and at the start, with the iteration, the control
            (T, N, d), the value and the gradient norm.

    Returns:
        The best control with its value, the history, and in words why the run ended.

    Raises:
        ValueError: if the objective is not finite at the start, shapes do not fit, bounds cross,
            or a result cannot be continued.
        ImportError: if a progress bar is asked for and the extra `progress` is not installed.
    """
    method = LBFGS() if method is None else method
    check_method(method)
    if iterations < 0:
        raise ValueError(f"iterations must not be negative, got {iterations}")
    start = jnp.asarray(u0.parameters if isinstance(u0, Result) else u0)
    start = jnp.asarray(start, start.dtype)  # a weak type would compile everything twice
    problem = state_problem(objective, start, system, dt, bounds, controls, inner_product)
    name = type(method).__name__
    if isinstance(u0, Result):
        unknown = Point(start, 0.0, start, start)
        state = rebuild_state(method.init(problem, unknown), u0, name)
        _check_same_problem(problem, state.point)
        recorder = Recorder(problem, u0.history)
        best = min(unknown._replace(value=u0.value), state.point, key=_value)
    else:
        best = problem.evaluate(problem.project(start))
        if not math.isfinite(best.value):
            raise ValueError(
                "the objective or its gradient is not finite at the start; check the control, the "
                "target and the time step with jc.simulate"
            )
        state = method.init(problem, best)
        recorder = Recorder(problem)

    bar = progress_bar(iterations) if progress else None
    status = f"stopped after {iterations} iterations"
    try:
        if not recorder.rows:
            recorder.add(state.point)
            _report(recorder, problem, state.point, bar, callback)
        for _ in range(iterations):
            if recorder.is_below(tolerance):
                break
            new_state, failure = method.step(problem, state)
            if failure is not None:
                status = failure
                break
            best = min(best, new_state.point, key=_value)
            recorder.add(new_state.point)
            state = new_state
            _report(recorder, problem, state.point, bar, callback)
        if recorder.is_below(tolerance):
            share = f"at most {tolerance:g} of the first one" if tolerance else "zero"
            status = f"converged: the gradient norm is {share}"
    except KeyboardInterrupt:
        status = f"interrupted after {recorder.iterations} iterations; this is the best one"
    finally:
        if bar is not None:
            bar.close()
    return Result(
        control=problem.controls(best.parameters),
        parameters=best.parameters,
        value=best.value,
        history=recorder.history(),
        status=status,
        stationarity=_certificate(problem, best.parameters),
        method=name,
        state=state,
    )


def _check_same_problem(problem: Problem, point: Point) -> None:
    """Raise a ValueError if the objective has another value at a point than was saved."""
    value = problem.evaluate(point.parameters).value
    # On another machine the value differs by rounding, which contact amplifies.
    if not abs(value - point.value) <= 1e-6 * abs(point.value) + np.finfo(float).tiny:
        raise ValueError(
            f"the saved result has the value {point.value:.9g} where this objective has "
            f"{value:.9g}: it belongs to another problem. To start from it, hand over "
            "result.parameters"
        )


def _certificate(problem: Problem, parameters: Array) -> Stationarity | None:
    """Return the certificate, or None where there cannot be one: it must not cost the result."""
    motion = motion_of(problem)
    try:
        return None if motion is None else certify(problem, parameters, motion)
    except ValueError:
        return None


def state_problem(
    objective: Callable[[Array], Array],
    start: Array,
    system: System | None,
    dt: float | Array | None,
    bounds: tuple[Any, Any] | None,
    controls: Any,
    inner_product: InnerProduct | None,
) -> Problem:
    """Return the problem that the arguments of `optimize` state."""
    product = choose_product(inner_product, controls, system, dt, is_bounded=bounds is not None)
    return Problem(objective, product, controls=controls, bounds=make_bounds(bounds, start))


def _value(point: Point) -> float:
    return point.value


class Recorder:
    """Collects the history, also over a restart."""

    def __init__(self, problem: Problem, earlier: History | None = None):
        """Start a history, or go on with an earlier one."""
        self.problem = problem
        self.rows: list[tuple] = []
        if earlier is not None:
            columns = [getattr(earlier, field.name).tolist() for field in fields(History)]
            self.rows = list(zip(*columns, strict=True))
            problem.evaluations, problem.hessian_products = self.rows[-1][2:4]
        self.begin = time.perf_counter() - (self.rows[-1][-1] if self.rows else 0.0)

    @property
    def iterations(self) -> int:
        """Number of finished iterations."""
        return len(self.rows) - 1

    def add(self, point: Point) -> None:
        """Record an iteration."""
        problem = self.problem
        norm, seconds = problem.gradient_norm(point), time.perf_counter() - self.begin
        self.rows.append(
            (point.value, norm, problem.evaluations, problem.hessian_products, seconds)
        )

    def is_below(self, tolerance: float) -> bool:
        """Return whether the gradient norm has fallen to this fraction of the first one."""
        return self.rows[-1][1] <= tolerance * self.rows[0][1]

    def history(self) -> History:
        """Return the history so far."""
        return History(*(np.array(column) for column in zip(*self.rows, strict=True)))


def _report(recorder: Recorder, problem: Problem, point: Point, bar: Any, callback: Any) -> None:
    value, norm = recorder.rows[-1][:2]
    if bar is not None:
        bar.set_postfix_str(f"value {value:.6g}, gradient norm {norm:.2e}", refresh=False)
        bar.update(1 if recorder.iterations else 0)
    if callback is not None:
        callback(recorder.iterations, problem.controls(point.parameters), value, norm)


def check_method(method: Any) -> None:
    """Raise a ValueError if a method is a class or a name instead of an object."""
    if isinstance(method, type | str) or not hasattr(method, "step"):
        name = method.__name__ if isinstance(method, type) else "LBFGS"
        raise ValueError(f"method must be an object, such as jc.{name}(), got {method!r}")


def choose_product(
    product: InnerProduct | None, controls: Any, system: Any, dt: Any, *, is_bounded: bool
) -> InnerProduct:
    """Return the inner product that the arguments of `optimize` name."""
    if product is not None:
        return product
    if system is None or dt is None:
        raise ValueError(
            "optimize needs system= and dt=, or an inner_product=, to measure steps in"
        )
    if controls is not None:
        return controls.inner_product(system, dt, is_lumped=is_bounded)
    return lumped_l2(system, dt) if is_bounded else L2(system, dt)


def make_bounds(bounds: tuple[Any, Any] | None, start: Array) -> tuple[Array, Array] | None:
    """Return both bounds in the shape of the start."""
    if bounds is None:
        return None
    if len(bounds) != 2:
        raise ValueError("bounds must be a pair (lower, upper) of numbers or arrays")
    for bound in bounds:
        shape = np.shape(bound)
        fits = all(n in (1, m) for n, m in zip(shape[::-1], start.shape[::-1], strict=False))
        if len(shape) > start.ndim or not fits:
            raise ValueError(
                f"a bound of shape {shape} does not fit what is optimised, {start.shape}"
            )
    if not any(isinstance(bound, Tracer) for bound in bounds):
        n_crossed = int(np.sum(~(np.asarray(bounds[0]) <= np.asarray(bounds[1]))))
        if n_crossed:
            raise ValueError(f"{n_crossed} lower bounds are above their upper bounds or NaN")
    lower, upper = (jnp.broadcast_to(jnp.asarray(b, start.dtype), start.shape) for b in bounds)
    return lower, upper
