"""From a system to a stepper: choose the solvers, factorise once."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import (
    ContactProblem,
    ContactSolver,
    Perturbation,
    SemismoothNewton,
    contact_problem,
)
from jaxcontact.contact.turning import turning_factor
from jaxcontact.linear import (
    Factor,
    LinearSolver,
    check_memory,
    choose_linear_solver,
)
from jaxcontact.schemes import ContactImplicit, Operators, Scheme
from jaxcontact.system.courant import courant_number
from jaxcontact.system.rollers import hold_matrix
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.options import check_kind, check_option, is_positive_number
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.show import shown_by
from jaxcontact.transforms.traced import is_traced
from jaxcontact.transforms.trees import exchange

Tree = TypeVar("Tree")


class StepPerturbation(NamedTuple):
    """A change of the data of every step, zero but to be differentiated by; None is no change.

    T steps, P contact problems of a step (see `Operators.problems`), C contact pairs.
    """

    load: Array | None = None
    """Added to the load, (T, n) [N]."""

    gap: Array | None = None
    """Added to the gap psi, (T, P, C) [m]."""

    push: Array | None = None
    """Impulses that push the body away from the obstacle, (T, P, C) [N s]; see `Perturbation`."""

    is_open: Array | None = None
    """Pairs that are open in the derivative, whatever their state, (T, P, C) bool."""

    closed: Array | None = None
    """The pairs that keep contact in every step, whatever the signs, (T, P, C) bool; the motion is
    then affine in its data. None is contact."""

    def on(self, operators: Operators, dt: Array) -> Operators:
        """Return the perturbed operators of one step, whose part of the perturbation this is."""
        parts = (self.gap, self.push, self.is_open, self.closed)
        if all(part is None for part in parts):
            return operators

        def change(number: int, problem: ContactProblem) -> ContactProblem:
            gap, *others = (None if x is None else x[number] for x in parts)
            bound = None if gap is None else gap / dt
            return replace(problem, perturbation=Perturbation(bound, *others))

        return operators.changed(change)


#: The motion itself.
NO_PERTURBATION = StepPerturbation()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stepper:
    """Everything that `simulate` needs, made once by `prepare`."""

    system: System
    """The matrices of the scene."""

    dt: Array
    """Length of a time step tau, scalar [s]."""

    operators: Operators
    """What a step works with: the factors of the scheme's matrices and the contact solver."""

    scheme: Scheme = field(metadata={"static": True})
    """The time-stepping scheme."""

    linear_solver: LinearSolver = field(metadata={"static": True})
    """How the matrices were factorised."""

    perturbation: StepPerturbation = NO_PERTURBATION
    """What every step is perturbed by, for certificates of the derivative."""

    @property
    def contact_solver(self) -> ContactSolver:
        """How the contact problem of a step is solved."""
        return self.contact_problem.contact_solver

    @property
    def contact_problem(self) -> ContactProblem:
        """The contact problem whose solution is the contact at the end of a step."""
        return self.operators.problem

    def _facts(self) -> dict[str, object]:
        is_plain = self.system.basis is None and not is_traced((self.system, self.dt))
        return {
            "unknowns": self.system.size,
            "contact_pairs": self.system.normals.count,
            "dt": "" if is_traced(self.dt) else f"{np.asarray(self.dt):.4g} s",
            "courant": float(courant_number(self.system, self.dt)) if is_plain else None,
            "scheme": self.scheme,
            "linear_solver": self.linear_solver,
            "contact_solver": self.contact_solver,
        }

    __repr__, _repr_html_ = shown_by(_facts)


@in_full_precision
def prepare(
    system: System,
    dt: float | Array,
    *,
    scheme: Scheme | None = None,
    linear_solver: LinearSolver | None = None,
    contact_solver: ContactSolver | None = None,
) -> Stepper:
    """Factorise the matrices of a scheme once for all steps and for the adjoint.

    Traceable in the values of the system and in dt; the sparsity patterns must be concrete, so
    call it outside jit or with the topology closed over.

    Args:
        system: the discretised scene.
        dt: length of a time step, [s].
        scheme: time-stepping scheme, default `ContactImplicit()`.
        linear_solver: default chosen from the size of the system.
        contact_solver: default `SemismoothNewton()`.

    Returns:
        The stepper.

    Raises:
        ValueError: if dt is not positive, an option is not an object of its kind, the solvers do
            not fit each other, the patterns are traced, a factor would not fit in memory, or a
            matrix is not positive definite.
    """
    check_kind("prepare", system, System, "system = jc.discretize(scene)")
    scheme = ContactImplicit() if scheme is None else scheme
    check_option("scheme", scheme, Scheme, "ContactImplicit()")
    if not is_traced(dt) and not is_positive_number(dt):
        raise ValueError(f"dt must be a positive number of seconds, got {dt!r}")
    linear_solver, contact_solver = choose_solvers(system, linear_solver, contact_solver)
    dt = jnp.asarray(dt, system.dtype)
    mass, matrices, spans = scheme.matrices(system, dt)
    if system.frames is not None and spans is None:
        raise ValueError(
            f"{scheme} has no step for bodies that turn; with large_rotation=True use "
            "ContactImplicit(), ContactStabilized() or BackwardEuler()"
        )
    problems = tuple(factorize(system, x, linear_solver, contact_solver) for x in matrices)
    return Stepper(system, dt, Operators(mass, problems, spans), scheme, linear_solver)


