"""The momentum ledger of bodies that turn: where linear and angular momentum came from.

With the impulse j = tau f - N^T lam on each node and xb = (x + x')/2, every step has

    P' - P = sum j,    L' - L = sum xb x j + sum (x' - x) x N^T mu,

mu the multiplier of a predictor; to rounding but for `BackwardEuler`, which loses angular momentum
of its own. Source: MATH.md 12.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.motion.checks import check_control, check_every_step
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.system.control_space import control_loads
from jaxcontact.system.frames import Frames
from jaxcontact.system.placing import gap_and_rows, rows_of_step
from jaxcontact.system.small_matrices import axial
from jaxcontact.system.sparse import ContactNormals
from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Momentum:
    """Momentum of F bodies with frames at T+1 levels, and what changed it in T steps.

    Angular momentum is about the origin, with s = d (d - 1) / 2 components: in the plane one,
    positive from the first axis to the second.
    """

    linear: Array
    """P, (T+1, F, d) [kg m/s]."""

    angular: Array
    """L, (T+1, F, s) [kg m^2/s]."""

    linear_impulse: Array
    """Impulse of loads and contact, (T, F, d) [N s]."""

    angular_impulse: Array
    """Its moment, (T, F, s) [N m s]."""

    linear_residual: Array
    """What the change of P misses in each step, (T, F, d) [kg m/s]; rounding only."""

    angular_residual: Array
    """What the change of L misses in each step, (T, F, s) [kg m^2/s]."""


def momentum(stepper: Stepper, trajectory: Trajectory, control: Array | None = None) -> Momentum:
    """Return the momentum ledger of a motion of bodies that turn.

    Args:
        stepper: the stepper that made the trajectory.
        trajectory: every state of it, T steps, without a schedule.
        control: the control that made it, (T, N, d) or (T, n) [N/m^d].

    Raises:
        ValueError: if no body turns (see `Scene.large_rotation`), the motion has a schedule or was
            recorded with a save_every other than 1, or the control has another shape.
    """
    check_every_step(trajectory)
    if stepper.system.frames is None or trajectory.frames is None:
        raise ValueError("no body has a frame; discretize a scene with large_rotation=True")
    if trajectory.schedule is not None:
        raise ValueError("the momentum ledger does not know the loads of a schedule")
    if control is not None:
        system = stepper.system
        check_control(control, system.points.shape, system.size, len(trajectory.contact_impulse))
    multiplier = trajectory.contact.multiplier
    predictor = multiplier[:, 1] if multiplier.shape[1] > 1 else jnp.zeros_like(multiplier[:, 0])
    records = (trajectory.unknowns, trajectory.rates, trajectory.contact_impulse, predictor)
    return _ledger(stepper, *records, control)


@in_full_precision
@jax.jit
def _ledger(
    stepper: Stepper,
    unknowns: Array,
    rates: Array,
    impulse: Array,
    predictor: Array,
    control: Array | None,
) -> Momentum:
    system, dt = stepper.system, stepper.dt
    frames = system.frames
    assert isinstance(frames, Frames)
    shape = frames.reference.shape
    reference = system.points[system.free_nodes].reshape(-1)
    ones = jnp.ones((shape[0], 1), unknowns.dtype)

    def linear(force: Array) -> Array:
        return frames.sums(force.reshape(shape), ones)[:, :, 0]

    def moment(place: Array, force: Array) -> Array:
        return axial(frames.sums(force.reshape(shape), place.reshape(shape)))

    def level(state: tuple[Array, Array]) -> tuple[Array, Array]:
        y, v = state
        momentum = stepper.operators.mass @ v
        return linear(momentum), moment(reference + y, momentum)

    def flow(step: tuple) -> tuple[Array, Array, Array, Array]:
        y, new, v, v_new, lam, mu, added = step
        rows = ContactNormals(rows_of_step(system, y, new), system.normals.unknowns)
        before = ContactNormals(gap_and_rows(system, y)[1], system.normals.unknowns)
        load = system.load if added is None else system.load + added
        pushed = dt * load - rows.transposed_product(lam, y.size)
        middle, increment = reference + 0.5 * (y + new), new - y
        taken = before.transposed_product(mu, y.size)
        angular = moment(middle, pushed) + moment(increment, taken)
        gained = stepper.operators.mass @ (v_new - v)
        change = moment(middle, gained)
        change = change + moment(increment, stepper.operators.mass @ (0.5 * (v + v_new)))
        return linear(pushed), angular, linear(gained), change

    loads = None if control is None else control_loads(system, control)
    P, L = jax.lax.map(level, (unknowns, rates))
    steps = (unknowns[:-1], unknowns[1:], rates[:-1], rates[1:], impulse, predictor, loads)
    pushed, turned, gained, change = jax.lax.map(flow, steps)
    return Momentum(P, L, pushed, turned, gained - pushed, change - turned)
