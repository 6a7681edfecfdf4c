"""The classical Newmark scheme (beta = 1/4, gamma = 1/2) with averaged contact forces.

In the midpoint velocity w, with D = M + tau/2 B + tau^2/4 A and contact forces c, c' at both ends:

    D w + tau/4 N^T c' = M v - tau/2 (A y - f) - tau/4 N^T c,
    N (y + tau w) <= psi,   c' >= 0,   c' . (psi - N (y + tau w)) = 0,
    y' = y + tau w,   v' = 2 w - v.

The impulse of a step is tau (c + c')/2.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from jaxcontact.schemes.interface import Losses, Operators, SchemeMatrices, StepResult, StepState
from jaxcontact.schemes.terms import impact_loss, trapezoidal_matrix, velocity_bound
from jaxcontact.system.system import System


@dataclass(frozen=True)
class Trapezoidal:
    """Classical Newmark with pure Signorini contact: the method that fails.

    D w = M v - tau/2 (A y - f) - tau/4 N^T (c + c'), y' = y + tau w, v' = 2 w - v, c' complementary
    to the new gap.

    Order 2 without contact, where it conserves energy exactly and equals `ContactImplicit`. Through
    contact it has no energy bound: in contact c' does the work -tau/2 (c + c') . N w, of either
    sign, and the force left over from the last step acts on a body that has already gone.

    Known failure: at Courant numbers up to about 1 the energy of a bouncing bar grows without
    bound under refinement and the motion is chaotic; at 4 it does not. It is here to show that.

    Continuing a run from `Trajectory.final` starts without contact force.

    Source: Newmark, J. Eng. Mech. Div. 85 (1959); the failure in Doyen, Ern, Piperno, SIAM J. Sci.
    Comput. 33 (2011) and Krause, Walloth, Appl. Numer. Math. 62 (2012).
    """

    def matrices(self, system: System, dt: Array) -> SchemeMatrices:
        """Return M and D."""
        return SchemeMatrices(system.mass, (trapezoidal_matrix(system, dt),))

    def first_carry(self, system: System) -> Array:
        """Return the contact force c at the start, (C,) [N]: none."""
        return jnp.zeros(system.normals.count, system.dtype)

    def step(
        self, system: System, operators: Operators, dt: Array, state: StepState, load: Array
    ) -> StepResult:
        """Advance by one step under the constant load (n,) [N]."""
        y, v, old_force = state.displacement, state.velocity, state.carry
        rhs = operators.mass @ v - 0.5 * dt * (system.stiffness @ y - load)
        w, solution = operators.problem.solve(
            rhs - 0.25 * dt * system.normals.transposed_product(old_force, system.size),
            velocity_bound(system, dt, y, v),
            state.guesses[0],
        )
        force = 4.0 / dt * solution.multiplier
        impulse = 0.5 * dt * (old_force + force)
        return StepResult(y + dt * w, 2.0 * w - v, impulse, (solution,), force)

    def losses(
        self, system: System, operators: Operators, dt: Array, old: StepState, new: StepState
    ) -> Losses:
        """Return the impact loss lam.Nw, of either sign."""
        return Losses(impact_loss(system, dt, old, new))