def choose_solvers(
    system: System, linear_solver: LinearSolver | None, contact_solver: ContactSolver | None
) -> tuple[LinearSolver, ContactSolver]:
    """Return the solvers for a system, checked; None is the default.

    Raises:
        ValueError: if an option is not an object of its kind, the pattern of the system is traced,
            or a factor would not fit in memory.
    """
    shape = (system.size, system.dimension, system.dtype.itemsize)
    if linear_solver is None:
        linear_solver = choose_linear_solver(*shape, is_dense=system.basis is not None)
    if contact_solver is None:
        contact_solver = SemismoothNewton()
    check_option("linear_solver", linear_solver, LinearSolver, "NestedDissection()")
    check_option("contact_solver", contact_solver, ContactSolver, "SemismoothNewton()")
    if isinstance(system.stiffness.columns, Tracer):
        raise ValueError(
            "the sparsity pattern of the system is traced; call prepare outside jax.jit, or build "
            "mesh and scene inside the transformed function so that only values are traced"
        )
    check_memory(linear_solver, *shape)
    return linear_solver, contact_solver


def factorize(
    system: System,
    matrix: SymmetricMatrix,
    linear_solver: LinearSolver,
    contact_solver: ContactSolver,
) -> ContactProblem:
    """Return the contact problem of an SPD matrix with contact normals and rollers of a system.

    Raises:
        ValueError: if the matrix is concrete and not positive definite, or the solvers do not fit
            each other.
    """
    matrix = hold_matrix(system.rollers, matrix)
    values, weights = jax.lax.stop_gradient((matrix.values, system.normals.weights))
    rows = ContactNormals(weights, system.normals.unknowns)
    if system.frames is not None:
        rows = system.frames.nodal_rows(system.dtype)
    factor = linear_solver.factorize(
        SymmetricMatrix(values, matrix.columns), rows, _unknown_coordinates(system)
    )
    _check_factor(factor)
    if system.frames is not None:
        factor = turning_factor(factor, contact_solver, weights, system.frames.places)
    return contact_problem(matrix, system.normals, factor, contact_solver, system.rollers)


def with_contact(tree: Tree, contact_solver: ContactSolver) -> Tree:
    """Return a pytree in which every stepper solves contact by another contact solver.

    Args:
        tree: a stepper, or anything that holds one: an objective given as `jax.tree_util.Partial`
            of a function and a stepper, a problem such as `scenes.half_disc_control`.
        contact_solver: the solver to put in.

    Raises:
        ValueError: if the tree holds no stepper, the solver is not an object, or a stepper was
            prepared with a linear solver that it cannot work with.
    """
    check_option("contact_solver", contact_solver, ContactSolver, "SemismoothNewton()")

    def change(number: int, problem: ContactProblem) -> ContactProblem:
        del number
        parts = (problem.matrix, problem.normals, problem.form.factor)
        return contact_problem(*parts, contact_solver, problem.rollers)

    return exchange(
        tree, Stepper, lambda stepper: replace(stepper, operators=stepper.operators.changed(change))
    )


def with_perturbation(tree: Tree, perturbation: StepPerturbation) -> Tree:
    """Return a pytree in which every stepper is perturbed; see `StepPerturbation`.

    Raises:
        ValueError: if the tree holds no stepper.
    """
    return exchange(tree, Stepper, lambda stepper: replace(stepper, perturbation=perturbation))


def _unknown_coordinates(system: System) -> np.ndarray | None:
    """Return the positions of the unknowns, (n, d), if they are concrete and have any."""
    if isinstance(system.points, Tracer) or system.basis is not None:
        return None
    return np.repeat(np.asarray(system.points)[system.free_nodes], system.dimension, axis=0)


def _check_factor(factor: Factor) -> None:
    """Raise a ValueError if a concrete factor is not that of a positive definite matrix."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(factor)):
        return
    if not factor.is_positive:
        raise ValueError(
            "the matrix of the time step is not positive definite; are density and stiffness "
            "positive, and is no cell inverted or flat?"
        )
