"""The tracking cost of the paper, (4.26) with the final-time observation of section 5.

    J(y, u) = tau/2 sum_k 1/2 (|y_{k-1} - y_d,{k-1}|^2 + |y_k - y_d,k|^2)
              + alpha/2 tau sum_k |u_k|^2 + gamma |y_T - y_d,T|^2        (gamma without 1/2)

in the L2 norm of the body, without density.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.inner_product import nodal_norms
from jaxcontact.sparse import SymmetricMatrix
from jaxcontact.system import System
from jaxcontact.trajectory import Trajectory


class TrackingCost:
    """Tracking-type cost functional, a function of trajectory and control."""

    def __init__(
        self,
        system: System,
        *,
        dt: float | Array,
        target: Array,
        control_weight: float | Array = 0.0,
        final_weight: float | Array = 0.0,
    ):
        """Define the functional.

        Args:
            system: the discretised scene.
            dt: length of a time step tau, [s].
            target: desired displacement y_d, (T+1, N, d) [m].
            control_weight: Tychonoff parameter alpha.
            final_weight: weight gamma of the final-time observation.

        Raises:
            ValueError: if the target does not have the shape (T+1, N, d).
        """
        shape = (system.n_nodes, system.dimension)
        if np.ndim(target) != 3 or np.shape(target)[1:] != shape:
            raise ValueError(
                f"target must have shape (T+1, N, d) = (T+1, {shape[0]}, {shape[1]}), got "
                f"{np.shape(target)}"
            )
        self.nodal_mass = system.nodal_mass
        self.dt = dt
        self.target = target
        self.control_weight = control_weight
        self.final_weight = final_weight

    def __call__(self, trajectory: Trajectory, control: Array | None = None) -> Array:
        """Return the value of the functional, a scalar.

        Args:
            trajectory: states of T steps.
            control: the control that is penalised, (T, N, d), before any scaling; None if there
                is none.

        Raises:
            ValueError: if the trajectory or the control does not have the T steps of the target.
        """
        steps = np.shape(self.target)[0] - 1
        if np.shape(trajectory.displacement) != np.shape(self.target):
            raise ValueError(
                f"the trajectory has displacements {np.shape(trajectory.displacement)}, the "
                f"target {np.shape(self.target)}; both must hold the same T+1 time levels"
            )
        if control is not None and np.shape(control) != (steps, *np.shape(self.target)[1:]):
            raise ValueError(
                f"control must have shape {(steps, *np.shape(self.target)[1:])}, got "
                f"{np.shape(control)}"
            )
        return _tracking_cost(
            self.nodal_mass,
            self.dt,
            self.target,
            self.control_weight,
            self.final_weight,
            trajectory.displacement,
            control,
        )


# Under jit with the arrays as arguments: nothing large is baked into a compiled program.
@jax.jit
def _tracking_cost(
    nodal_mass: SymmetricMatrix,
    dt: Array,
    target: Array,
    control_weight: Array,
    final_weight: Array,
    displacement: Array,
    control: Array | None,
) -> Array:
    errors = nodal_norms(nodal_mass, displacement - target)
    cost = 0.25 * dt * jnp.sum(errors[:-1] + errors[1:]) + final_weight * errors[-1]
    if control is not None:
        cost = cost + 0.5 * control_weight * dt * jnp.sum(nodal_norms(nodal_mass, control))
    return cost
