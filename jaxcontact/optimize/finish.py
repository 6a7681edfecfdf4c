"""The exact finish: from the pattern of contact to a strongly stationary control.

With the closed pairs S of every step fixed, and all others open, the motion is affine in the
control. If the cost is quadratic, a strongly stationary control solves one quadratic problem with
equality constraints,

    minimise J(u) on the pattern S,    gap = 0 on the weak pairs W,

by projected conjugate gradients. Its multipliers nu (of the weak gaps), pi (of impulses on W), the
impulses lam on S and the gaps of all other pairs tell whether the pattern is right. Wrong signs say
what to change, all at once:

    nu < 0: W -> open,    pi < 0: W -> S,    lam < 0: S -> W,    gap < 0: open -> W.

A cost that is not quadratic on a pattern takes more Newton steps. Source: MATH.md 5; Nocedal,
Wright, Numerical Optimization (2006), 16.3 and 16.5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.control.problem import Problem
from jaxcontact.derivative.weak import contact_sizes
from jaxcontact.motion.stepper import Stepper, StepPerturbation, with_perturbation
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.optimize.certificate import on_pattern, run
from jaxcontact.optimize.pattern import Pattern, Signs, pivoted, worst_alone
from jaxcontact.optimize.trust_region import conjugate_gradient_path
from jaxcontact.optimize.weak_rows import WeakRows, weak_rows, wrong_signs
from jaxcontact.transforms.trees import nodes

#: Gaps and impulses below this times those of the motion are zero: rounding of many steps.
ROUNDING = 1e-12


class Finished(NamedTuple):
    """Where a finish ended."""

    parameters: Array
    """The parameters."""

    pattern: Pattern
    """The pattern of their motion."""

    residual: float
    """Norm of the gradient on the pattern without the weak gaps."""

    is_right: bool
    """Whether all signs are right, and the residual small."""


@dataclass(frozen=True)
class ExactFinish:
    """From a pattern to a certified control, or to a better pattern."""

    tolerance: float = 1e-11
    """Residual of the end over the gradient norm at the start."""

    loose: float = 1e-2
    """Residual over that at its start, of the quadratic problems that are solved for signs only."""

    max_pivots: int = 12
    """Patterns that are tried."""

    patience: int = 3
    """Pivots without fewer wrong signs before it is given up."""

    max_products: int = 300
    """Products with the Hessian for one quadratic problem."""

    max_steps: int = 8
    """Newton steps on one pattern; a quadratic cost takes one or two."""

    def run(
        self,
        problem: Problem,
        motion: Callable[[Array], Trajectory],
        parameters: Array,
        pattern: Pattern,
        first_norm: float,
    ) -> Finished:
        """Return where the finish ended.

        Args:
            problem: the exact problem, without bounds.
            motion: maps a control to its trajectory; a pytree that holds the stepper.
            parameters: where it starts.
            pattern: contact there.
            first_norm: gradient norm that the tolerance refers to.
        """
        seen, fewest, patience = {pattern.key()}, math.inf, self.patience
        goal = self.tolerance * first_norm
        while True:
            fixed = _OnPattern.of(problem, motion, parameters, pattern)
            found = self._solve(fixed, parameters, goal, self.loose)
            signs = fixed.signs(found)
            if signs.count == 0 and found.residual > goal:
                found = self._solve(fixed, found.parameters, goal, 0.0)
                signs = fixed.signs(found)
            parameters = found.parameters
            is_right = signs.count == 0 and found.residual <= goal
            patience = self.patience if signs.count < fewest else patience - 1
            fewest = min(fewest, signs.count)
            if signs.count == 0 or patience == 0 or len(seen) == self.max_pivots:
                return Finished(parameters, pattern, found.residual, is_right)
            following = pivoted(pattern, signs)
            if following.key() in seen:
                following = pivoted(pattern, worst_alone(signs))
            if following.key() in seen:
                return Finished(parameters, pattern, found.residual, False)
            pattern = following
            seen.add(pattern.key())

    def _solve(self, fixed: _OnPattern, parameters: Array, goal: float, loose: float) -> _Minimum:
        """Return the minimiser on a pattern: with a residual below the goal, or loosely."""
        first = math.inf
        for _ in range(self.max_steps):
            parameters = parameters + fixed.rows.correct(-fixed.weak_gaps(parameters))
            found = fixed.evaluate(parameters)
            first = min(first, found.residual)
            wanted = max(goal, loose * first)
            if found.residual <= wanted:
                break
            path = conjugate_gradient_path(
                found.rest,
                fixed.problem.hessian(parameters),
                fixed.rows.project,
                radius=math.inf,
                # A little more than is asked for: rounding of the recurrences comes on top.
                tolerance=0.3 * wanted / found.residual,
                max_products=self.max_products,
            )
            step, _, is_cut = path.cut(math.inf)
            if is_cut:  # negative curvature: no minimiser on this pattern
                break
            parameters = parameters + step
        return found


class _Minimum(NamedTuple):
    """A point on a pattern."""

    parameters: Array
    rest: Array
    """Derivative of the Lagrangian, without the part of the weak gaps."""

    residual: float
    """Its norm."""

    nu: np.ndarray
    """Multipliers of the weak gaps, (m,)."""

    by_impulse: np.ndarray
    """Derivative of the objective by impulses on the weak pairs, (m,)."""


@dataclass(frozen=True)
class _OnPattern:
    """The problem with its contact fixed, and the rows of the weak gaps."""

    problem: Problem
    """The smooth problem on the pattern."""

    motion: Callable[[Array], Trajectory]
    """Maps a control to the trajectory on the pattern."""

    probe: StepPerturbation
    """The pattern as a perturbation, with a push of zero."""

    exact: Problem
    """The problem without a pattern."""

    pattern: Pattern
    rows: WeakRows
    sizes: tuple[float, float]
    """Gap and impulse that count as large."""

    @classmethod
    def of(
        cls,
        problem: Problem,
        motion: Callable[[Array], Trajectory],
        parameters: Array,
        pattern: Pattern,
    ) -> _OnPattern:
        """Return the problem on a pattern, linearised."""
        closed = StepPerturbation(closed=jnp.asarray(pattern.strong))
        probe = closed._replace(push=jnp.zeros(pattern.strong.shape, parameters.dtype))
        fixed_motion = with_perturbation(motion, closed)
        sizes = contact_sizes(
            nodes(motion, Stepper)[0], run(fixed_motion, problem.controls, parameters)
        )
        return cls(
            replace(problem, objective=with_perturbation(problem.objective, closed)),
            fixed_motion,
            probe,
            problem,
            pattern,
            weak_rows(problem, motion, parameters, probe, pattern.weak),
            sizes,
        )

    def evaluate(self, parameters: Array) -> _Minimum:
        """Return a point with its multipliers."""
        self.exact.counts.evaluations += 1
        _, derivative, by_impulse = on_pattern(
            self.exact.objective, self.exact.controls, parameters, self.probe
        )
        nu, rest = self.rows.multipliers(derivative)
        residual = math.sqrt(max(float(jnp.vdot(rest, self.rows.project(rest))), 0.0))
        return _Minimum(parameters, rest, residual, nu, np.asarray(by_impulse)[self.pattern.weak])

    def trajectory(self, parameters: Array) -> Trajectory:
        """Return the motion on the pattern."""
        self.exact.counts.motions += 1
        return run(self.motion, self.exact.controls, parameters)

    def weak_gaps(self, parameters: Array) -> np.ndarray:
        """Return the gaps of the weak pairs, (m,) [m]."""
        return np.asarray(self.trajectory(parameters).contact.gap)[self.pattern.weak]

    def signs(self, found: _Minimum) -> Signs:
        """Return what is wrong with the pattern."""
        strong, weak = self.pattern
        pi = found.by_impulse - self.rows.compliance.T @ found.nu
        sizes = self.rows.in_units_of_the_gradient(found.nu, pi)
        wrong = np.where(wrong_signs(sizes), -sizes, 0.0)
        # The more negative multiplier of a pair decides.
        to_open, to_strong = (_spread(weak, x * (x >= y)) for x, y in (wrong, wrong[::-1]))
        contact = self.trajectory(found.parameters).contact
        lam, gap = (np.asarray(x) for x in (contact.multiplier, contact.gap))
        pulled = -lam / self.sizes[1]
        inside = -gap / self.sizes[0]
        return Signs(
            to_open,
            to_strong,
            np.where(strong & (pulled > ROUNDING), pulled, 0.0),
            np.where(~strong & ~weak & (inside > ROUNDING), inside, 0.0),
        )


def _spread(places: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values at their places, (T, P, C), zero elsewhere."""
    spread = np.zeros(places.shape)
    spread[places] = values
    return spread
