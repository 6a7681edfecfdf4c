"""The energy ledger of a simulation: where the energy of every step went.

With E = 1/2 v.Mv + 1/2 y.Ay, each step of a scheme satisfies an identity

    E' - E = work - viscous loss - impact loss - numerical loss        (to rounding)

with the scheme's own terms; `residual` is what is missing. What supports and obstacles that move
add to it is in `drive.py` and `supports.py`. Source: MATH.md 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.motion.checks import check_control, check_every_step
from jaxcontact.motion.drive import StepDrive, drive_of, every_step, flow_of_drive
from jaxcontact.motion.frame_motion import FrameMotion
from jaxcontact.motion.schedule import Schedule
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.supports import Flow, Moves, support_energy
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.schemes import StepState
from jaxcontact.schemes.terms import viscous_loss
from jaxcontact.system.control_space import control_loads
from jaxcontact.system.placing import rows_of_step
from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Energy:
    """Energies at the T+1 time levels and energy flows of the T steps, all [J]."""

    kinetic: Array
    """1/2 v.Mv, (T+1,) [J]."""

    elastic: Array
    """1/2 y.Ay, (T+1,) [J]; of bodies that turn 1/2 u.Au with the deformation u in their frames."""

    change: Array
    """E' - E of each step, (T,) [J], to the digits of the step: the difference of two `total` loses
    those of y.Ay, whose terms are (L/h)^2 times as large as their sum."""

    work: Array
    """Work of control, body force, traction, pressure, and of supports and obstacles that move, in
    each step, (T,) [J]."""

    viscous_loss: Array
    """Energy dissipated by the viscosity in each step, (T,) [J], not negative."""

    impact_loss: Array
    """Energy taken by the contact in each step, (T,) [J]."""

    numerical_loss: Array
    """Energy taken by the time discretisation in each step, (T,) [J]; zero for the schemes that
    are trapezoidal without contact."""

    residual: Array
    """What the ledger misses in each step, (T,) [J]; rounding only."""

    @property
    def total(self) -> Array:
        """Kinetic plus elastic energy, (T+1,) [J]."""
        return self.kinetic + self.elastic


def energy(stepper: Stepper, trajectory: Trajectory, control: Array | None = None) -> Energy:
    """Return the energy ledger of a trajectory.

    Args:
        stepper: the stepper that made the trajectory.
        trajectory: every state of it, T steps; it knows the schedule that made it.
        control: the control that made it, (T, N, d) or (T, n) [N/m^d].

    Returns:
        Energies and flows; the identity of the module docstring holds to rounding.

    Example:
        >>> stepper = jc.prepare(jc.discretize(jc.scenes.bar_on_wall()), 2e-6)
        >>> thrown = jc.State(velocity=jnp.full((21, 1), -202.2))
        >>> ledger = jc.energy(stepper, jc.simulate(stepper, steps=60, initial=thrown))
        >>> bool(jnp.all(jnp.abs(ledger.residual) < 1e-12 * ledger.total[0]))
        True

    Raises:
        ValueError: if the trajectory was recorded with a save_every other than 1, or is one of
            another system, or the control has another shape.
    """
    check_every_step(trajectory)
    unknowns, system = trajectory.unknowns, stepper.system
    if unknowns.shape[1:] != (system.size,) or trajectory.mark != system.mark:
        raise ValueError(
            f"the trajectory has {unknowns.shape[1]} unknowns, the system of the stepper "
            f"{system.size} of its own; hand over the stepper that made it"
        )
    if control is not None:
        check_control(control, system.points.shape, system.size, len(unknowns) - 1)
    records = (unknowns, trajectory.rates, trajectory.contact_impulse)
    return _ledger(stepper, *records, control, trajectory.schedule, trajectory.frames)


@in_full_precision
@jax.jit
def _ledger(
    stepper: Stepper,
    unknowns: Array,
    rates: Array,
    impulse: Array,
    control: Array | None,
    schedule: Schedule | None,
    frames: FrameMotion | None,
) -> Energy:
    system, operators, dt = stepper.system, stepper.operators, stepper.dt

    def nothing_yet(record: Array) -> Array:
        return jnp.concatenate([jnp.zeros_like(record[:1]), record])

    states = StepState(
        displacement=unknowns,
        velocity=rates,
        impulse=nothing_yet(impulse),
        guesses=(),
        frames=None if frames is None else frames.states,
    )

    drive = shapes = None
    if schedule is not None:
        drive, shapes = drive_of(system, dt, schedule)

    def measure(state: StepState, moves: Moves | None) -> tuple[Array, Array]:
        kinetic = 0.5 * jnp.dot(state.velocity, operators.mass @ state.velocity)
        elastic = 0.5 * jnp.dot(state.deformation, system.stiffness @ state.deformation)
        if shapes is None or shapes.supports is None or moves is None:
            return kinetic, elastic
        more = support_energy(shapes.supports, state, moves)
        return kinetic + more[0], elastic + more[1]

    def flow(old: StepState, new: StepState, added: Array | None, step: StepDrive | None) -> Flow:
        load = system.load if added is None else system.load + added
        velocity, deformation = old.velocity + new.velocity, old.deformation + new.deformation
        increment = new.displacement - old.displacement
        deforming = new.deformation - old.deformation
        change = 0.5 * (
            jnp.dot(new.velocity - old.velocity, operators.mass @ velocity)
            + jnp.dot(deforming, system.stiffness @ deformation)
        )
        rows = rows_of_step(system, old.displacement, new.displacement)
        here = replace(system, normals=replace(system.normals, weights=rows))
        losses = stepper.scheme.losses(here, operators, dt, old, new)
        numerical = jnp.asarray(losses.numerical, change.dtype)
        viscous = viscous_loss(system, dt, deforming)
        own = Flow(change, jnp.dot(increment, load), viscous, losses.impact, numerical)
        if shapes is None or step is None:
            return own
        more = flow_of_drive(stepper.scheme, system, dt, shapes, step, old, new)
        return jax.tree.map(jnp.add, own, more)

    levels = (states, None if drive is None else drive.moves)
    kinetic, elastic = jax.lax.map(lambda level: measure(*level), levels)
    old = jax.tree.map(lambda record: record[:-1], states)
    new = jax.tree.map(lambda record: record[1:], states)
    loads = None if control is None else control_loads(system, control)
    steps = (old, new, loads, None if drive is None else every_step(drive))
    flows = jax.lax.map(lambda step: flow(*step), steps)
    return Energy(
        kinetic=kinetic,
        elastic=elastic,
        change=flows.change,
        work=flows.work,
        viscous_loss=flows.viscous,
        impact_loss=flows.impact,
        numerical_loss=flows.numerical,
        residual=flows.change - (flows.work - (flows.viscous + flows.impact + flows.numerical)),
    )
