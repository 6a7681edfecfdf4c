"""The exact finish: from the pattern of contact to a strongly stationary control.

With the closed pairs S of every step fixed, and all others open, the motion is affine in the
control. If the cost is quadratic, a strongly stationary control solves one quadratic problem with
equality constraints,

    minimise J(u) on the pattern S,    gap = 0 on the weak pairs W,

by projected conjugate gradients. Its multipliers nu (of the weak gaps), pi (of impulses on W), the
impulses lam on S and the gaps of all other pairs tell whether the pattern is right. Wrong signs say
what to change, all at once:

    nu < 0: W -> open,    pi < 0: W -> S,    lam < 0: S -> W,    gap < 0: open -> W.

A cost that is not quadratic on a pattern takes more Newton steps, and so do bounds: those that hold
are found between the steps, by the primal-dual active set method. Source: MATH.md 5; Nocedal,
Wright, Numerical Optimization (2006), 16.3 and 16.5; Hintermüller, Ito, Kunisch, SIAM J. Optim. 13
(2002) for the bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxcontact.control.bounds import mask
from jaxcontact.control.problem import Problem
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.optimize.fixed_contact import Candidate, FixedContact
from jaxcontact.optimize.pattern import Pattern, pivoted, worst_alone
from jaxcontact.optimize.trust_region import conjugate_gradient_path


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
    """Pivots without fewer wrong signs, and steps without a smaller residual, before it is given
    up."""

    max_products: int = 300
    """Products with the Hessian for one quadratic problem."""

    max_steps: int = 30
    """Newton steps on one pattern; a quadratic cost takes one or two, with bounds some more."""

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
            problem: the exact problem.
            motion: maps a control to its trajectory; a pytree that holds the stepper.
            parameters: where it starts.
            pattern: contact there.
            first_norm: gradient norm that the tolerance refers to.
        """
        seen, fewest, patience = {pattern.key()}, math.inf, self.patience
        goal = self.tolerance * first_norm
        while True:
            fixed = FixedContact.of(problem, motion, parameters, pattern)
            start = fixed.at(parameters)
            found = self._solve(fixed, start, goal, self.loose)
            if found.residual > max(goal, self.loose * start.residual):
                return Finished(found.parameters, pattern, found.residual, False)
            signs = fixed.signs(found)
            if signs.count == 0 and found.residual > goal:
                found = self._solve(fixed, found, goal, 0.0)
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

    def _solve(self, fixed: FixedContact, found: Candidate, goal: float, loose: float) -> Candidate:
        """Return the minimiser on a pattern: with a residual below the goal, or loosely."""
        wanted, curvature = max(goal, loose * found.residual), None
        least, patience = math.inf, self.patience
        for _ in range(self.max_steps):
            patience = self.patience if found.residual < 0.5 * least else patience - 1
            least = min(least, found.residual)
            if found.residual <= wanted or patience == 0:
                break
            rest = mask(found.rows.free, found.rest)
            if not float(jnp.vdot(rest, found.rows.project(rest))) > 0.0:
                # Nothing is free to move, but what a bound holds may not be there yet.
                found = fixed.at(found.parameters + found.to_bounds, found, curvature)
                continue
            path = conjugate_gradient_path(
                rest,
                fixed.smooth.hessian(found.parameters),
                found.rows.project,
                radius=math.inf,
                # A little more than is asked for: rounding of the recurrences comes on top.
                tolerance=0.3 * wanted / found.residual,
                max_products=self.max_products,
            )
            step, _, is_cut = path.cut(math.inf)
            if is_cut:  # negative curvature: no minimiser on this pattern
                break
            curvature = path.least_curvature
            found = fixed.at(found.parameters + step + found.to_bounds, found, curvature)
        return found
