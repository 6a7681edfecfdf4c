"""Static contact: the displacement at which a held body is in equilibrium with its obstacles.

    A y + N^T c = f,    N y <= psi,    c >= 0,    c . (psi - N y) = 0,

the minimum of y.Ay/2 - f.y over the admissible displacements: the contact problem of a time step
with the stiffness matrix. Source: MATH.md 1 without inertia, Signorini's problem.

A body without a clamped node has a singular A. Then the proximal iteration with a small s

    (A + s M) y' + N^T c = f + s M y,    N y' <= psi,    c >= 0,    c . (psi - N y') = 0,

converges to an equilibrium if there is one and wanders off if not. On its closed pairs A the same
iteration with N_A y' = psi_A is linear, and is begun again at zero: what A does not hold stays
where it is, so that its limit is the equilibrium on A that is nearest to zero in the norm of M.
Errors of eigenvalue l shrink by s / (s + l) in each step.

Source: Rockafellar, SIAM J. Control Optim. 14 (1976) 877-898.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import Bound, ContactProblem, ContactSolver, Guess, Solution, Status
from jaxcontact.contact.saddle_point import Fixed, solve_on_cone
from jaxcontact.linear import LinearSolver
from jaxcontact.motion.checks import KEEP_PAIR, SolveError, refuse_closed
from jaxcontact.motion.stepper import choose_solvers, factorize
from jaxcontact.schemes.terms import gap_resolution
from jaxcontact.system.bodies import body_numbers
from jaxcontact.system.rollers import hold
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.traced import poison_unless

#: s in units of tr A / tr M, and the relative change at which the iteration has converged: powers
#: of the unit roundoff, 1e-6 and 2e-10 in float64.
SHIFT, SETTLED = 3 / 8, 5 / 8
#: Steps that look for the closed pairs, and linear ones on them: (L / h)^2 s / 10 is the slowest
#: rate on a body of L / h cells, 1e-3 for 100 of them.
MAX_SEARCHES, STEPS = 30, 12
#: How far ahead of the last step the next one starts, in changes, while all moves on steadily: from
#: any height a body falls to its obstacle by ways that double.
AHEAD = 2.0


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

    A body without clamped nodes must be in balance with what its contact can carry, without
    friction. Where it may slide, the equilibrium is that nearest to the undeformed place.

    Args:
        system: the discretised scene.
        linear_solver: factorises the stiffness matrix, default chosen from the size.
        contact_solver: default `SemismoothNewton()`.

    Returns:
        The equilibrium.

    Raises:
        ValueError: if an option is not an object of its kind, the solvers do not fit each other, a
            body without clamped nodes is to be solved for with soft contact, the stiffness
            matrix is not positive definite, or bodies turn.
        SolveError: if the result is concrete and was not solved, or there is no equilibrium.
        Both are NaN under jit or grad where only values decide.

    Derivative: reverse mode by every value of the system, on the active set. A change that pushes
    along a motion which nothing holds has no equilibrium, and no derivative either.
    """
    if system.frames is not None:
        raise ValueError(
            "the static problem is one of small displacements; discretize the scene without "
            "large_rotation=True"
        )
    solvers = choose_solvers(system, linear_solver, contact_solver)
    loose = _loose_bodies(system)
    if not loose:
        problem = factorize(system, system.stiffness, *solvers)
        y, solution = _solve(system, problem)
    else:
        y, solution = _solve_loose(system, loose, *solvers)
    (y, force), status = refuse_closed(system, y, (y, solution.multiplier), solution.status)
    _check(status)
    return StaticContact(
        displacement=system.lift(y),
        contact_force=force,
        contact_pressure=force / system.contact_area,
        gap=system.gap - system.normals @ y,
        active=solution.active,
        status=status,
    )


@jax.jit
def _solve(system: System, problem: ContactProblem) -> tuple[Array, Solution]:
    """Return the unknowns (n,) of the equilibrium and the solution on the contact pairs."""
    return problem.solve(
        system.load,
        Bound(system.gap, gap_resolution(system, jnp.zeros_like(system.load))),
        problem.form.first_guess()._replace(active=system.gap < 0.0),
    )


def _loose_bodies(system: System) -> list[np.ndarray]:
    """Return the nodes of each body without a clamped node."""
    body = body_numbers(system)
    held = np.delete(body, np.asarray(system.free_nodes))
    return [np.flatnonzero(body == number) for number in np.setdiff1d(body, held)]


class _Search(NamedTuple):
    """The proximal iteration for the closed pairs."""

    displacement: Array
    """y, (n,) [m]."""

    centre: Array
    """Where the next step is bound to, (n,) [m]: y, or beyond it while all moves on steadily."""

    change: Array
    """Last change of y, (n,) [m]."""

    solution: Solution
    """Solution on the contact pairs."""

    steps: Array
    """Steps so far, int32."""


