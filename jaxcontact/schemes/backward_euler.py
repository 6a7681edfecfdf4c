"""The implicit Euler scheme with implicit contact.

In the velocity w = v' = (y' - y)/tau of the new time:

    (M + tau B + tau^2 A) w + N^T lam = M v - tau (A y - f),
    N (y + tau w) <= psi,   lam >= 0,   lam . (psi - N (y + tau w)) = 0.

Source: Moreau, Numerical aspects of the sweeping process, CMAME 177 (1999);
Doyen, Ern, Piperno, SIAM J. Sci. Comput. 33 (2011).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from jaxcontact.schemes.interface import Losses, Operators, SchemeMatrices, StepResult, StepState
from jaxcontact.schemes.terms import elastic_force, impact_loss, velocity_bound
from jaxcontact.system.system import System


@dataclass(frozen=True)
class BackwardEuler:
    """Implicit Euler: smooth contact forces, paid for with the energy of every wave.

    (M + tau B + tau^2 A) w + N^T lam = M v - tau (A y - f), y' = y + tau w, v' = w.

    Order 1. Energy never grows under a constant load, with or without contact, for every step
    length; what is lost beside viscosity and impact is 1/2 |v' - v|_M^2 + 1/2 |y' - y|_A^2, the
    ledger's numerical loss.

    Known failure: it damps everything that moves; a bar of 200 cells loses an eighth of its energy
    in one impact at Courant number 1. A control for the other schemes, not a candidate.

    Source: Doyen, Ern, Piperno, SIAM J. Sci. Comput. 33 (2011), section 4.
    """

    def matrices(self, system: System, dt: Array) -> SchemeMatrices:
        """Return M and M + tau B + tau^2 A."""
        matrix = system.mass + dt**2 * system.stiffness
        if system.viscosity is not None:
            matrix = matrix + dt * system.viscosity
        return SchemeMatrices(system.mass, (matrix,), spans=(1.0,))

    def first_carry(self, system: System) -> tuple[()]:
        """Return (): displacement and velocity are all a step needs."""
        return ()

    def step(
        self, system: System, operators: Operators, dt: Array, state: StepState, load: Array
    ) -> StepResult:
        """Advance by one step under the constant load (n,) [N]."""
        y, v = state.displacement, state.velocity
        w, solution = operators.problem.solve(
            operators.mass @ v - dt * (elastic_force(system, state) - load),
            velocity_bound(system, dt, y, v),
            state.guesses[0],
        )
        return StepResult(y + dt * w, w, solution.multiplier, (solution,))

    def force_of_step(self, system: System, old: Array, new: Array, inertia: Array) -> Array:
        """Return the force at the end of the step, see `OwnForces`."""
        del system, old
        return new + inertia

    def losses(
        self, system: System, operators: Operators, dt: Array, old: StepState, new: StepState
    ) -> Losses:
        """Return lam.N(y' - y)/tau and 1/2 |v' - v|_M^2 + 1/2 |y' - y|_A^2."""
        increment = new.deformation - old.deformation
        jump = new.velocity - old.velocity
        damping = jnp.dot(jump, operators.mass @ jump)
        damping = damping + jnp.dot(increment, system.stiffness @ increment)
        return Losses(impact_loss(system, dt, old, new), 0.5 * damping)
