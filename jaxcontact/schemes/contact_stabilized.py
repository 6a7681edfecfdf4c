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

from jaxcontact.schemes.interface import Losses, Operators, SchemeMatrices, StepResult, StepState
from jaxcontact.schemes.terms import elastic_force, impact_loss, trapezoidal_matrix, velocity_bound
from jaxcontact.system.system import System


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

    def matrices(self, system: System, dt: Array) -> SchemeMatrices:
        """Return M, and D and M for the contact problems of the step and of its predictor."""
        matrices = (trapezoidal_matrix(system, dt), system.mass.expand())
        return SchemeMatrices(system.mass, matrices, spans=(0.5, 0.0))

    def first_carry(self, system: System) -> tuple[()]:
        """Return (): displacement and velocity are all a step needs."""
        return ()

    def step(
        self, system: System, operators: Operators, dt: Array, state: StepState, load: Array
    ) -> StepResult:
        """Advance by one step under the constant load (n,) [N]."""
        y, v = state.displacement, state.velocity
        problem, predictor = operators.problems
        guess, first_guess = state.guesses
        bound = velocity_bound(system, dt, y, v)
        u, predicted = predictor.solve(operators.mass @ v, bound, first_guess)
        rhs = operators.mass @ u - 0.5 * dt * (elastic_force(system, state) - load)
        w, solution = problem.solve(rhs, bound, guess)
        change = w - u
        # Between the tangents of a bowl at two places there is more than rounding.
        is_concave = system.frames is not None and system.frames.is_concave
        if problem.contact_solver.is_exact and not is_concave:
            held = (solution.multiplier > 0.0) & (predicted.multiplier > 0.0)
            change = change - _rounding(system, change, held)
        velocity, impulse = v + 2.0 * change, 2.0 * solution.multiplier
        return StepResult(y + dt * w, velocity, impulse, (solution, predicted))

    def losses(
        self, system: System, operators: Operators, dt: Array, old: StepState, new: StepState
    ) -> Losses:
        """Return the impact losses of the step and of its predictor."""
        # v - u, the velocity that the predictor takes away: mu itself is not kept.
        increment = new.displacement - old.displacement
        taken = 0.5 * (old.velocity + new.velocity) - increment / dt
        predictor_loss = -jnp.dot(taken, operators.mass @ (new.velocity - old.velocity))
        return Losses(impact_loss(system, dt, old, new) + predictor_loss)


def _rounding(system: System, change: Array, held: Array) -> Array:
    """Return the part (n,) of w - u that moves a held pair along its normal: u and w are on psi.

    At rest it is the same rounding error in every step, which no later one takes out of the stale
    velocity of a pinned node: the kinetic energy would grow with the square of the time, in float32
    to 1e-6 of the potential energy of a block in 200 000 steps. Taken out one pair after the other:
    of pairs at one node with oblique normals, a part as large as their cosine stays.
    """
    along = jnp.where(held, system.normals @ change, 0.0)
    part = system.normals.transposed_product(along, system.size)
    return jax.lax.stop_gradient(part)
