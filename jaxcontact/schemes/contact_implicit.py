"""The contact-implicit Newmark scheme of Kane, Repetto, Ortiz and Marsden; (3.16) of the paper.

In the midpoint velocity w = (y' - y)/tau = (v + v')/2, with D = M + tau/2 B + tau^2/4 A:

    D w + 1/2 N^T lam = M v - tau/2 (A y - f),
    N (y + tau w) <= psi,   lam >= 0,   lam . (psi - N (y + tau w)) = 0,
    y' = y + tau w,   v' = 2 w - v.

This increment form equals (3.16) and (4.19) and keeps its digits in float32. Source: MATH.md 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import ContactProblem
from jaxcontact.schemes.interface import EnergyFlow, ProblemFactory, StepInfo, StepState
from jaxcontact.schemes.terms import gap_resolution, viscous_loss
from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ImplicitOperators:
    """Operators of a scheme with one contact problem per step."""

    mass: ComponentwiseMatrix | SymmetricMatrix
    """Mass matrix of the kinetic energy, (n, n) [kg]."""

    problem: ContactProblem
    """The contact problem of the matrix D."""


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

    def prepare(self, system: System, dt: Array, make_problem: ProblemFactory) -> ImplicitOperators:
        """Return the operators: D factorised once."""
        matrix = system.mass + 0.25 * dt**2 * system.stiffness
        if system.viscosity is not None:
            matrix = matrix + 0.5 * dt * system.viscosity
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
        rhs = operators.mass @ v - 0.5 * dt * (system.stiffness @ y - load)
        w, solution = operators.problem.solve(
            rhs,
            bound=(system.gap - system.normals @ y) / dt,
            resolution=gap_resolution(system, y) / dt,
            guess=state.guess,
        )
        new = StepState(y + dt * w, 2.0 * w - v, 2.0 * solution.multiplier, solution.guess)
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
        """Return work tau w.f', viscous loss tau w.Bw and impact loss lam.(psi - N y)/tau."""
        increment = new.displacement - old.displacement
        gap = system.gap - system.normals @ old.displacement
        return EnergyFlow(
            work=jnp.dot(increment, load),
            viscous_loss=viscous_loss(system, dt, increment),
            impact_loss=jnp.dot(new.impulse, gap) / dt,
        )
