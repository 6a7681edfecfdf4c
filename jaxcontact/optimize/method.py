"""What an optimisation method is, and how it says that it has ended."""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar, Protocol, TypeVar, runtime_checkable

from jax import Array
from jax.core import Tracer

from jaxcontact.control.problem import Point, Problem


class Ending(StrEnum):
    """Why an optimisation ended; the value says what it means and what to do next."""

    CONVERGED = (
        "converged: the gradient norm is at most the tolerance times the one at the start; for "
        "more digits hand the result to optimize in place of u0 with a smaller tolerance"
    )
    STOPPED = (
        "stopped: the iterations are used up; to go on, hand the result to optimize in place of u0"
    )
    INTERRUPTED = (
        "interrupted: this is the best control so far; to go on, hand the result to optimize in "
        "place of u0"
    )
    FAILED = (
        "failed: an error ended the optimisation and this is the best control so far; mend its "
        "cause and hand the result to optimize in place of u0"
    )
    NO_DESCENT = (
        "no descent: no step along the direction of the method lowers the value, so this is a "
        "kink or a minimum; result.stationarity tells which, and jc.Homotopy() passes kinks"
    )
    VANISHED = (
        "vanished: the gradient is zero for all that may move, so this is a stationary point; "
        "start elsewhere to look for a better one"
    )
    NOT_FINITE = (
        "not finite: the objective or its gradient is not finite after an update; start from "
        "result.parameters with a smaller learning rate"
    )
    CERTIFIED = (
        "certified: strongly stationary to rounding, with the right sign of every multiplier; "
        "result.stationarity holds the certificate"
    )
    RELAXED = (
        "relaxed: the last relaxed problem is solved; for a smaller kappa hand the result to "
        "optimize in place of u0 with more levels"
    )
    RELAXED_NOT_FINITE = (
        "relaxed, not finite: the objective in relaxed contact is not finite at the next kappa; "
        "give another first_kappa, or a reduction nearer to one"
    )


#: None while a method goes on; under a trace, where it cannot be known, whether it has ended.
Outcome = Ending | Array | None


def outcome(is_better: Array, ending: Ending) -> Outcome:
    """Return how a method goes on that ends in one way only: where it finds nothing better."""
    if isinstance(is_better, Tracer):
        return ~is_better
    return None if is_better else ending


class MethodState(Protocol):
    """State of a method: a named tuple of arrays and Python numbers.

    Their shapes and types never change, so that it can be kept in a file.
    """

    @property
    def point(self) -> Point:
        """Current iterate."""
        ...


S = TypeVar("S", bound=MethodState)


@runtime_checkable
class Method(Protocol[S]):
    """An optimisation method: an option object with a pure step."""

    is_traceable: ClassVar[bool]
    """Whether `step` decides nothing on the host, so that `descend` can trace it."""

    def init(self, problem: Problem, point: Point) -> S:
        """Return the state at the start."""
        ...

    def step(self, problem: Problem, state: S) -> tuple[S, Outcome]:
        """Return the next state and no ending, or why there is none; the state is void then."""
        ...
