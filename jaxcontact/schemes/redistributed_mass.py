"""Newmark with the mass of the contact nodes redistributed to the inside of the body.

In contact direction the contact nodes (K; all other directions: R) carry no mass. With the singular
mass matrix M_r of `redistribute` the trapezoidal rule holds on R, and on K the static
balance at the new time:

    M_r (v' - v) = -tau [A (y + y')/2 + B_RR w + B_RK (v_K + v'_K)/2 - f]      on R,
    A y' + B w - f + N^T c' = 0,   c' >= 0,   c' . (psi - N y') = 0            on K,
    y' = y + tau w,   v'_R = 2 w_R - v_R,   v'_K = w_K.

The rows of K times tau/4 make this one symmetric problem with the SPD matrix

    D = M_r + tau^2/4 A + tau/4 (B + (I - Q) B (I - Q)),   Q = N^T N,

since A and B, not the mass, hold the contact nodes. Rollers shorten the rows of N; in Q they are
unit vectors.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from jaxcontact.schemes.interface import Losses, Operators, SchemeMatrices, StepResult, StepState
from jaxcontact.schemes.mass_redistribution import (
    massless_rows,
    redistribute,
    tangential_projection,
)
from jaxcontact.schemes.terms import impact_loss, trapezoidal_matrix, velocity_bound
from jaxcontact.system.block_matrix import from_symmetric
from jaxcontact.system.system import System


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
            ValueError: if the contact pairs are not one per node, or the mesh is too coarse to
                move the mass of the contact nodes inside.
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
        imbalance = system.stiffness @ y - load
        # The row of a massless node is a static equation: the old balance enters R only.
        rhs = operators.mass @ v - 0.25 * dt * (imbalance + _remove_normal(system, imbalance))
        if system.viscosity is not None:
            pull = system.viscosity @ (v - _remove_normal(system, v))
            rhs = rhs - 0.25 * dt * _remove_normal(system, pull)
        bound = velocity_bound(system, dt, y, v)
        w, solution = operators.problem.solve(rhs, bound, state.guesses[0])
        velocity = w + _remove_normal(system, w - v)
        return StepResult(y + dt * w, velocity, 4.0 * solution.multiplier, (solution,))

    def force_of_step(self, system: System, old: Array, new: Array, inertia: Array) -> Array:
        """Return the force at the middle, on massless rows that at the end; see `OwnForces`."""
        return new + _remove_normal(system, inertia - 0.5 * (new - old))

    def losses(
        self, system: System, operators: Operators, dt: Array, old: StepState, new: StepState
    ) -> Losses:
        """Return the impact loss lam.N(y' - y)/tau and the numerical loss."""
        increment = new.displacement - old.displacement
        normal = increment - _remove_normal(system, increment)
        numerical = 0.5 * jnp.dot(normal, system.stiffness @ increment)
        if system.viscosity is not None:
            jump = normal - dt * (old.velocity - _remove_normal(system, old.velocity))
            pull = system.viscosity @ jump
            numerical = numerical - 0.5 / dt * jnp.dot(increment - normal, pull)
        return Losses(impact_loss(system, dt, old, new), numerical)


def _remove_normal(system: System, x: Array) -> Array:
    """Return (I - Q) x, (n,)."""
    rows = massless_rows(system)
    return x - rows.transposed_product(rows @ x, system.size)
