"""Homotopy in relaxed contact: a smooth path to a strongly stationary control.

    minimise J_kappa(u),    J_kappa: the objective with p_i g_i = kappa instead of p_i g_i = 0,

by trust-region Newton-CG for a decreasing sequence of kappa, each started at the last minimiser.
J_kappa is smooth, its Hessian products are exact, and on weak contact its adjoint tends to the one
with the right share of the multiplier: the path leads to strong stationarity, where methods for
the exact problem stall at kinks. Its gaps tell which pairs are weak there, and an exact finish does
the rest (`finish.py`), so the first problems are solved loosely. Bounds have a barrier that
vanishes with kappa (`interior.py`). Source: MATH.md 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import RelaxedContact
from jaxcontact.control.problem import Point, Problem
from jaxcontact.motion.stepper import with_contact
from jaxcontact.optimize.certificate import motion_of
from jaxcontact.optimize.finish import ExactFinish
from jaxcontact.optimize.interior import Duals, Interior, snapped, well_inside
from jaxcontact.optimize.method import Ending
from jaxcontact.optimize.newton_cg import NewtonCG, NewtonCGState
from jaxcontact.optimize.pattern import identify
from jaxcontact.optimize.trust_region import conjugate_gradient_path

#: The first relaxation changes the objective at the start by about this fraction.
FIRST_CHANGE = 0.15

#: Relative residual and number of products of CG for the last digits of a relaxed problem.
LAST_FORCING, MAX_LAST_PRODUCTS = 1e-2, 300

#: Trials for the first kappa.
MAX_TRIALS = 40


#: Accuracy of the first relaxed problems, relative to the gradient at the start: more of it does
#: not help the next one, and not the finish.
LOOSE = (3e-2, 1e-3, 1e-4, 1e-5, 1e-6)

#: The trust region of a new level is at least this times the norm of the control.
LEAST_RADIUS = 1e-3

#: The first level from which the path is extrapolated.
FIRST_EXTRAPOLATED = 2


class HomotopyState(NamedTuple):
    """Point on the path; level 0 is the start."""

    point: Point
    """Value and gradient of the exact problem at the current iterate."""

    level: int
    """Number of relaxed problems that were solved."""

    kappa: float
    """kappa of the last relaxed problem, [J]; zero before the first."""

    radius: float
    """Radius of the trust region."""

    first_norm: float
    """Gradient norm of the exact problem at the start, bounds aside; of the relaxed one if zero."""

    norm: float
    """Gradient norm of the last relaxed problem at its solution."""

    relaxed: Array
    """Parameters of the last relaxed minimiser."""

    before: Array
    """Parameters of the relaxed minimiser before that."""

    duals: Duals | None = None
    """Multipliers of the bounds at the last relaxed minimiser, or None without bounds."""

    finish_level: int = 0
    """The level after which the finish was tried last."""

    is_certified: bool = False
    """Whether the finish has reached its tolerance with all signs right."""


@dataclass(frozen=True)
class Homotopy:
    """Newton-CG on relaxed contact with kappa -> 0, and an exact finish: for minimisers at kinks.

    One iteration of `optimize` is one kappa, or one finish; values in the history are those of the
    exact problem. It ends as `Ending.CERTIFIED` at a control that is strongly stationary to
    rounding: see `Stationarity.is_strong` for what that proves.

    The contact solver is exchanged inside the objective, so the objective must be a pytree that
    holds the stepper: a bound method of a registered dataclass, such as
    `scenes.half_disc_control().objective`, or `jax.tree_util.Partial(function, stepper)`. A
    change of kappa compiles nothing.
    """

    first_kappa: float | None = None
    """First kappa, [J]; None looks for one that changes the objective at the start by 15 %."""

    reduction: float = 0.1
    """Factor from one kappa to the next."""

    levels: int = 13
    """Most kappas. Without the finish, the error is about the root of the last one."""

    tolerance: float = 1e-9
    """Each relaxed problem is solved to this times the gradient norm at the start; with a finish
    the first ones less accurately."""

    finish: ExactFinish | None = field(default_factory=ExactFinish)
    """How the path ends in an exactly stationary control; None follows it to the last kappa. There
    is no finish if the objective does not tell its motion."""

    finish_from: int = 6
    """Number of relaxed problems before the finish is tried."""

    max_steps: int = 100
    """Newton steps per kappa."""

    newton: NewtonCG = field(default_factory=lambda: NewtonCG(max_products=300))
    """Solver of the relaxed problems."""

    is_traceable: ClassVar[bool] = False
    """Each relaxed problem takes as many steps as it needs, decided on the host."""

    def init(self, problem: Problem, point: Point) -> HomotopyState:
        """Return the state at the start."""
        norm = math.sqrt(max(float(jnp.vdot(point.derivative, point.gradient)), 0.0))
        start, duals = point.parameters, None
        if problem.bounds is not None:
            start = well_inside(problem.bounds, start)
            duals = Duals(0.0, start, start, 0.0)
        return HomotopyState(point, 0, 0.0, math.inf, norm, norm, start, start, duals)

    def step(self, problem: Problem, state: HomotopyState) -> tuple[HomotopyState, Ending | None]:
        """Return the state after the next kappa or the finish, or why it is the last."""
        if state.is_certified:
            return state, Ending.CERTIFIED
        motion = motion_of(problem)
        first = max(self.finish_from, 2)  # two levels tell where the path leads
        finish = self.finish if self.levels >= first else None
        if finish is not None and motion is not None:
            if state.level >= max(first, state.finish_level + 1):
                return self._finished(problem, state, finish, motion), None
        if state.level == self.levels:
            return state, Ending.RELAXED
        return self._next_level(problem, state, finish is not None and motion is not None)

    def _next_level(
        self, problem: Problem, state: HomotopyState, is_loose: bool
    ) -> tuple[HomotopyState, Ending | None]:
        """Return the state after the next kappa."""
        kappa = self.reduction * state.kappa if state.level else self.first_kappa
        if kappa is None:
            kappa, relaxed, start = _first_relaxation(problem, state)
        else:
            relaxed = _relax(problem, kappa)
            start = relaxed.evaluate(state.relaxed)
        if state.duals is not None:
            duals = state.duals._replace(mu=self.reduction * state.duals.mu)
            relaxed, start = (
                Interior.after(relaxed, start, duals)
                if state.level
                else Interior.of(relaxed, start)
            )
        if not math.isfinite(start.value):
            return state, Ending.RELAXED_NOT_FINITE
        if state.level >= FIRST_EXTRAPOLATED:
            start = _extrapolated(relaxed, state, kappa, self.reduction, start)
            relaxed, start = _centred(relaxed, start)
        # Before touch the exact gradient can be zero where the relaxed one is not.
        first_norm = state.first_norm or float(relaxed.gradient_norm(start))
        tolerance = self.tolerance
        if is_loose:
            tolerance = max(tolerance, LOOSE[min(state.level, len(LOOSE) - 1)])
        norm = math.sqrt(max(float(problem.dot(start.parameters, start.parameters)), 0.0))
        inner = NewtonCGState(start, max(state.radius, LEAST_RADIUS * norm), first_norm)
        for _ in range(self.max_steps):
            if relaxed.gradient_norm(inner.point) <= tolerance * first_norm:
                break
            following, ending = self.newton.step(relaxed, inner)
            if ending is not None:
                following = _newton_step(relaxed, inner)
            if following is None:
                break
            relaxed, centred = _centred(relaxed, following.point, following.curvature)
            inner = following._replace(point=centred)
        return state._replace(
            point=problem.evaluate(inner.point.parameters),
            level=state.level + 1,
            kappa=kappa,
            radius=inner.radius,
            first_norm=first_norm,
            norm=float(relaxed.gradient_norm(inner.point)),
            relaxed=inner.point.parameters,
            before=state.relaxed,
            duals=relaxed.barrier.duals if isinstance(relaxed, Interior) else None,
        ), None

    def _finished(
        self, problem: Problem, state: HomotopyState, finish: ExactFinish, motion: Callable
    ) -> HomotopyState:
        """Return the state after the finish from the last two minimisers."""
        levels = (state.kappa / self.reduction, state.before), (state.kappa, state.relaxed)
        pattern = identify(problem, motion, levels)
        start = snapped(problem.bounds, state.relaxed, state.before, self.reduction)
        end = finish.run(problem, motion, start, pattern, state.first_norm)
        point = problem.evaluate(end.parameters)
        return state._replace(
            point=point if end.is_right or point.value < state.point.value else state.point,
            finish_level=state.level,
            is_certified=end.is_right,
        )


def _extrapolated(
    relaxed: Problem, state: HomotopyState, kappa: float, reduction: float, start: Point
) -> Point:
    """Return the better one of a start and the point ahead on the path, linear in sqrt(kappa)."""
    root, last, before = (math.sqrt(x) for x in (kappa, state.kappa, state.kappa / reduction))
    share = (root - last) / (last - before)
    target = state.relaxed + share * (state.relaxed - state.before)
    ahead = relaxed.evaluate(relaxed.project(target))
    return ahead if ahead.value < start.value else start


def _centred(
    relaxed: Problem, point: Point, curvature: float | None = None
) -> tuple[Problem, Point]:
    """Return problem and point after a step to it; only a barrier changes with the iterate."""
    return relaxed.moved(point, curvature) if isinstance(relaxed, Interior) else (relaxed, point)


def _newton_step(problem: Problem, state: NewtonCGState) -> NewtonCGState | None:
    """Return the state after a Newton step that reduces the gradient, or None.

    At the last digits the value is rounding and hides the descent; the gradient still shows it.
    """
    point = state.point
    path = conjugate_gradient_path(
        point.derivative,
        problem.hessian(point.parameters),
        problem.riesz,
        radius=math.inf,
        tolerance=LAST_FORCING,
        max_products=MAX_LAST_PRODUCTS,
    )
    step, _, is_cut = path.cut(math.inf)
    if is_cut:
        return None
    trial = problem.evaluate(point.parameters + step)
    if not problem.gradient_norm(trial) < 0.5 * problem.gradient_norm(point):
        return None
    return state._replace(point=trial)


def _relax(problem: Problem, kappa: float) -> Problem:
    """Return the problem with relaxed contact; what it evaluates counts for both."""
    return replace(problem, objective=with_contact(problem.objective, RelaxedContact(kappa)))


def _first_relaxation(problem: Problem, state: HomotopyState) -> tuple[float, Problem, Point]:
    """Return the kappa that changes the objective at the start by about `FIRST_CHANGE`.

    With it come the relaxed problem and its point at the start.
    """
    kappa, value = 1.0, float(state.point.value)
    for _ in range(MAX_TRIALS):
        relaxed = _relax(problem, kappa)
        start = relaxed.evaluate(state.relaxed)
        change = abs(float(start.value) - value) / max(abs(value), 1e-300)
        factor = FIRST_CHANGE / max(change, 1e-300) if math.isfinite(change) else 0.0
        if 0.2 <= factor <= 5.0:
            return kappa, relaxed, start
        # The change is about proportional to kappa, unless rounding or overflow hides it.
        kappa *= min(max(factor, 1e-6), 1e6)
    raise ValueError(
        "no relaxation of contact changes the objective at the start by a fraction of it; is there "
        "any contact, and is the value at the start not zero? Otherwise give first_kappa"
    )
