"""The contact-implicit Newmark scheme of Kane, Repetto, Ortiz and Marsden; (3.16) of the paper.

In the midpoint velocity w = (y' - y)/tau = (v + v')/2, with D = M + tau/2 B + tau^2/4 A:

    D w + 1/2 N^T lam = M v - tau/2 (A y - f),
    N (y + tau w) <= psi,   lam >= 0,   lam . (psi - N (y + tau w)) = 0,
    y' = y + tau w,   v' = 2 w - v.

This increment form equals (3.16) and (4.19) and keeps its digits in float32. Source: MATH.md 2.
"""

from __future__ import annotations

from dataclasses import dataclass

from jax import Array

from jaxcontact.schemes.interface import Losses, Operators, SchemeMatrices, StepResult, StepState
from jaxcontact.schemes.terms import elastic_force, impact_loss, trapezoidal_matrix, velocity_bound
from jaxcontact.system.system import System


@dataclass(frozen=True)
class ContactImplicit:
    """Contact-implicit Newmark: contact forces fully implicit, everything else trapezoidal.

    Order 2 without contact. Dissipative: energy never grows under a constant load. Displacement,
    impulse and energy converge through impacts.

    Known failure: the contact force chatters from step to step and does not converge at a fixed
    Courant number. The energy lost at a touch depends on its place in the time step, 4 theta
    (1 - theta) times O(h), so that the derivative of a rebound with respect to what moves the touch
    in time (impact speed, gap), exact for the discrete motion, keeps an error of order one under
    refinement; its mean over theta does not. `ContactStabilized` has neither.

    Source: Kane, Repetto, Ortiz, Marsden, CMAME 180 (1999); paper (3.16).
    """

    def matrices(self, system: System, dt: Array) -> SchemeMatrices:
        """Return M and D."""
        return SchemeMatrices(system.mass, (trapezoidal_matrix(system, dt),), spans=(0.5,))

    def first_carry(self, system: System) -> tuple[()]:
        """Return (): displacement and velocity are all a step needs."""
        return ()

    def step(
        self, system: System, operators: Operators, dt: Array, state: StepState, load: Array
    ) -> StepResult:
        """Advance by one step under the constant load (n,) [N]."""
        y, v = state.displacement, state.velocity
        w, solution = operators.problem.solve(
            operators.mass @ v - 0.5 * dt * (elastic_force(system, state) - load),
            velocity_bound(system, dt, y, v),
            state.guesses[0],
        )
        return StepResult(y + dt * w, 2.0 * w - v, 2.0 * solution.multiplier, (solution,))

    def losses(
        self, system: System, operators: Operators, dt: Array, old: StepState, new: StepState
    ) -> Losses:
        """Return the impact loss lam.N(y' - y)/tau."""
        return Losses(impact_loss(system, dt, old, new))
