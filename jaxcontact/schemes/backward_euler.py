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

from jaxcontact.schemes.contact_implicit import ImplicitOperators
from jaxcontact.schemes.interface import EnergyFlow, ProblemFactory, StepInfo, StepState
from jaxcontact.schemes.terms import gap_resolution, viscous_loss
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

    def prepare(self, system: System, dt: Array, make_problem: ProblemFactory) -> ImplicitOperators:
        """Return the operators: M + tau B + tau^2 A factorised once."""
        matrix = system.mass + dt**2 * system.stiffness
        if system.viscosity is not None:
            matrix = matrix + dt * system.viscosity
        return ImplicitOperators(system.mass, make_problem(matrix))

    def memory(self, system: System, operators: ImplicitOperators) -> tuple[()]:
        """Return (): displacement and velocity are all a step needs."""
        return ()

    def step(
        self,
        system: System,
        operators: ImplicitOperators,
        dt: Array,
        state: StepState,
        load: Array,
    ) -> tuple[StepState, StepInfo]:
        """Advance by one step under the constant load (n,) [N]."""
        y, v = state.displacement, state.velocity
        w, solution = operators.problem.solve(
            operators.mass @ v - dt * (system.stiffness @ y - load),
            bound=(system.gap - system.normals @ y) / dt,
            resolution=gap_resolution(system, y) / dt,
            guess=state.guess,
        )
        new = StepState(y + dt * w, w, solution.multiplier, solution.guess)
        return new, StepInfo(solution.iterations, solution.status, solution.residual, solution.weak)

    def energy_flow(
        self,
        system: System,
        operators: ImplicitOperators,
        dt: Array,
        old: StepState,
        new: StepState,
        load: Array,
    ) -> EnergyFlow:
        """Return work, viscous loss tau w.Bw, impact loss lam.(psi - N y)/tau, numerical loss."""
        increment = new.displacement - old.displacement
        jump = new.velocity - old.velocity
        damping = jnp.dot(jump, operators.mass @ jump)
        damping = damping + jnp.dot(increment, system.stiffness @ increment)
        gap = system.gap - system.normals @ old.displacement
        return EnergyFlow(
            work=jnp.dot(increment, load),
            viscous_loss=viscous_loss(system, dt, increment),
            impact_loss=jnp.dot(new.impulse, gap) / dt,
            numerical_loss=0.5 * damping,
        )
