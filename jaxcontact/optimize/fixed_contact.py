"""The control problem on a pattern of contact: smooth, with its weak gaps held at zero.

    L(u, z) = J(u, z) - nu . g_W(u, z) - pi . z,      lower <= u <= upper

at a control with the multipliers nu of the weak gaps and, by their signs, with what is wrong with
the pattern. A bound holds where u - dL/du / alpha is beyond it, with alpha the least curvature.
Source: MATH.md 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.control.bounds import free_variables
from jaxcontact.control.problem import Problem
from jaxcontact.derivative.weak import ContactSizes, contact_sizes
from jaxcontact.motion.stepper import Stepper, StepPerturbation, with_perturbation
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.optimize.certificate import on_pattern, run
from jaxcontact.optimize.pattern import Pattern, Signs
from jaxcontact.optimize.weak_rows import WeakRows, weak_rows, wrong_signs
from jaxcontact.transforms.trees import nodes

#: Gaps and impulses below this times those of the motion are zero: rounding of many steps.
ROUNDING = 1e-12


class Candidate(NamedTuple):
    """A control on a pattern."""

    parameters: Array
    """The parameters, within the bounds, whose weak gaps are zero to first order."""

    rest: Array
    """dL/du."""

    residual: float
    """Norm of u - P(u - dL/du)."""

    nu: np.ndarray
    """Multipliers of the weak gaps, (m,)."""

    by_impulse: np.ndarray
    """dJ/dz, (m,)."""

    rows: WeakRows
    """The weak gaps, with the parameters that no bound holds."""

    to_bounds: Array | float = 0.0
    """Step that puts the others on their bounds."""


@dataclass(frozen=True)
class FixedContact:
    """The problem on a pattern."""

    exact: Problem
    """The problem without a pattern."""

    smooth: Problem
    """The problem on it."""

    motion: Callable[[Array], Trajectory]
    """Maps a control to the trajectory on the pattern."""

    probe: StepPerturbation
    """The pattern as a perturbation, with a push of zero."""

    pattern: Pattern
    """The pattern."""

    rows: WeakRows
    """The weak gaps."""

    sizes: ContactSizes
    """Gap and impulse that count as large."""

    @classmethod
    def of(
        cls,
        problem: Problem,
        motion: Callable[[Array], Trajectory],
        parameters: Array,
        pattern: Pattern,
    ) -> FixedContact:
        """Return the problem on a pattern, whose gaps are linearised at some parameters."""
        closed = StepPerturbation(closed=jnp.asarray(pattern.strong))
        probe = closed._replace(push=jnp.zeros(pattern.strong.shape, parameters.dtype))
        fixed_motion = with_perturbation(motion, closed)
        (stepper, *_) = nodes(motion, Stepper)
        return cls(
            exact=problem,
            smooth=replace(problem, objective=with_perturbation(problem.objective, closed)),
            motion=fixed_motion,
            probe=probe,
            pattern=pattern,
            rows=weak_rows(problem, motion, parameters, probe, pattern.weak),
            sizes=contact_sizes(stepper, run(fixed_motion, problem.controls, parameters)),
        )

    def at(
        self, parameters: Array, last: Candidate | None = None, curvature: float | None = None
    ) -> Candidate:
        """Return the candidate nearest to some parameters.

        Args:
            parameters: what is projected on bounds and weak gaps.
            last: where the step to them began.
            curvature: least curvature that was met, for the bounds that hold.
        """
        parameters = self.exact.project(parameters)
        rows = self.rows if last is None else last.rows
        if last is None and self.exact.bounds is not None:
            lower, upper = self.exact.bounds
            rows = replace(rows, free=(parameters > lower) & (parameters < upper))
        gaps = np.asarray(self._trajectory(parameters).contact.gap)[self.pattern.weak]
        parameters = self.exact.project(parameters + rows.correct(-gaps))
        self.exact.counts.evaluations += 1
        _, derivative, by_impulse = on_pattern(
            self.exact.objective, self.exact.controls, parameters, self.probe
        )
        nu, rest = rows.multipliers(derivative)
        to_bounds = 0.0
        if self.exact.bounds is not None:
            free, to_bounds = self._held(parameters, rest, curvature)
            rows = replace(rows, free=free)
            nu, rest = rows.multipliers(derivative)
        step = parameters - self.exact.project(parameters - self.exact.riesz(rest))
        residual = math.sqrt(max(float(self.exact.dot(step, step)), 0.0))
        by_weak_impulse = np.asarray(by_impulse)[self.pattern.weak]
        return Candidate(parameters, rest, residual, nu, by_weak_impulse, rows, to_bounds)

    def signs(self, found: Candidate) -> Signs:
        """Return what is wrong with the pattern at a candidate."""
        strong, weak = self.pattern
        pi = found.by_impulse - self.rows.compliance.T @ found.nu
        sizes = self.rows.in_units_of_the_gradient(found.nu, pi)
        wrong = np.where(wrong_signs(sizes), -sizes, 0.0)
        # The more negative multiplier of a pair decides.
        to_open, to_strong = (_spread(weak, x * (x >= y)) for x, y in (wrong, wrong[::-1]))
        contact = self._trajectory(found.parameters).contact
        pulled = -np.asarray(contact.multiplier) / self.sizes.impulse
        inside = -np.asarray(contact.gap) / self.sizes.gap
        return Signs(
            to_open,
            to_strong,
            np.where(strong & (pulled > ROUNDING), pulled, 0.0),
            np.where(~strong & ~weak & (inside > ROUNDING), inside, 0.0),
        )

    def _held(
        self, parameters: Array, rest: Array, curvature: float | None
    ) -> tuple[Array | None, Array | float]:
        """Return the parameters that no bound holds, bool, and the step of the others to theirs."""
        if self.exact.bounds is None or curvature is None:
            return free_variables(self.exact.bounds, parameters, rest), 0.0
        lower, upper = self.exact.bounds
        target = parameters - self.exact.riesz(rest) / curvature
        free = (target > lower) & (target < upper)
        return free, jnp.where(free, 0.0, self.exact.project(target) - parameters)

    def _trajectory(self, parameters: Array) -> Trajectory:
        self.exact.counts.motions += 1
        return run(self.motion, self.exact.controls, parameters)


def _spread(places: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values at their places, (T, P, C), zero elsewhere."""
    spread = np.zeros(places.shape)
    spread[places] = values
    return spread
