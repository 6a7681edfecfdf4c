"""What a time-stepping scheme is: an option object that names its matrices and makes a step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import ContactProblem, Guess, Solution
from jaxcontact.system.frames import FrameState, initial_frames
from jaxcontact.system.rollers import hold
from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.trees import PyTree


class SchemeMatrices(NamedTuple):
    """What a scheme asks to be factorised."""

    mass: ComponentwiseMatrix | SymmetricMatrix
    """Mass matrix of the kinetic energy, (n, n) [kg]."""

    problems: tuple[SymmetricMatrix, ...]
    """The SPD matrix of each contact problem of a step, (n, n). The first one is that whose
    solution is the contact at the end of the step."""

    spans: tuple[float, ...] | None = None
    """h / tau of each matrix M + h B + h^2 A; None if they are of another form, with which bodies
    cannot turn."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Operators:
    """What a step works with, made from `SchemeMatrices` by `prepare`."""

    mass: ComponentwiseMatrix | SymmetricMatrix
    """Mass matrix of the kinetic energy, (n, n) [kg]."""

    problems: tuple[ContactProblem, ...]
    """The contact problems of a step, P of them, each with its matrix factorised."""

    spans: tuple[float, ...] | None = field(default=None, metadata={"static": True})
    """See `SchemeMatrices`."""

    @property
    def problem(self) -> ContactProblem:
        """The contact problem whose solution is the contact at the end of the step."""
        return self.problems[0]

    def changed(self, change: Callable[[int, ContactProblem], ContactProblem]) -> Operators:
        """Return operators with every contact problem replaced; `change` gets its number too."""
        changed = tuple(change(i, problem) for i, problem in enumerate(self.problems))
        return replace(self, problems=changed)


class StepState(NamedTuple):
    """What one step hands to the next."""

    displacement: Array
    """y, (n,) [m]."""

    velocity: Array
    """v, (n,) [m/s]."""

    impulse: Array
    """Contact impulse lam of the last step, (C,) [N s]."""

    guesses: tuple[Guess, ...]
    """Where each contact problem starts: what the last step ended with."""

    carry: PyTree = ()
    """What else the scheme hands on, see `Scheme.first_carry`."""

    frames: FrameState | None = None
    """The frames of bodies that turn; None without them."""

    @property
    def deformation(self) -> Array:
        """What the elastic energy is of, (n,) [m]: u in the frames, else y."""
        return self.displacement if self.frames is None else self.frames.deformation


class StepResult(NamedTuple):
    """What a step makes of a state."""

    displacement: Array
    """y', (n,) [m]."""

    velocity: Array
    """v', (n,) [m/s]."""

    impulse: Array
    """Contact impulse lam of the step, (C,) [N s]."""

    solutions: tuple[Solution, ...]
    """Solutions of the contact problems, in the order of `Operators.problems`."""

    carry: PyTree = ()
    """What else the scheme hands on, see `Scheme.first_carry`."""

    frames: FrameState | None = None
    """The frames of bodies that turn; None without them."""

    def state(self) -> StepState:
        """Return what the next step starts from."""
        guesses = tuple(solution.guess for solution in self.solutions)
        return StepState(
            self.displacement, self.velocity, self.impulse, guesses, self.carry, self.frames
        )


class Losses(NamedTuple):
    """Where energy was lost in a step beside viscosity; each scalar, [J]."""

    impact: Array
    """Energy taken by the contact (negative: contact has added energy)."""

    numerical: Array | float = 0.0
    """Energy taken by the time discretisation away from contact; zero for most schemes."""


@runtime_checkable
class Scheme(Protocol):
    """A time-stepping scheme: static, hashable, without arrays."""

    def matrices(self, system: System, dt: Array) -> SchemeMatrices:
        """Return the mass matrix of the ledger and the matrices of the contact problems."""
        ...

    def first_carry(self, system: System) -> PyTree:
        """Return what a step must remember beside the state, at the start; () for most schemes."""
        ...

    def step(
        self, system: System, operators: Operators, dt: Array, state: StepState, load: Array
    ) -> StepResult:
        """Advance by one step under the constant load (n,) [N]."""
        ...

    def losses(
        self, system: System, operators: Operators, dt: Array, old: StepState, new: StepState
    ) -> Losses:
        """Return what a step that was made has lost beside viscosity."""
        ...


@runtime_checkable
class OwnForces(Protocol):
    """A scheme that does not take elastic forces at the middle of a step."""

    def force_of_step(self, system: System, old: Array, new: Array, inertia: Array) -> Array:
        """Return what stands for a force on its right-hand side; see `force_of_step`."""
        ...


def force_of_step(scheme: Scheme, system: System, old: Array, new: Array, inertia: Array) -> Array:
    """Return the load (n,) [N] that stands in a step for elastic and inertia forces.

    Args:
        scheme: takes elastic forces at the middle of a step, if it has no `OwnForces`.
        system: the system.
        old: elastic force at the start of the step, (n,) [N].
        new: at its end.
        inertia: change of momentum per time, (n,) [N].
    """
    if isinstance(scheme, OwnForces):
        return scheme.force_of_step(system, old, new, inertia)
    return 0.5 * (old + new) + inertia


def first_state(
    scheme: Scheme, system: System, operators: Operators, displacement: Array, velocity: Array
) -> StepState:
    """Return the state at time zero, from y and v, (n,) each: nothing is in contact yet.

    Rollers take from it what they do not allow.
    """
    guesses = tuple(problem.form.first_guess() for problem in operators.problems)
    frames = None
    if system.frames is not None:
        frames = initial_frames(system.frames, displacement)
        # What a contact solver keeps is of a compliance, which turns from step to step.
        guesses = tuple(Guess(guess.active) for guess in guesses)
    return StepState(
        displacement=hold(system.rollers, displacement),
        velocity=hold(system.rollers, velocity),
        impulse=jnp.zeros(system.normals.count, system.dtype),
        guesses=guesses,
        carry=scheme.first_carry(system),
        frames=frames,
    )
