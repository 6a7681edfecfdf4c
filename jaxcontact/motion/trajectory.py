"""What a simulation returns, and what it may start from."""

from __future__ import annotations

from dataclasses import dataclass

import jax
from jax import Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """Displacement and velocity of a body at one time."""

    displacement: Array
    """Nodal displacement, (N, d) [m]; zero on clamped nodes."""

    velocity: Array
    """Nodal velocity, (N, d) [m/s]; zero on clamped nodes."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """The motion of a body over T steps; N nodes, C contact pairs, dimension d."""

    time: Array
    """Time levels, (T+1,) [s]."""

    displacement: Array
    """Nodal displacement, (T+1, N, d) [m]."""

    velocity: Array
    """Nodal velocity, (T+1, N, d) [m/s]."""

    gap: Array
    """Distance to the obstacle along the normal, (T+1, C) [m]; never negative beyond rounding."""

    contact_impulse: Array
    """Contact impulse lam of each step, (T, C) [N s]; lam / dt is the mean contact force."""

    active: Array
    """Pairs with a closed gap at the end of the step, (T, C) bool: strong and weak contact."""

    iterations: Array
    """Iterations of the contact solver, (T,) int32."""

    status: Array
    """`Status` of each step, (T,) int32."""

    residual: Array
    """KKT residual of each step relative to the largest violation of its free motion, (T,)."""

    weak: Array
    """Pairs in weak contact, closed without a force, in a contact problem of the step, (T, C) bool.

    There the motion has one-sided derivatives only. Gap and force count as zero below the rounding
    of the step's contact problem (`contact.complementarity.tolerance`). `derivative_report` lists
    what is nearly weak. `ContactStabilized` has two contact problems: its predictor may be in weak
    contact while the pair is open at the end of the step. `Trapezoidal` records the mean impulse of
    two times, but it is the force at the new time that decides here.
    """

    @property
    def strong(self) -> Array:
        """Pairs in strong contact at the end of the step, (T, C) bool: closed under a force."""
        return self.active & ~self.weak

    @property
    def final(self) -> State:
        """The state after the last step."""
        return State(self.displacement[-1], self.velocity[-1])
