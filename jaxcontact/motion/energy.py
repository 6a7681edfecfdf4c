"""The energy ledger of a simulation: where the energy of every step went.

With E = 1/2 v.Mv + 1/2 y.Ay, each step of a scheme satisfies an identity

    E' - E = work - viscous loss - impact loss - numerical loss        (to rounding)

with the scheme's own terms; `residual` is what is missing. Source: MATH.md 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.motion.checks import check_control, check_every_step
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.schemes import Losses, StepState
from jaxcontact.schemes.terms import viscous_loss
from jaxcontact.system.control_space import control_loads
from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Energy:
    """Energies at the T+1 time levels and energy flows of the T steps, all [J]."""

    kinetic: Array
    """1/2 v.Mv, (T+1,) [J]."""

    elastic: Array
    """1/2 y.Ay, (T+1,) [J]."""

    change: Array
    """E' - E of each step, (T,) [J], to the digits of the step: the difference of two `total` loses
    those of y.Ay, whose terms are (L/h)^2 times as large as their sum."""

    work: Array
    """Work of control, body force and traction in each step, (T,) [J]."""

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
        trajectory: every state of it, T steps.
        control: the control that made it, (T, N, d) or (T, n) [N/m^d].

    Returns:
        Energies and flows; the identity of the module docstring holds to rounding.

    Raises:
        ValueError: if the trajectory was recorded with a save_every other than 1, or is one of
            another system, or the control has another shape.
    """
    check_every_step(trajectory)
    unknowns, system = trajectory.unknowns, stepper.system
    if unknowns.shape[1:] != (system.size,):
        raise ValueError(
            f"the trajectory has unknowns {unknowns.shape}, the system of the stepper "
            f"{system.size}; hand over the stepper that made it"
        )
    if control is not None:
        check_control(system, control)
    return _ledger(stepper, unknowns, trajectory.rates, trajectory.contact_impulse, control)


@in_full_precision
@jax.jit
def _ledger(
    stepper: Stepper, unknowns: Array, rates: Array, impulse: Array, control: Array | None
) -> Energy:
    system, operators, dt = stepper.system, stepper.operators, stepper.dt

    def nothing_yet(record: Array) -> Array:
        return jnp.concatenate([jnp.zeros_like(record[:1]), record])

    states = StepState(
        displacement=unknowns,
        velocity=rates,
        impulse=nothing_yet(impulse),
        guesses=(),
    )

    def measure(state: StepState) -> tuple[Array, Array]:
        kinetic = 0.5 * jnp.dot(state.velocity, operators.mass @ state.velocity)
        elastic = 0.5 * jnp.dot(state.displacement, system.stiffness @ state.displacement)
        return kinetic, elastic

    def flow(
        old: StepState, new: StepState, added: Array | None
    ) -> tuple[Array, Array, Array, Losses]:
        load = system.load if added is None else system.load + added
        velocity, displacement = old.velocity + new.velocity, old.displacement + new.displacement
        increment = new.displacement - old.displacement
        change = 0.5 * (
            jnp.dot(new.velocity - old.velocity, operators.mass @ velocity)
            + jnp.dot(increment, system.stiffness @ displacement)
        )
        losses = stepper.scheme.losses(system, operators, dt, old, new)
        return change, jnp.dot(increment, load), viscous_loss(system, dt, increment), losses

    kinetic, elastic = jax.lax.map(measure, states)
    old = jax.tree.map(lambda record: record[:-1], states)
    new = jax.tree.map(lambda record: record[1:], states)
    loads = None if control is None else control_loads(system, control)
    change, work, viscous, losses = jax.lax.map(lambda step: flow(*step), (old, new, loads))
    numerical = jnp.asarray(losses.numerical, change.dtype)
    return Energy(
        kinetic=kinetic,
        elastic=elastic,
        change=change,
        work=work,
        viscous_loss=viscous,
        impact_loss=losses.impact,
        numerical_loss=numerical,
        residual=change - (work - (viscous + losses.impact + numerical)),
    )
