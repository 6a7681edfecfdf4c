"""The contact-stabilized Newmark scheme of Deuflhard, Krause and Ertel.

With the predictor z, the admissible displacement nearest to y + tau v in the norm of M, and
z = y + tau u, D = M + tau/2 B + tau^2/4 A, a step is two contact problems in velocities:

    M u + N^T mu = M v,                                 N (y + tau u) <= psi,
    D w + 1/2 N^T lam = M u - tau/2 (A y - f),          N (y + tau w) <= psi,
    y' = y + tau w,   v' = v + 2 (w - u),

with mu and lam complementary to the gaps of z and y'.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import ContactProblem, Guess
from jaxcontact.schemes.contact_implicit import ContactImplicit
from jaxcontact.schemes.interface import EnergyFlow, ProblemFactory, StepInfo, StepState
from jaxcontact.schemes.terms import gap_resolution, viscous_loss
from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StabilizedOperators:
    """Operators of a scheme with a predictor in the norm of the mass."""

    mass: ComponentwiseMatrix | SymmetricMatrix
    """Mass matrix of the kinetic energy, (n, n) [kg]."""

    predictor: ContactProblem
    """The contact problem of the mass matrix M."""

    problem: ContactProblem
    """The contact problem of the matrix D."""


@dataclass(frozen=True)
class ContactStabilized:
    """Contact-stabilized Newmark: the free flight is projected before the step is made.

    z = M-projection of y + tau v onto N z <= psi; D (y' - y) = M (z - y) - tau^2/2 (A y - f)
    - tau/2 N^T lam; v' = v + 2 (y' - z)/tau.

    Order 2 without contact. Dissipative under a constant load: an impact takes
    lam.(psi - N y)/tau + 2 mu.(psi - N y')/tau >= 0. The contact force does not chatter and
    converges.

    Known failure: a pinned node keeps its velocity of impact for ever (the predictor takes it away
    in every step anew), so the nodal velocity on the contact set, and its share of the kinetic
    energy, is stale; a second factor and a second contact problem per step.

    Source: Deuflhard, Krause, Ertel, Int. J. Numer. Meth. Engng 73 (2008) 1274-1290.
    """

    def prepare(
        self, system: System, dt: Array, make_problem: ProblemFactory
    ) -> StabilizedOperators:
        """Return the operators: M and D factorised once."""
        trapezoidal = ContactImplicit().prepare(system, dt, make_problem)
        predictor = make_problem(system.mass.expand())
        return StabilizedOperators(system.mass, predictor, trapezoidal.problem)

    def memory(self, system: System, operators: StabilizedOperators) -> Guess:
        """Return where the contact problem of the first predictor starts."""
        return operators.predictor.first_guess()

    def step(
        self,
        system: System,
        operators: StabilizedOperators,
        dt: Array,
        state: StepState,
        load: Array,
    ) -> tuple[StepState, StepInfo]:
        """Advance by one step under the constant load (n,) [N]."""
        y, v = state.displacement, state.velocity
        contact = {
            "bound": (system.gap - system.normals @ y) / dt,
            "resolution": gap_resolution(system, y) / dt,
        }
        u, predicted = operators.predictor.solve(operators.mass @ v, **contact, guess=state.memory)
        rhs = operators.mass @ u - 0.5 * dt * (system.stiffness @ y - load)
        w, solution = operators.problem.solve(rhs, **contact, guess=state.guess)
        velocity, impulse = v + 2.0 * (w - u), 2.0 * solution.multiplier
        new = StepState(y + dt * w, velocity, impulse, solution.guess, predicted.guess)
        return new, StepInfo(
            jnp.maximum(predicted.iterations, solution.iterations),
            jnp.maximum(predicted.status, solution.status),
            jnp.maximum(predicted.residual, solution.residual),
            predicted.weak | solution.weak,
        )

    def energy_flow(
        self,
        system: System,
        operators: StabilizedOperators,
        dt: Array,
        old: StepState,
        new: StepState,
        load: Array,
    ) -> EnergyFlow:
        """Return work, viscous loss and the impact losses of the step and of its predictor."""
        increment = new.displacement - old.displacement
        gap = system.gap - system.normals @ old.displacement
        # v - u, the velocity that the predictor takes away: mu itself is not kept.
        taken = 0.5 * (old.velocity + new.velocity) - increment / dt
        predictor_loss = -jnp.dot(taken, operators.mass @ (new.velocity - old.velocity))
        return EnergyFlow(
            work=jnp.dot(increment, load),
            viscous_loss=viscous_loss(system, dt, increment),
            impact_loss=jnp.dot(new.impulse, gap) / dt + predictor_loss,
        )