def _solve_loose(
    system: System,
    loose: list[np.ndarray],
    linear_solver: LinearSolver,
    contact_solver: ContactSolver,
) -> tuple[Array, Solution]:
    """Return unknowns and solution where some bodies have no clamped node."""
    if not contact_solver.is_exact:
        raise ValueError(
            "a body without a clamped node can be solved for with exact contact only; clamp a "
            "facet set, or use jc.SemismoothNewton()"
        )
    diagonals = jax.lax.stop_gradient((system.stiffness.diagonal(), system.mass.diagonal()))
    eps = float(jnp.finfo(system.dtype).eps)
    shift = eps**SHIFT * jnp.mean(diagonals[0]) / jnp.mean(diagonals[1])
    matrix = shift * (system.mass + (1.0 / shift) * system.stiffness)
    problem = factorize(system, matrix, linear_solver, contact_solver)
    found = _search(*jax.lax.stop_gradient((system, problem, shift)))
    y, p, last = _settle(system, problem, found.solution.active)

    gap, size = system.gap - system.normals @ y, jnp.max(jnp.abs(y))
    noise = eps**SETTLED * size + gap_resolution(system, y)
    is_settled = _size(last) <= eps**SETTLED * size
    is_equilibrium = is_settled & jnp.all(gap >= -noise) & jnp.all(p >= -(eps**SETTLED) * _size(p))
    solved = found.solution.status
    status = jnp.where(is_equilibrium, solved, jnp.maximum(solved, Status.NOT_CONVERGED))
    is_found = _size(found.change) <= eps**SETTLED * _size(found.displacement)
    moving = system.lift(jnp.where(is_found, last, found.change))
    if not isinstance(status, Tracer) and int(solved) <= Status.FALLBACK < int(status):
        raise SolveError(_without_equilibrium(system, loose, np.asarray(moving)))
    y, p = poison_unless(status <= Status.FALLBACK, (y, jnp.maximum(p, 0.0)))
    return y, found.solution._replace(status=status, multiplier=p)


@jax.jit
def _search(system: System, problem: ContactProblem, shift: Array) -> _Search:
    """Return the proximal iteration where it has converged, or after `MAX_SEARCHES` steps."""
    tolerance = float(jnp.finfo(system.dtype).eps) ** SETTLED

    def step(y: Array, centre: Array, guess: Guess) -> tuple[Array, Solution]:
        bound = Bound(system.gap, gap_resolution(system, y))
        return problem.solve(system.load + shift * (system.mass @ centre), bound, guess)

    def is_unfinished(search: _Search) -> Array:
        is_moving = _size(search.change) > tolerance * _size(search.displacement)
        is_solved = search.solution.status <= Status.FALLBACK
        return is_solved & is_moving & (search.steps < MAX_SEARCHES)

    def advance(search: _Search) -> _Search:
        y, solution = step(search.displacement, search.centre, search.solution.guess)
        change = y - search.displacement
        is_steady = jnp.vdot(change, search.change) > 0.5 * jnp.vdot(search.change, search.change)
        centre = jnp.where(is_steady, y + AHEAD * change, y)
        return _Search(y, centre, change, solution, search.steps + 1)

    nothing = jnp.zeros_like(system.load)
    guess = problem.form.first_guess()._replace(active=system.gap < 0.0)
    y, solution = step(nothing, nothing, guess)
    start = _Search(y, y, y, solution, jnp.int32(1))
    return jax.lax.while_loop(is_unfinished, advance, start)


@jax.jit
def _settle(system: System, problem: ContactProblem, pairs: Array) -> tuple[Array, Array, Array]:
    """Return y (n,) and the force (C,) of the limit on closed pairs (C,) bool, and the last change.

    Every step solves for the change, whose rounding errors are smaller than those of y.
    """
    normals, n = system.normals, system.size
    fixed = Fixed(problem.matrix.columns, normals.unknowns, problem.form, None, None, None)

    def step(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        y, p = state
        rest = system.load - system.stiffness @ y - normals.transposed_product(p, n)
        rest = hold(system.rollers, rest)
        change, push = solve_on_cone(
            problem.matrix.values,
            normals.weights,
            fixed,
            pairs,
            None,
            rest,
            system.gap - normals @ y,
        )
        change = hold(system.rollers, change)
        return (y + change, p + push), change

    start = jnp.zeros_like(system.load), jnp.zeros_like(system.gap)
    (y, p), changes = jax.lax.scan(step, start, None, length=STEPS)
    return y, p, changes[-1]


def _size(x: Array) -> Array:
    return jnp.max(jnp.abs(x), initial=0.0)


def _without_equilibrium(system: System, loose: list[np.ndarray], moving: np.ndarray) -> str:
    """Return what moves on, by its mean change (N, d)."""
    means = [moving[nodes].mean(axis=0) for nodes in loose]
    worst = int(np.argmax([np.linalg.norm(mean) for mean in means]))
    centre = np.asarray(system.points)[loose[worst]].mean(axis=0)
    direction = means[worst] / max(float(np.linalg.norm(means[worst])), np.finfo(float).tiny)
    return (
        f"no equilibrium was found: the body around {_listed(centre)} moves on along "
        f"{_listed(direction)}, since its load is not carried by its contact, which has no "
        "friction; clamp a facet set, add an obstacle, or let jc.simulate with "
        "jc.BackwardEuler() show where it goes"
    )


def _listed(x: np.ndarray) -> str:
    return "(" + ", ".join(f"{entry:.3g}" for entry in x) + ")"


def _check(status: Array) -> None:
    if isinstance(status, Tracer):
        return
    if int(status) == Status.NON_FINITE:
        raise ValueError(
            "the stiffness matrix is not positive definite; is enough clamped that the body cannot "
            "move rigidly, and is no cell inverted or flat?"
        )
    if int(status) == Status.PENETRATES:
        raise SolveError(KEEP_PAIR)
    if int(status) == Status.NOT_CONVERGED:
        raise SolveError(
            "static contact was not solved; allow more steps, for instance "
            "contact_solver=jc.SemismoothNewton(max_steps=100)"
        )
