"""Static contact: the displacement at which a held body is in equilibrium with its obstacles.

    A y + N^T c = f,    N y <= psi,    c >= 0,    c . (psi - N y) = 0,

the minimum of y.Ay/2 - f.y over the admissible displacements: the contact problem of a time step
with the stiffness matrix. Source: MATH.md 1 without inertia, Signorini's problem.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import Bound, ContactProblem, ContactSolver, Solution, Status
from jaxcontact.linear import LinearSolver
from jaxcontact.motion.checks import SolveError
from jaxcontact.motion.stepper import choose_solvers, factorize
from jaxcontact.schemes.terms import gap_resolution
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StaticContact:
    """A static equilibrium; N nodes, C contact pairs, dimension d."""

    displacement: Array
    """Nodal displacement, (N, d) [m]; zero on clamped nodes."""

    contact_force: Array
    """Contact force of each pair, (C,) [N]; not negative, along -normal on the body."""

    contact_pressure: Array
    """Contact force over nodal area, (C,) [N/m^(d-1)]."""

    gap: Array
    """Distance to the obstacle along the normal, (C,) [m]."""

    active: Array
    """Pairs with a closed gap, (C,) bool."""

    status: Array
    """A `Status`, int32."""


@in_full_precision
def solve_static(
    system: System,
    *,
    linear_solver: LinearSolver | None = None,
    contact_solver: ContactSolver | None = None,
) -> StaticContact:
    """Solve the static contact problem under the constant load of the scene.

    The gap of the system may be negative: then the obstacle has been pushed into the body, which
    is how a body is pressed on it with a given displacement.

    Args:
        system: the discretised scene, clamped so that it cannot move rigidly.
        linear_solver: factorises the stiffness matrix, default chosen from the size.
        contact_solver: default `SemismoothNewton()`.

    Returns:
        The equilibrium.

    Raises:
        ValueError: if no node is clamped, an option is not an object of its kind, the solvers do
            not fit each other, or the stiffness matrix is not positive definite.
        SolveError: if the result is concrete and was not solved; under jit or grad it is NaN.

    Derivative: reverse mode by every value of the system, on the active set.
    """
    if len(system.free_nodes) == system.n_nodes:
        raise ValueError(
            "no node is clamped, so the body can move rigidly and has no unique equilibrium; clamp "
            "a facet set, or let jc.simulate with jc.BackwardEuler() come to rest"
        )
    solvers = choose_solvers(system, linear_solver, contact_solver)
    problem = factorize(system, system.stiffness, *solvers)
    y, solution = _solve(system, problem)
    _check(solution.status)
    return StaticContact(
        displacement=system.lift(y),
        contact_force=solution.multiplier,
        contact_pressure=solution.multiplier / system.contact_area,
        gap=system.gap - system.normals @ y,
        active=solution.active,
        status=solution.status,
    )


@jax.jit
def _solve(system: System, problem: ContactProblem) -> tuple[Array, Solution]:
    """Return the unknowns (n,) of the equilibrium and the solution on the contact pairs."""
    return problem.solve(
        system.load,
        Bound(system.gap, gap_resolution(system, jnp.zeros_like(system.load))),
        problem.form.first_guess()._replace(active=system.gap < 0.0),
    )


def _check(status: Array) -> None:
    if isinstance(status, Tracer):
        return
    if int(status) == Status.NON_FINITE:
        raise ValueError(
            "the stiffness matrix is not positive definite; is enough clamped that the body cannot "
            "move rigidly, and is no cell inverted or flat?"
        )
    if int(status) == Status.NOT_CONVERGED:
        raise SolveError(
            "static contact was not solved; allow more steps, for instance "
            "contact_solver=jc.SemismoothNewton(max_steps=100)"
        )
