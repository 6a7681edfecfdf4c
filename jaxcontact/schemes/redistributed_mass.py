"""Newmark with the mass of the contact nodes redistributed to the inside of the body.

In contact direction the contact nodes (K; all other directions: R) carry no mass. With the singular
mass matrix M_r of `redistribute` the trapezoidal rule holds on R, and on K the static
balance at the new time:

    M_r (v' - v) = -tau [A (y + y')/2 + B_RR w + B_RK (v_K + v'_K)/2 - f]      on R,
    A y' + B w - f + N^T c' = 0,   c' >= 0,   c' . (psi - N y') = 0            on K,
    y' = y + tau w,   v'_R = 2 w_R - v_R,   v'_K = w_K.

The rows of K times tau/4 make this one symmetric problem with the SPD matrix

    D = M_r + tau^2/4 A + tau/4 (B + (I - Q) B (I - Q)),   Q = N^T N,

since A and B, not the mass, hold the contact nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import ContactProblem
from jaxcontact.schemes.interface import EnergyFlow, ProblemFactory, StepInfo, StepState
from jaxcontact.schemes.mass_redistribution import redistribute, tangential_projection
from jaxcontact.schemes.terms import gap_resolution, viscous_loss
from jaxcontact.system.block_matrix import from_symmetric
from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RedistributedOperators:
    """Operators of the scheme with massless contact nodes."""

    mass: ComponentwiseMatrix | SymmetricMatrix
    """M_r, singular: M_r N^T = 0, (n, n) [kg]."""

    problem: ContactProblem
    """The contact problem of the matrix D."""


@dataclass(frozen=True)
class RedistributedMass:
    """Newmark on a body whose contact nodes have no mass in contact direction.

    Trapezoidal rule inside; the contact row is the static balance (A y' + B w - f) . nu + c' = 0 at
    the new time. Its mass moves to the nodes just inside; total mass, centre of mass and inertia
    stay those of the body (`schemes/mass_redistribution.py`).

    Order 2 without contact and viscosity, from an initial state that is in balance on the contact
    rows (else an error of order tau h remains). The contact force does not chatter, since no mass
    can bounce, and it is the best of all schemes. Energy is kept up to the ledger's numerical loss
    tau^2/2 w_K . A w - tau/2 w_R . B (w - v)_K, of either sign and of order h, and the impact loss
    lam.(psi - N y)/tau.

    `contact_impulse` is tau c', with the contact force c' at the new time.

    Known failure: energy is not bounded by the initial one (a bouncing bar of 20 cells exceeds it
    by a tenth at Courant number 10), and viscosity enters the contact rows at first order. A
    contact node must have one contact pair and nodes inside the body near it.

    Source: Khenous, Laborde, Renard, Eur. J. Mech. A/Solids 27 (2008) 918-932; Hager, Hueeber,
    Wohlmuth, Int. J. Numer. Meth. Engng 73 (2008) 1206-1225.
    """

    def prepare(
        self, system: System, dt: Array, make_problem: ProblemFactory
    ) -> RedistributedOperators:
        """Return the operators: M_r, and D factorised once.

        Raises:
            ValueError: if the contact pairs are not one per node, or the mesh is too coarse to
                move the mass of the contact nodes inside.
        """
        d, n_nodes = system.dimension, len(system.free_nodes)
        if system.normals.count == 0:
            mass = system.mass
            matrix = mass + 0.25 * dt**2 * system.stiffness
            if system.viscosity is not None:
                matrix = matrix + 0.5 * dt * system.viscosity
            return RedistributedOperators(mass, make_problem(matrix))
        mass = redistribute(system)
        matrix = mass.plus(from_symmetric(system.stiffness, d).scaled(0.25 * dt**2))
        if system.viscosity is not None:
            damping = from_symmetric(system.viscosity, d).scaled(0.25 * dt)
            tangential = tangential_projection(system)
            matrix = matrix.plus(damping).plus(tangential @ damping @ tangential)
        problem = make_problem(matrix.to_symmetric(n_nodes))
        return RedistributedOperators(mass.to_symmetric(n_nodes), problem)

    def memory(self, system: System, operators: RedistributedOperators) -> tuple[()]:
        """Return (): displacement and velocity are all a step needs."""
        return ()

    def step(
        self,
        system: System,
        operators: RedistributedOperators,
        dt: Array,
        state: StepState,
        load: Array,
    ) -> tuple[StepState, StepInfo]:
        """Advance by one step under the constant load (n,) [N]."""
        y, v = state.displacement, state.velocity
        imbalance = system.stiffness @ y - load
        # The row of a massless node is a static equation: the old balance enters R only.
        rhs = operators.mass @ v - 0.25 * dt * (imbalance + _remove_normal(system, imbalance))
        if system.viscosity is not None:
            pull = system.viscosity @ (v - _remove_normal(system, v))
            rhs = rhs - 0.25 * dt * _remove_normal(system, pull)
        w, solution = operators.problem.solve(
            rhs,
            bound=(system.gap - system.normals @ y) / dt,
            resolution=gap_resolution(system, y) / dt,
            guess=state.guess,
        )
        velocity = w + _remove_normal(system, w - v)
        new = StepState(y + dt * w, velocity, 4.0 * solution.multiplier, solution.guess)
        return new, StepInfo(solution.iterations, solution.status, solution.residual, solution.weak)

    def energy_flow(
        self,
        system: System,
        operators: RedistributedOperators,
        dt: Array,
        old: StepState,
        new: StepState,
        load: Array,
    ) -> EnergyFlow:
        """Return work, viscous loss, impact loss lam.(psi - N y)/tau and the numerical loss."""
        increment = new.displacement - old.displacement
        normal = increment - _remove_normal(system, increment)
        numerical_loss = 0.5 * jnp.dot(normal, system.stiffness @ increment)
        if system.viscosity is not None:
            jump = normal - dt * (old.velocity - _remove_normal(system, old.velocity))
            pull = system.viscosity @ jump
            numerical_loss = numerical_loss - 0.5 / dt * jnp.dot(increment - normal, pull)
        gap = system.gap - system.normals @ old.displacement
        return EnergyFlow(
            work=jnp.dot(increment, load),
            viscous_loss=viscous_loss(system, dt, increment),
            impact_loss=jnp.dot(new.impulse, gap) / dt,
            numerical_loss=numerical_loss,
        )


def _remove_normal(system: System, x: Array) -> Array:
    """Return (I - Q) x, (n,)."""
    return x - system.normals.transposed_product(system.normals @ x, system.size)
