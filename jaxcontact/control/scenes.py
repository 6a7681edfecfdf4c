"""Ready-made scenes, and the control problem of the paper's section 5."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.control.cost import TrackingCost
from jaxcontact.motion.memory import check_run_memory
from jaxcontact.motion.simulate import simulate
from jaxcontact.motion.stepper import Stepper, prepare
from jaxcontact.scene.ready_made import (
    RADIUS,
    RUBBER,
    ball_on_plane,
    bar_on_wall,
    bars,
    bumper,
    disc_in_bowl,
    half_disc,
    press,
    spinning_ball,
    tumbling_block,
    two_discs,
    two_half_discs,
)
from jaxcontact.scene.scene import Scene
from jaxcontact.system.discretize import discretize
from jaxcontact.system.system import System

__all__ = [
    "RADIUS",
    "RUBBER",
    "ControlProblem",
    "ball_on_plane",
    "bar_on_wall",
    "bars",
    "bumper",
    "disc_in_bowl",
    "half_disc",
    "half_disc_control",
    "press",
    "spinning_ball",
    "tumbling_block",
    "two_discs",
    "two_half_discs",
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ControlProblem:
    """The optimal control problem: find the volume force that makes the body follow a target."""

    scene: Scene
    """The body and its obstacle."""

    system: System
    """The discretised scene."""

    stepper: Stepper
    """The prepared time-stepping scheme."""

    reference: Array
    """The control that made the target, (T, N, d), before scaling."""

    target: Array
    """Desired displacement y_d, (T+1, N, d) [m]."""

    dt: float = field(metadata={"static": True})
    """Length of a time step tau, [s]."""

    steps: int = field(metadata={"static": True})
    """Number of time steps T."""

    control_scale: float = field(metadata={"static": True})
    """Force density of a control of one, [N/m^2]."""

    control_weight: float = field(metadata={"static": True})
    """Tychonoff parameter alpha."""

    final_weight: float = field(metadata={"static": True})
    """Weight gamma of the final-time observation."""

    def simulate(self, u: Array):
        """Return the trajectory of a control u (T, N, d), before scaling."""
        return simulate(self.stepper, self.control_scale * u)

    def cost(self) -> TrackingCost:
        """Return the tracking functional."""
        return TrackingCost(
            self.system,
            dt=self.dt,
            target=self.target,
            control_weight=self.control_weight,
            final_weight=self.final_weight,
        )

    def objective(self, u: Array) -> Array:
        """Return the reduced functional J(S(u), u) of a control u (T, N, d), a scalar."""
        return self.cost()(self.simulate(u), u)


def half_disc_control(
    h: float = RADIUS / 8,
    steps: int = 150,
    dt: float = 5e-5,
    gap: float = 0.8,
    *,
    control_scale: float = 1e6,
    control_weight: float = 1e-2,
    final_weight: float = 7.5e-4,
    dtype=jnp.float64,
    **prepare_options,
) -> ControlProblem:
    """Return the optimal control problem of the paper's section 5.

    The target is the motion under the reference control u = -e_n on the whole body at all times.

    Args:
        h: mesh size, [m].
        steps: number of time steps T; 150 or, for the horizon of 0.075 s, 1500.
        dt: length of a time step, [s].
        gap: height of the lowest point above the plane, [m].
        control_scale: force density of a control of one, [N/m^2].
        control_weight: Tychonoff parameter alpha.
        final_weight: weight gamma of the final-time observation.
        dtype: floating point type.
        **prepare_options: scheme and solvers, see `prepare`.

    Raises:
        ValueError: if the motion has no room in the memory, or as `discretize` and `prepare`.
    """
    scene = half_disc(h, gap)
    system = discretize(scene, dtype=dtype)
    stepper = prepare(system, dt, **prepare_options)
    # Before the reference takes as much.
    check_run_memory(stepper, steps)
    down = jnp.asarray(-np.eye(system.dimension)[-1], dtype)
    reference = jnp.broadcast_to(down, (steps, system.n_nodes, system.dimension))
    return ControlProblem(
        scene=scene,
        system=system,
        stepper=stepper,
        reference=reference,
        target=simulate(stepper, control_scale * reference).displacement,
        dt=dt,
        steps=steps,
        control_scale=control_scale,
        control_weight=control_weight,
        final_weight=final_weight,
    )
