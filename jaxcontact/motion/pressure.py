"""Contact pressure on the contact nodes: force over nodal area.

With the integral a_i of the hat function of node i over the contact set, the force c_i of a pair is
the integral of the pressure against that hat function, and p_i = c_i / a_i is its weighted mean
around the node. In 1D the area of a bar is one and p is the force.
"""

from __future__ import annotations

from jax import Array

from jaxcontact.motion.chatter import warn_of_chatter
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import Trajectory


def contact_pressure(stepper: Stepper, trajectory: Trajectory) -> Array:
    """Return the contact pressure of every step, (T, C) [N/m^(d-1)].

    It is impulse / (dt area), and `sum(pressure * area) * dt` is the impulse. What it is in time
    depends on the scheme: the mean over the step for `ContactImplicit`, `ContactStabilized` and
    `Trapezoidal` (there the mean of the forces at both ends), the value at the end of the step
    for `BackwardEuler` and `RedistributedMass`. With `ContactImplicit` the pressure chatters and
    does not converge: average it over some steps, or take `ContactStabilized`. Where it does, a
    `ChatterWarning` says so.

    Args:
        stepper: the stepper that made the trajectory.
        trajectory: T steps with C contact pairs.
    """
    warn_of_chatter(trajectory)
    return trajectory.contact_impulse / (stepper.dt * stepper.system.contact_area[None, :])
