"""What a time-stepping scheme is: an option object that prepares operators and makes a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from jax import Array

from jaxcontact.contact import ContactProblem, Guess
from jaxcontact.system.sparse import SymmetricMatrix
from jaxcontact.system.system import System


class StepState(NamedTuple):
    """What one step hands to the next."""

    displacement: Array
    """y, (n,) [m]."""

    velocity: Array
    """v, (n,) [m/s]."""

    impulse: Array
    """Contact impulse lam of the last step, (C,) [N s]."""

    guess: Guess
    """Where the contact problem starts: the active pairs (C,) bool of the last step, and more."""

    memory: Any = ()
    """What else the scheme hands on, see `Scheme.memory`."""


class StepInfo(NamedTuple):
    """How the contact problems of a step were solved."""

    iterations: Array
    """Iterations of the contact solver, int32."""

    status: Array
    """Worst `Status` of the step, int32."""

    residual: Array
    """Largest relative KKT residual of the step, scalar."""

    weak: Array
    """Pairs in weak contact in a contact problem of the step, (C,) bool."""


class EnergyFlow(NamedTuple):
    """Where the energy of a step went; each scalar, [J]."""

    work: Array
    """Work of the loads on the body."""

    viscous_loss: Array
    """Energy dissipated by the viscosity, not negative."""

    impact_loss: Array
    """Energy taken by the contact (negative: contact has added energy)."""

    numerical_loss: Array | float = 0.0
    """Energy taken by the time discretisation away from contact; zero for most schemes."""


#: Makes the contact problem of an SPD matrix with the system's contact normals.
ProblemFactory = Callable[[SymmetricMatrix], ContactProblem]


class Scheme(Protocol):
    """A time-stepping scheme: static, hashable, without arrays."""

    def prepare(self, system: System, dt: Array, make_problem: ProblemFactory) -> Any:
        """Return the operators of the scheme, a pytree with at least `.mass`."""
        ...

    def memory(self, system: System, operators: Any) -> Any:
        """Return what a step must remember beside the state, at the start; () for most schemes."""
        ...

    def step(
        self, system: System, operators: Any, dt: Array, state: StepState, load: Array
    ) -> tuple[StepState, StepInfo]:
        """Advance by one step under the constant load (n,) [N]."""
        ...

    def energy_flow(
        self, system: System, operators: Any, dt: Array, old: StepState, new: StepState, load: Array
    ) -> EnergyFlow:
        """Return the energy flow of a step that was made."""
        ...
