"""From a system to a stepper: choose the solvers, factorise once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.contact import ContactProblem, ContactSolver, SemismoothNewton
from jaxcontact.linear import Factor, LinearSolver, check_memory, choose_linear_solver
from jaxcontact.schemes import ContactImplicit, Scheme
from jaxcontact.system.sparse import SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stepper:
    """Everything that `simulate` needs, made once by `prepare`."""

    system: System
    """The matrices of the scene."""

    dt: Array
    """Length of a time step tau, scalar [s]."""

    operators: Any
    """Operators of the scheme, with the factor of its matrix."""

    scheme: Scheme = field(metadata={"static": True})
    """The time-stepping scheme."""

    linear_solver: LinearSolver = field(metadata={"static": True})
    """How the matrix was factorised."""

    contact_solver: ContactSolver
    """How the contact problem of a step is solved."""

    def __repr__(self) -> str:
        """Return the choices that were made, without arrays."""
        return (
            f"Stepper(n={self.system.size}, contact_pairs={self.system.normals.count}, "
            f"scheme={self.scheme}, linear_solver={self.linear_solver}, "
            f"contact_solver={self.contact_solver})"
        )


#: What to write where a name was given for an option.
EXAMPLES = {
    "scheme": "ContactImplicit",
    "linear_solver": "NestedDissection",
    "contact_solver": "SemismoothNewton",
}


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
        ValueError: if dt is not positive, an option is a class instead of an object, the patterns
            are traced, a factor would not fit in memory, or a matrix is not positive definite.
    """
    scheme = ContactImplicit() if scheme is None else scheme
    contact_solver = SemismoothNewton() if contact_solver is None else contact_solver
    shape = (system.size, system.dimension, system.dtype.itemsize)
    if linear_solver is None:
        linear_solver = choose_linear_solver(*shape, is_dense=system.basis is not None)
    for name, option in (
        ("scheme", scheme),
        ("linear_solver", linear_solver),
        ("contact_solver", contact_solver),
    ):
        if isinstance(option, type | str):
            example = option.__name__ if isinstance(option, type) else EXAMPLES[name]
            raise ValueError(f"{name} must be an object, such as jc.{example}(), got {option!r}")
    if not isinstance(dt, Tracer) and not (np.isfinite(dt) and np.asarray(dt) > 0.0):
        raise ValueError(f"dt must be a positive number of seconds, got {dt}")
    if isinstance(system.stiffness.columns, Tracer):
        raise ValueError(
            "the sparsity pattern of the system is traced; call prepare outside jax.jit, or build "
            "mesh and scene inside the transformed function so that only values are traced"
        )
    check_memory(linear_solver, *shape)
    dt = jnp.asarray(dt, system.dtype)
    coordinates = unknown_coordinates(system)

    def make_problem(matrix: SymmetricMatrix) -> ContactProblem:
        frozen = jax.lax.stop_gradient((matrix.values, system.normals.weights))
        factor = linear_solver.factorize(
            SymmetricMatrix(frozen[0], matrix.columns),
            type(system.normals)(frozen[1], system.normals.unknowns),
            coordinates,
        )
        _check_factor(factor)
        return ContactProblem(matrix, system.normals, factor, contact_solver)

    operators = scheme.prepare(system, dt, make_problem)
    return Stepper(system, dt, operators, scheme, linear_solver, contact_solver)


def unknown_coordinates(system: System) -> np.ndarray | None:
    """Return the positions of the unknowns, (n, d), if they are concrete and have any."""
    if isinstance(system.points, Tracer) or system.basis is not None:
        return None
    return np.repeat(np.asarray(system.points)[system.free_nodes], system.dimension, axis=0)


def _check_factor(factor: Factor) -> None:
    """Check a concrete factor by what it says of itself."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(factor)):
        return
    if not factor.is_positive:
        raise ValueError(
            "the matrix of the time step is not positive definite; are density and stiffness "
            "positive, and is no cell inverted or flat?"
        )
