"""What a simulation returns.

A motion is recorded in its unknowns, and nodal fields are lifted from them when they are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.contact import Status
from jaxcontact.motion.contact_record import ContactRecord
from jaxcontact.motion.frame_motion import FrameMotion, turning
from jaxcontact.motion.nodal_fields import NodalFields
from jaxcontact.motion.schedule import Schedule
from jaxcontact.motion.state import State
from jaxcontact.transforms.saved import save_dataclass
from jaxcontact.transforms.show import shown_by
from jaxcontact.transforms.traced import is_traced


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """The motion of a body over T steps; n unknowns, N nodes, C contact pairs, dimension d."""

    dt: Array
    """Length of a time step, scalar [s]."""

    time: Array
    """Time levels, (T+1,) [s]."""

    nodal: NodalFields
    """Unknowns and nodal fields, displacement and velocity."""

    gap: Array
    """Distance to the obstacle along the normal, (T+1, C) [m]; never negative beyond rounding."""

    contact_impulse: Array
    """Contact impulse lam of each step, (T, C) [N s]; lam / dt is the mean contact force."""

    contact: ContactRecord
    """How the contact problems of each step ended."""

    iterations: Array
    """Iterations of the contact solver, (T,) int32; the most of a contact problem of the step.
    Where bodies turn, the sweeps of the step."""

    status: Array
    """`Status` of each step, (T,) int32; the worst of its contact problems."""

    residual: Array
    """KKT residual of each step relative to the largest violation of its free motion, (T,)."""

    schedule: Schedule | None = None
    """What changed in time beside the control; `energy` reads it."""

    frames: FrameMotion | None = None
    """The frames of the bodies that turn; None without them (see `Scene.large_rotation`)."""

    mark: str = field(default="", metadata={"static": True})
    """What the unknowns stand for, `System.mark`."""

    @property
    def rotation(self) -> Array:
        """Rotation of each body that turns, (T+1, F, d, d); a ValueError if none does."""
        return turning(self.frames).rotation

    @property
    def centre(self) -> Array:
        """Mass centre of each body that turns, (T+1, F, d) [m]; a ValueError if none does."""
        return turning(self.frames).centre

    def _facts(self) -> dict[str, object]:
        if is_traced(self):
            return {"steps": self.contact_impulse.shape[-2], "values": "traced"}
        status, counts = np.unique(np.asarray(self.status), return_counts=True)
        total = np.asarray(self.contact_force).sum(axis=-1)
        return {
            "steps": total.shape[-1],
            "batch": "x".join(map(str, total.shape[:-1])),
            "end": f"{np.max(np.asarray(self.time)):.4g} s",
            "unknowns": self.unknowns.shape[-1],
            "contact_pairs": self.gap.shape[-1],
            "status": {
                Status(int(kind)).name.lower(): int(count)
                for kind, count in zip(status, counts, strict=True)
            },
            "largest_force": f"{np.max(total, initial=0.0):.4g} N",
        }

    __repr__, _repr_html_ = shown_by(_facts)

    @property
    def unknowns(self) -> Array:
        """The unknowns of the system, (T+1, n).

        Free displacement components [m], or coordinates in the space of a reduced model
        [m kg^1/2].
        """
        return self.nodal.unknowns

    @property
    def rates(self) -> Array:
        """Velocity of the unknowns, (T+1, n)."""
        return self.nodal.rates

    @property
    def displacement(self) -> Array:
        """Nodal displacement, (T+1, N, d) [m]; lifted from the unknowns when it is asked for."""
        return self.nodal.displacement

    @property
    def velocity(self) -> Array:
        """Nodal velocity, (T+1, N, d) [m/s]; lifted when it is asked for."""
        return self.nodal.velocity

    @property
    def contact_force(self) -> Array:
        """Contact force of each step, (T, C) [N]: impulse / dt; see `contact_pressure`."""
        return self.contact_impulse / self.dt[..., None, None]

    @property
    def active(self) -> Array:
        """Pairs with a closed gap at the end of the step, (T, C) bool."""
        return self.contact.active[..., 0, :]

    @property
    def weak(self) -> Array:
        """Pairs in weak contact in a contact problem of the step, (T, C) bool.

        There the motion has one-sided derivatives only; `derivative_report` lists what is nearly
        weak. `Trapezoidal` records the mean impulse of two times, but it is the force at the new
        time that decides here.
        """
        return jnp.any(self.contact.weak, axis=-2)

    @property
    def strong(self) -> Array:
        """Pairs in strong contact at the end of the step, (T, C) bool: closed under a force."""
        return self.active & ~self.weak

    @property
    def closing_speed(self) -> Array:
        """Largest speed at which a pair closes its gap before a touch, scalar [m/s].

        Of the four steps before: a smooth contact law slows a pair down before it counts as closed.
        Zero if nothing touches after the first step.

        Raises:
            ValueError: if not every state is recorded (`save_every`).
        """
        if self.gap.shape[-2] != self.contact_impulse.shape[-2] + 1:
            raise ValueError(
                "closing_speed needs the gap of every step; simulate with save_every=1"
            )
        is_closed = jnp.swapaxes(self.active, -2, -1)
        touches = is_closed[..., 1:] & ~is_closed[..., :-1]
        later = jnp.pad(touches, [(0, 0)] * (touches.ndim - 1) + [(0, 4)])
        is_before = sum(later[..., k : k + touches.shape[-1]] for k in range(4)) > 0
        speed = -jnp.diff(jnp.swapaxes(self.gap, -2, -1))[..., :-1] / self.dt[..., None, None]
        return jnp.max(jnp.where(is_before, speed, 0.0), axis=(-2, -1), initial=0.0)

    def save(self, path: str | Path) -> None:
        """Write the trajectory to an .npz file, which `load_trajectory` reads.

        If the writing fails or is killed, a file that was there before is still there.

        Raises:
            ValueError: if the trajectory is traced.
            OSError: if the file cannot be written.
        """
        if is_traced(self):
            raise ValueError("a traced Trajectory has no values to save; save it outside")
        save_dataclass(path, replace(self, nodal=self.nodal.stored()))

    @property
    def final(self) -> State:
        """The state after the last step."""
        return State(*self.nodal.at(-1))
