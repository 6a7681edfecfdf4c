"""Newmark with the mass of the contact nodes redistributed to the inside of the body.

In contact direction the contact nodes (K; all other directions: R) carry no mass. With the singular
mass matrix M_r of `redistribute` the trapezoidal rule holds on R, and on K the static
balance at the new time:

    M_r (v' - v) = -tau [A (y + y')/2 + B_RR w + B_RK (v_K + v'_K)/2 - f + N_R^T (c + c')/2]  on R,
    A y' + B w - f + N^T c' = 0,   c' >= 0,   c' . (psi - N y') = 0                           on K,
    y' = y + tau w,   v'_R = 2 w_R - v_R,   v'_K = w_K.

S is the projection on K, P = I - S and N_R = N P, which is zero against obstacles and, between two
bodies, where all contact directions are one. The rows of K times tau/4 make this one symmetric
problem with the SPD matrix

    D = M_r + tau^2/4 A + tau/4 (B + P B P),
    D w + tau/4 N^T c' = M_r v - tau/4 (I + P)(A y - f) - tau/4 P (B S v + N^T c),

since A and B, not the mass, hold the contact nodes. Without viscosity the balance on K at both ends
of a step makes the force on R and K the same in the mean: two bodies keep their momentum.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from jaxcontact.schemes.interface import Losses, Operators, SchemeMatrices, StepResult, StepState
from jaxcontact.schemes.mass_redistribution import (
    along_directions,
    contact_directions,
    redistribute,
    tangential_projection,
)
from jaxcontact.schemes.terms import impact_loss, trapezoidal_matrix, velocity_bound
from jaxcontact.system.block_matrix import from_symmetric
from jaxcontact.system.system import System


@dataclass(frozen=True)
class RedistributedMass:
    """Newmark on bodies whose contact nodes have no mass in contact direction.

    Trapezoidal rule inside; the contact row is the static balance (A y' + B w - f) . nu + c' = 0 at
    the new time. Its mass moves to the nodes just inside; total mass, centre of mass and inertia
    stay those of each body (`schemes/mass_redistribution.py`). Between two bodies the nodes of both
    surfaces are massless.

    Order 2 without contact and viscosity, from an initial state that is in balance on the contact
    rows (else an error of order tau h remains). The contact force does not chatter, since no mass
    can bounce, and it is the best of all schemes. Energy is kept up to the ledger's numerical loss
    tau^2/2 w_K . A w - tau/2 w_R . B (w - v)_K - tau/2 N w_R . (c' - c), of either sign and of
    order h, and the impact loss lam.(psi - N y)/tau. Two free bodies keep their momentum, from an
    initial state in balance; with viscosity up to tau/2 of the viscous force on the contact rows,
    which does not add up over the steps.

    `contact_impulse` is tau c', with the contact force c' at the new time.

    Known failure: energy is not bounded by the initial one. At Courant number 10 a bouncing bar of
    20 cells exceeds it by a tenth in 30 steps, and over some hundred steps it is unstable there;
    take `ContactStabilized` for such steps. Viscosity enters the contact rows at first order. A
    contact node must have one contact pair and nodes inside the body near it.

    Source: Khenous, Laborde, Renard, Eur. J. Mech. A/Solids 27 (2008) 918-932; Hager, Hueeber,
    Wohlmuth, Int. J. Numer. Meth. Engng 73 (2008) 1206-1225.
    """

    def matrices(self, system: System, dt: Array) -> SchemeMatrices:
        """Return M_r and D.

        Raises:
            ValueError: if a node has more than one contact pair, or the mesh is too coarse to move
                the mass of the contact nodes inside.
        """
        if system.normals.count == 0:
            return SchemeMatrices(system.mass, (trapezoidal_matrix(system, dt),))
        d, n_nodes = system.dimension, len(system.free_nodes)
        mass = redistribute(system)
        matrix = mass.plus(from_symmetric(system.stiffness, d).scaled(0.25 * dt**2))
        if system.viscosity is not None:
            damping = from_symmetric(system.viscosity, d).scaled(0.25 * dt)
            tangential = tangential_projection(system)
            matrix = matrix.plus(damping).plus(tangential @ damping @ tangential)
        return SchemeMatrices(mass.to_symmetric(n_nodes), (matrix.to_symmetric(n_nodes),))

    def first_carry(self, system: System) -> tuple[()]:
        """Return (): displacement and velocity are all a step needs."""
        return ()

    def step(
        self, system: System, operators: Operators, dt: Array, state: StepState, load: Array
    ) -> StepResult:
        """Advance by one step under the constant load (n,) [N]."""
        y, v = state.displacement, state.velocity
        directions = contact_directions(system)
        imbalance = system.stiffness @ y - load
        # The row of a massless node is a static equation: the old balance enters R only.
        pull = imbalance
        if system.viscosity is not None:
            pull = pull + system.viscosity @ along_directions(directions, v)
        if _is_coupled(system):
            force = system.normals.transposed_product(state.impulse, system.size)
            pull = pull + force / dt
        pull = pull - along_directions(directions, pull)
        rhs = operators.mass @ v - 0.25 * dt * (imbalance + pull)
        bound = velocity_bound(system, dt, y, v)
        w, solution = operators.problem.solve(rhs, bound, state.guesses[0])
        jump = w - v
        velocity = w + jump - along_directions(directions, jump)
        return StepResult(y + dt * w, velocity, 4.0 * solution.multiplier, (solution,))

    def force_of_step(self, system: System, old: Array, new: Array, inertia: Array) -> Array:
        """Return the force at the middle, on massless rows that at the end; see `OwnForces`."""
        change = inertia - 0.5 * (new - old)
        return new + change - along_directions(contact_directions(system), change)

    def losses(
        self, system: System, operators: Operators, dt: Array, old: StepState, new: StepState
    ) -> Losses:
        """Return the impact loss lam.N(y' - y)/tau and the numerical loss."""
        directions = contact_directions(system)
        increment = new.displacement - old.displacement
        normal = along_directions(directions, increment)
        numerical = 0.5 * jnp.dot(normal, system.stiffness @ increment)
        if system.viscosity is not None:
            jump = normal - dt * along_directions(directions, old.velocity)
            pull = system.viscosity @ jump
            numerical = numerical - 0.5 / dt * jnp.dot(increment - normal, pull)
        if _is_coupled(system):
            slip = system.normals @ (increment - normal)
            numerical = numerical - 0.5 / dt * jnp.dot(slip, new.impulse - old.impulse)
        return Losses(impact_loss(system, dt, old, new), numerical)


def _is_coupled(system: System) -> bool:
    """Return whether a contact pair may be one of two bodies, so that N_R is not zero."""
    return system.normals.weights.shape[1] > system.dimension
