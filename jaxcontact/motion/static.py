"""Static contact: the displacement at which a held body is in equilibrium with its obstacles.

    A y + N^T c = f,    N y <= psi,    c >= 0,    c . (psi - N y) = 0,

the minimum of y.Ay/2 - f.y over the admissible displacements: the contact problem of a time step
with the stiffness matrix. Source: MATH.md 1 without inertia, Signorini's problem.

A body without a clamped node has a singular A. Where its obstacles hold it, the closed pairs S of
the equilibrium make A + c N_S^T N_S definite, with the same equilibrium under f + c N_S^T psi_S;
S is that of A + s M with a small s. The equilibrium is unique if no rigid motion leaves S alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import Bound, ContactProblem, ContactSolver, Solution, Status
from jaxcontact.linear import LinearSolver
from jaxcontact.motion.checks import KEEP_PAIR, SolveError, refuse_closed
from jaxcontact.motion.stepper import choose_solvers, factorize
from jaxcontact.schemes.mass_redistribution import rigid_fields
from jaxcontact.schemes.terms import gap_resolution
from jaxcontact.system.block_matrix import BlockMatrix, from_symmetric
from jaxcontact.system.bodies import body_numbers
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.traced import poison_unless

#: Singular values of the normal displacements of rigid motions of size one, above which a motion
#: is held.
HELD = 1e-5


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
        system: the discretised scene; what is not clamped must be held by the obstacles, without
            friction, under the load of the scene.
        linear_solver: factorises the stiffness matrix, default chosen from the size.
        contact_solver: default `SemismoothNewton()`.

    Returns:
        The equilibrium.

    Raises:
        ValueError: if a body is neither clamped nor held by its contact, an option is not an object
            of its kind, the solvers do not fit each other, or the stiffness matrix is not positive
            definite.
        SolveError: if the result is concrete and was not solved.
        Both are NaN under jit or grad where only values decide.

    Derivative: reverse mode by every value of the system, on the active set.
    """
    solvers = choose_solvers(system, linear_solver, contact_solver)
    rigid = _rigid_motions(system)
    if rigid.shape[1] == 0:
        problem = factorize(system, system.stiffness, *solvers)
        y, solution = _solve(system, problem, system.load)
    else:
        y, solution = _solve_held(system, rigid, *solvers)
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
def _solve(system: System, problem: ContactProblem, load: Array) -> tuple[Array, Solution]:
    """Return the unknowns (n,) of the equilibrium and the solution on the contact pairs."""
    return problem.solve(
        load,
        Bound(system.gap, gap_resolution(system, jnp.zeros_like(load))),
        problem.form.first_guess()._replace(active=system.gap < 0.0),
    )


def _rigid_motions(system: System) -> Array:
    """Return the rigid motions of the bodies without a clamped node, (n, r)."""
    d, free = system.dimension, np.asarray(system.free_nodes)
    body = body_numbers(system)
    held = np.unique(np.delete(body, free))
    motions = [jnp.zeros((system.n_nodes, d, 0), system.dtype)]
    for number in np.setdiff1d(np.unique(body), held):
        is_body = jnp.asarray(body == number)[:, None, None]
        fields = jnp.asarray(rigid_fields(system.points))[..., : d * (d + 1) // 2]
        motions.append(jnp.where(is_body, fields, 0.0))
    fields = jnp.concatenate(motions, axis=2)
    return jnp.moveaxis(jax.vmap(system.restrict, in_axes=2)(fields), 0, 1)


def _solve_held(
    system: System, rigid: Array, linear_solver: LinearSolver, contact_solver: ContactSolver
) -> tuple[Array, Solution]:
    """Return unknowns and solution where the contact holds the rigid motions (n, r)."""
    if system.basis is not None or not contact_solver.is_exact:
        raise ValueError(
            "a body without a clamped node can be solved for on its mesh and with exact contact "
            "only; clamp a facet set, or use the unreduced system and jc.SemismoothNewton()"
        )
    A, M = system.stiffness, system.mass.expand()
    stiff = jax.lax.stop_gradient(jnp.mean(A.diagonal()))
    shift = jnp.finfo(system.dtype).eps ** 0.5 * stiff / jnp.mean(M.diagonal())
    constant = jax.lax.stop_gradient((system, A + shift * M))
    problem = factorize(*constant, linear_solver, contact_solver)
    closed = _solve(constant[0], problem, constant[0].load)[1].multiplier > 0.0

    rows = jnp.where(closed[:, None], jax.vmap(lambda x: system.normals @ x, 1, 1)(rigid), 0.0)
    if system.rollers is not None:
        rollers = system.rollers
        rows = jnp.concatenate([rows, jax.vmap(lambda x: rollers @ x, 1, 1)(rigid)])
    n_held = jnp.sum(jnp.linalg.svd(rows, compute_uv=False) > HELD)
    _check_held(n_held, rigid.shape[1])
    weights, nodes = system.normals.weights, np.asarray(system.contact_nodes)
    weights = jnp.where(closed[:, None], weights, 0.0)
    numbers = np.asarray(system.node_numbers)[nodes]
    springs = BlockMatrix(numbers, numbers, stiff * weights[:, :, None] * weights[:, None, :])
    n_nodes, d = len(system.free_nodes), system.dimension
    matrix = from_symmetric(A, d).plus(springs).to_symmetric(n_nodes)
    preload = system.normals.transposed_product(jnp.where(closed, system.gap, 0.0), system.size)
    problem = factorize(system, matrix, linear_solver, contact_solver)
    y, solution = _solve(system, problem, system.load + stiff * preload)
    # Springs that are stretched would be a force from nowhere.
    is_equilibrium = jnp.all(solution.active | ~closed)
    status = jnp.where(is_equilibrium, solution.status, Status.NOT_CONVERGED)
    is_valid = is_equilibrium & (n_held == rigid.shape[1])
    y, multiplier = poison_unless(is_valid, (y, solution.multiplier))
    return y, solution._replace(status=status, multiplier=multiplier)


def _check_held(n_held: Array, n_rigid: int) -> None:
    if isinstance(n_held, Tracer) or int(n_held) == n_rigid:
        return
    raise ValueError(
        f"the contact holds {int(n_held)} of {n_rigid} rigid motions of what is not clamped, so "
        "that there is no unique equilibrium: without friction a body slides along a plane; clamp "
        "a facet set, or let jc.simulate with jc.BackwardEuler() come to rest"
    )


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
