"""The contact problem of a step of bodies that turn, as a scheme sees it. Source: MATH.md 12."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.contact.complementarity import ContactSolver, Guess, Solution, Status
from jaxcontact.contact.sweep_adjoint import solve_by_sweeps
from jaxcontact.contact.sweeps import Equation, Fixed, contact_at, turned_form
from jaxcontact.contact.vi import Bound, ContactProblem
from jaxcontact.linear import Factor, can_condense
from jaxcontact.linear.turned import TurnedFactor, turned_factor
from jaxcontact.system.frames import Frames, FrameState, frame_start, next_frames, turn
from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TurningProblem:
    """The contact problem of a step of bodies that turn; see `ContactProblem`."""

    problem: ContactProblem
    """D with the contact normals at the start of the step."""

    mass: ComponentwiseMatrix
    """M, (n, n)."""

    stiffness: SymmetricMatrix
    """A, (n, n)."""

    frames: Frames
    """The bodies that turn."""

    state: FrameState
    """R and u at the start of the step."""

    velocity: Array
    """Where the sweeps start, (n,)."""

    places: Array
    """Places of the contact nodes at the start of the step, (C, d) [m]."""

    more: Array
    """What b is larger by than the distance over tau, (C,) [m/s]."""

    span: Array
    """h, scalar [s]."""

    dt: Array
    """tau, scalar [s]."""

    @property
    def contact_solver(self) -> ContactSolver:
        """How the contact problem of a sweep is solved."""
        return self.problem.contact_solver

    def solve(self, rhs: Array, bound: Bound, guess: Guess) -> tuple[Array, Solution]:
        """Solve (4); see `ContactProblem.solve`. The iterations of the solution count sweeps.

        Derivative: reverse mode, with respect to everything but the factor. The backward pass
        keeps w, W, r, b and the active set of the step.
        """
        shift, push, *_ = self.problem.perturbation
        value = bound.value if shift is None else bound.value + shift
        more = self.more if shift is None else self.more + shift
        normals = self.problem.normals
        assert normals.unknowns is not None
        if push is not None:
            rhs = rhs - normals.transposed_product(push, rhs.shape[0])
        equation = Equation(
            self.problem.matrix,
            self.mass,
            self.stiffness,
            self.frames,
            self.state,
            normals.weights,
            rhs,
            value,
            self.places,
            more,
            self.span,
            self.dt,
        )
        fixed = Fixed(
            self.problem.form,
            normals.unknowns,
            bound.resolution,
            guess,
            self.velocity,
            self.problem.perturbation,
        )
        unknowns, solution = solve_by_sweeps(equation, jax.lax.stop_gradient(fixed))
        poison = jnp.where(solution.status <= Status.FALLBACK, 1.0, jnp.nan).astype(rhs.dtype)
        w = unknowns.velocity * poison
        start = frame_start(self.frames, self.state)
        nodal = w.reshape(start.places.shape)
        step, increment = turn(self.frames, start, self.dt, nodal, unknowns.increment)
        weights, value = contact_at(equation, fixed, w)
        multiplier = solution.multiplier if push is None else solution.multiplier + push
        return w, solution._replace(
            multiplier=multiplier * poison,
            separation=value - ContactNormals(weights, normals.unknowns) @ w,
            frames=next_frames(self.frames, self.state, self.dt, step, increment),
        )


def check_turning(contact_solver: ContactSolver) -> None:
    """Raise a ValueError for a law that contains the compliance of its pairs."""
    if contact_solver.uses_compliance:
        raise ValueError(
            f"{contact_solver} is a law of the compliance of its pairs, which turns with the body; "
            "with large_rotation=True use jc.SemismoothNewton()"
        )


def turning_factor(
    factor: Factor, contact_solver: ContactSolver, weights: Array, places: np.ndarray | None
) -> TurnedFactor:
    """Return the factor for contact rows (C, d) that turn; see `turned_factor`.

    Raises:
        ValueError: if the solvers do not know contact rows that turn.
    """
    if not can_condense(factor):
        raise ValueError(
            "conjugate gradients do not know normals that turn; with large_rotation=True prepare "
            "with linear_solver=jc.NestedDissection()"
        )
    check_turning(contact_solver)
    return turned_factor(factor, weights, places)


def turned_problem(problem: ContactProblem, normals: ContactNormals) -> ContactProblem:
    """Return a prepared problem with other normals at the same nodes, N (C, n)."""
    check_turning(problem.contact_solver)
    if not normals.count:
        return problem
    form = turned_form(problem.form, jax.lax.stop_gradient(normals.weights))
    return replace(problem, normals=normals, form=form)
