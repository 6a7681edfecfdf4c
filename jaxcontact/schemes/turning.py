"""A step of any scheme on bodies that turn: its contact problems, where the bodies are.

A scheme states problems M w + h (A y + ...) + N^T p = r in velocities. Where bodies turn, the
elastic force is that of their frames, and gap and normals are those of the place at the start of
the step. A problem of the mass alone has no force that turns. Source: MATH.md 12.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from jax import Array

from jaxcontact.contact import ContactProblem
from jaxcontact.contact.turning import TurningProblem, turned_problem
from jaxcontact.schemes.interface import Operators, Scheme, StepResult, StepState
from jaxcontact.system.placing import placed
from jaxcontact.system.sparse import ComponentwiseMatrix
from jaxcontact.system.system import System


def make_step(
    scheme: Scheme, system: System, operators: Operators, dt: Array, state: StepState, load: Array
) -> StepResult:
    """Advance by one step, see `Scheme.step`; bodies that turn in their frames."""
    frames = system.frames
    if frames is None or state.frames is None or operators.spans is None:
        return scheme.step(system, operators, dt, state, load)
    here, turning, spans = placed(system, state.displacement), state.frames, operators.spans

    assert isinstance(operators.mass, ComponentwiseMatrix)
    places = system.points[system.contact_nodes] + system.normals.touched(state.displacement)
    more = (system.gap - frames.gap) / dt
    parts = (operators.mass, system.stiffness, frames, turning, state.velocity, places, more)

    def turned(number: int, problem: ContactProblem) -> ContactProblem | TurningProblem:
        problem = turned_problem(problem, here.normals)
        span = spans[number]
        return TurningProblem(problem, *parts, span * dt, dt) if span else problem

    # A scheme asks both kinds for the same: `solve` and `contact_solver`.
    problems: Any = tuple(turned(i, problem) for i, problem in enumerate(operators.problems))
    result = scheme.step(here, replace(operators, problems=problems), dt, state, load)
    # Nothing that a contact solver keeps of its compliance holds in the next step.
    solutions = tuple(x._replace(workspace=(), frames=()) for x in result.solutions)
    return result._replace(solutions=solutions, frames=result.solutions[0].frames)
