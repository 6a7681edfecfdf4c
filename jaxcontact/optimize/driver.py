"""The loop around every optimisation method: record, report, stop, return the best."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import astuple, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.control.bounds import BoundsLike
from jaxcontact.control.inner_product import InnerProduct
from jaxcontact.control.problem import ControlMap, Point, Problem
from jaxcontact.optimize.certificate import Stationarity, certify, motion_of
from jaxcontact.optimize.lbfgs import LBFGS
from jaxcontact.optimize.method import Ending, Method, MethodState
from jaxcontact.optimize.progress import ProgressBar, progress_bar
from jaxcontact.optimize.result import History, Result, rebuild_state
from jaxcontact.system.system import System
from jaxcontact.transforms.options import check_option
from jaxcontact.transforms.precision import in_full_precision

#: Why there is no certificate: the objective is a function alone, or the run did not end by itself.
NO_MOTION = (
    "the objective does not tell its motion; hand over a bound method of a pytree with a method "
    "simulate, or call jc.stationarity with motion="
)
UNFINISHED = "the run ended before the certificate; call jc.stationarity"

#: Called with iteration, control, value and gradient norm.
Callback = Callable[[int, Array, float, float], None]


class Row(NamedTuple):
    """One entry of each column of a `History`."""

    value: float
    gradient_norm: float
    evaluations: int
    hessian_products: int
    gap_rows: int
    simulations: int
    seconds: float


class Run(NamedTuple):
    """The optimisation so far; replaced as a whole: an interrupt meets no half of an iteration."""

    state: MethodState
    """State of the method."""

    best: Point
    """Point with the lowest value; the derivatives are void if it comes from a file."""

    rows: tuple[Row, ...]
    """The history; row 0 is the start."""

    def advanced(self, state: MethodState, row: Row) -> Run:
        """Return the run with one more iteration."""
        best = state.point if state.point.value < self.best.value else self.best
        return Run(state, best, (*self.rows, row))

    def is_below(self, tolerance: float) -> bool:
        """Return whether the gradient norm has fallen to this fraction of the first one."""
        return self.rows[-1].gradient_norm <= tolerance * self.rows[0].gradient_norm


@in_full_precision
def optimize(
    objective: Callable[[Array], Array],
    u0: Array | Result,
    *,
    method: Method | None = None,
    system: System | None = None,
    dt: float | Array | None = None,
    bounds: BoundsLike | None = None,
    controls: ControlMap | Callable[[Array], Array] | None = None,
    inner_product: InnerProduct | None = None,
    iterations: int = 200,
    tolerance: float = 0.0,
    progress: bool = False,
    callback: Callback | None = None,
) -> Result:
    """Minimise an objective over controls in the inner product of L2(0,T; L2).

    The result is never worse than the start (projected to the bounds, if there are any). Once the
    start is evaluated no work is lost: Ctrl-C ends the run and returns the best iterate so far,
    and an error, for instance in the callback, carries the same as its attribute `result`.

    Args:
        objective: maps a control (T, N, d), or in unknowns (T, n), to a scalar, differentiable by
            JAX. A bound method of a pytree such as `problem.objective`, or a
            `jax.tree_util.Partial` of arrays, is compiled as a whole; any other function runs as
            it is.
        u0: control to start from, (T, N, d) or (T, n), or the argument of the map `controls`; or a
            `Result` of the same method, which is continued as if it had never stopped.
        method: the method; default `LBFGS()`.
        system: the discretised scene, which defines the inner product.
        dt: length of a time step, [s].
        bounds: lower and upper bound of what is optimised, numbers or arrays that broadcast to
            it; infinite is none. The inner product is then the lumped one.
        controls: linear map from parameters to controls, for instance an `Actuator`.
        inner_product: used instead of the one of system and dt, see `InnerProduct`.
        iterations: number of (further) iterations.
        tolerance: stop when the gradient norm is at most this times the one at the start.
        progress: show a progress bar.
        callback: called after every iteration, and at the start, with the iteration, the control
            (T, N, d), the value and the gradient norm.

    Returns:
        The best control with its value, the history, and why the run ended, see `Ending`; with a
        certificate of strong stationarity, or why there is none.

    Raises:
        ValueError: if the objective is not finite at the start, shapes do not fit, bounds cross,
            or a result cannot be continued.
        ImportError: if a progress bar is asked for and the extra `progress` is not installed.
    """
    method = choose_method(method)
    if iterations < 0:
        raise ValueError(f"iterations must not be negative, got {iterations}")
    start = jnp.asarray(u0.parameters if isinstance(u0, Result) else u0)
    start = jnp.asarray(start, start.dtype)  # a weak type would compile everything twice
    problem = Problem.of(
        objective,
        start,
        system=system,
        dt=dt,
        bounds=bounds,
        controls=controls,
        inner_product=inner_product,
    )
    begin = time.perf_counter()
    if isinstance(u0, Result):
        try:
            run = _continued(problem, method, start, u0)
        except KeyboardInterrupt:
            return replace(u0, status=Ending.INTERRUPTED)
        begin -= run.rows[-1].seconds
    else:
        run = _started(problem, method, start, begin)

    def result(status: Ending, certificate: Stationarity | str) -> Result:
        best = run.best
        return Result(
            control=problem.controls(best.parameters),
            parameters=best.parameters,
            value=float(best.value),
            history=History(*(np.array(column) for column in zip(*run.rows, strict=True))),
            status=status,
            stationarity=None if isinstance(certificate, str) else certificate,
            uncertified=certificate if isinstance(certificate, str) else "",
            method=type(method).__name__,
            state=run.state,
        )

    bar, status = None, Ending.STOPPED
    try:
        bar = progress_bar(iterations) if progress else None
        if not isinstance(u0, Result):
            _report(problem, run, bar, callback)
        for _ in range(iterations):
            if run.is_below(tolerance):
                break
            state, ending = method.step(problem, run.state)
            if ending is not None:
                status = Ending(ending)
                break
            run = run.advanced(state, _row(problem, state.point, begin))
            _report(problem, run, bar, callback)
        if run.is_below(tolerance):
            status = Ending.CONVERGED
    except KeyboardInterrupt:
        status = Ending.INTERRUPTED
    except Exception as error:
        vars(error)["result"] = result(Ending.FAILED, UNFINISHED)
        error.add_note("the optimisation so far is not lost: it is the attribute `result` of this")
        raise
    finally:
        if bar is not None:
            bar.close()
    try:
        return result(status, _certificate(problem, run.best.parameters))
    except KeyboardInterrupt:
        return result(Ending.INTERRUPTED, UNFINISHED)


def choose_method(method: Method | None) -> Method:
    """Return the method or the default.

    Raises:
        ValueError: if it is no method.
    """
    method = LBFGS() if method is None else method
    check_option("method", method, Method, "LBFGS()")
    return method


def _started(problem: Problem, method: Method, start: Array, begin: float) -> Run:
    """Return the run at its start."""
    point = problem.evaluate(problem.project(start))
    if not math.isfinite(point.value):
        raise ValueError(
            "the objective or its gradient is not finite at the start; check the control, the "
            "target and the time step with jc.simulate"
        )
    return Run(method.init(problem, point), point, (_row(problem, point, begin),))


def _continued(problem: Problem, method: Method, start: Array, earlier: Result) -> Run:
    """Return the run that ended with an earlier result."""
    unknown = Point(start, jnp.zeros((), start.dtype), start, start)
    state = rebuild_state(method.init(problem, unknown), earlier, type(method).__name__)
    point = state.point
    value, saved = float(problem.evaluate(point.parameters).value), float(point.value)
    # On another machine the value differs by rounding, which contact amplifies.
    if not abs(value - saved) <= 1e-6 * abs(saved) + np.finfo(float).tiny:
        raise ValueError(
            f"the saved result has the value {saved:.9g} where this objective has {value:.9g}: it "
            "belongs to another problem. To start from it, hand over result.parameters"
        )
    columns = (column.tolist() for column in astuple(earlier.history))
    rows = tuple(map(Row, *columns))
    # Checking the result was no work of the run.
    counts, last = problem.counts, rows[-1]
    counts.evaluations, counts.hessian_products = last.evaluations, last.hessian_products
    counts.rows, counts.motions = last.gap_rows, last.simulations
    best = unknown._replace(value=jnp.asarray(earlier.value, point.value.dtype))
    return Run(state, point if point.value < best.value else best, rows)


def _row(problem: Problem, point: Point, begin: float) -> Row:
    counts = problem.counts
    return Row(
        value=float(point.value),
        gradient_norm=float(problem.gradient_norm(point)),
        evaluations=counts.evaluations,
        hessian_products=counts.hessian_products,
        gap_rows=counts.rows,
        simulations=counts.motions,
        seconds=time.perf_counter() - begin,
    )


def _certificate(problem: Problem, parameters: Array) -> Stationarity | str:
    """Return the certificate, or why there cannot be one: it must not cost the result."""
    motion = motion_of(problem)
    if motion is None:
        return NO_MOTION
    try:
        return certify(problem, parameters, motion)
    except (ValueError, RuntimeError) as error:  # weak contact everywhere, a failed step, no memory
        return str(error) or type(error).__name__


def _report(problem: Problem, run: Run, bar: ProgressBar | None, callback: Callback | None) -> None:
    iteration, row = len(run.rows) - 1, run.rows[-1]
    if bar is not None:
        text = f"value {row.value:.6g}, gradient norm {row.gradient_norm:.2e}"
        bar.set_postfix_str(text, refresh=False)
        bar.update(1 if iteration else 0)
    if callback is not None:
        control = problem.controls(run.state.point.parameters)
        callback(iteration, control, row.value, row.gradient_norm)
