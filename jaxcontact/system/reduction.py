"""Reduced models: Galerkin projection that keeps every structural property of the full system.

The space holds the lowest free vibrations, A phi = omega^2 M phi, and what they cannot follow: the
static responses A z = N^T e_i to a unit force on each contact pair, without which the deformation
at the contact does not converge, and A z = f to every load that is known. With the responses
D z = N^T e_i of one time step, D = M + tau/2 B + tau^2/4 A, the contact problem of a step has the
compliance N D^-1 N^T of the full system. Dissipation, the contact problem and the exact adjoint
carry over, because the reduced system is again a system.
Source: Craig, Bampton, AIAA J. 6 (1968); MacNeal, Comput. Struct. 1 (1971); MATH.md 10.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.system.basis import Basis, mark_of
from jaxcontact.system.pair_set import pair_numbers
from jaxcontact.system.reduced_space import HostSystem, Target, space
from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.traced import is_traced


class Motion(Protocol):
    """A motion to learn from: a `Trajectory`."""

    @property
    def displacement(self) -> Array:
        """Nodal displacement, (T+1, N, d) [m]."""
        ...


def reduce(
    system: System,
    modes: int | None = None,
    *,
    frequency: float | None = None,
    tolerance: float | None = None,
    loads: Sequence[ArrayLike] = (),
    pairs: ArrayLike | None = None,
    step_responses: float | None = None,
    training: Sequence[Motion] = (),
) -> System:
    """Project a system on its lowest modes and its responses to contact and load.

    The space is computed once on the host, from concrete matrices; with m modes, C pairs that can
    touch and p loads it has at most m + C + p dimensions, 2 C with step responses. In three
    dimensions modes buy much less accuracy than in two.

    Args:
        system: the full system, with concrete matrices.
        modes: number m of free vibrations; or one of the next two.
        frequency: take all free vibrations up to this frequency, [Hz].
        tolerance: take as many as a relative error of the displacement of about this size needs,
            between 0 and 1: they leave this part of the first correction A^-1 M A^-1 f of a static
            response by inertia, in the norm of the elastic energy, for every load f that is known
            and for a uniform contact pressure. `reduction_error` measures the error.
        loads: patterns of the force density that will act, each (N, d) [N/m^d]; the load of the
            scene is known already.
        pairs: pairs that can touch, see `System.with_pairs`; None is all of them.
        step_responses: length of the time step, [s], with which the step responses are made; for
            forces and impulses that are right in every step.
        training: trajectories of similar motions; their principal components take the place of
            the upper half of the modes.

    Returns:
        A system with dense matrices, used like any other. Displacements keep their shapes;
        controls are (T, N, d) or, in the reduced space, (T, n), see `System.restrict_control`.

    Raises:
        ValueError: if the system is traced, reduced already or has bodies that turn, not exactly
            one of modes, frequency and tolerance is given, or an argument is out of its range.
    """
    if system.basis is not None:
        raise ValueError("the system is reduced already; reduce the full system instead")
    if system.frames is not None:
        raise ValueError(
            "modes of the reference configuration do not turn with a body; with "
            "large_rotation=True use the full system"
        )
    matrices = (system.mass, system.stiffness, system.viscosity, system.normals, system.load)
    if is_traced((matrices, system.nodal_mass, loads)):
        raise ValueError(
            "reduce needs concrete matrices and loads, since it computes eigenvectors on the host; "
            "call it outside of jit, grad and vmap"
        )
    n_held = 0 if system.rollers is None else system.rollers.count
    target = Target.of(system.size - n_held, modes, frequency, tolerance)
    if step_responses is not None and not (np.ndim(step_responses) == 0 and step_responses > 0.0):
        raise ValueError(f"step_responses must be a time step in seconds, got {step_responses}")
    count = system.normals.count
    chosen = np.arange(count) if pairs is None else pair_numbers(pairs, count)
    part = system if pairs is None else system.with_pairs(chosen)
    # Under jit too what is concrete stays so.
    with jax.ensure_compile_time_eval():
        patterns, snapshots = _loads(system, loads), _snapshots(system, training)
        V, n_modes = space(HostSystem.of(part), patterns, snapshots, target, step_responses)
        return _project(part, V, chosen, n_modes)


def enrich(system: System, reduced: System, dt: float | None) -> System:
    """Return a reduced model that contains another one, with twice as many vibrations.

    Args:
        system: the full system that was reduced.
        reduced: its reduced model.
        dt: time step of the step responses that it has too; None is without them.

    Raises:
        ValueError: if the system is not the one that was reduced.
    """
    basis = reduced.basis
    if basis is None or system.basis is not None or not _is_projection(system, reduced, basis):
        raise ValueError(
            "hand over a full system and a model that jc.reduce made of it, got systems of "
            f"{system.size} and {reduced.size} unknowns"
        )
    part = system.with_pairs(basis.pairs)
    host = HostSystem.of(part)
    modes = min(2 * basis.modes, host.size - 1)
    V, _ = space(
        host,
        _loads(system, ()),
        np.zeros((system.size, 0)),
        Target(modes, None, None),
        dt,
        np.asarray(basis.vectors, float),
    )
    # The gap may be another one than it was.
    part = dataclasses.replace(part, gap=reduced.gap, gap_rounding=reduced.gap_rounding)
    return _project(part, V, basis.pairs, modes)


def _is_projection(system: System, reduced: System, basis: Basis) -> bool:
    """Return whether mass and stiffness of a reduced model are those of the full one on V."""
    V = np.asarray(basis.vectors, float)
    if len(V) != system.size:
        return False
    tolerance = np.sqrt(jnp.finfo(reduced.dtype).eps)
    for matrix, expected in ((system.mass, reduced.mass), (system.stiffness, reduced.stiffness)):
        found, expected = V.T @ (matrix.to_scipy() @ V), expected.to_scipy().toarray()
        if not np.allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected))):
            return False
    return True


def _loads(system: System, patterns: Sequence[ArrayLike]) -> np.ndarray:
    """Return the loads of all patterns and the load of the scene, (n, p) [N]."""
    shape, nodal_mass = (system.n_nodes, system.dimension), system.nodal_mass.to_scipy()
    columns = [np.asarray(system.load, float)]
    for pattern in patterns:
        if np.shape(pattern) != shape or not np.all(np.isfinite(np.asarray(pattern))):
            raise ValueError(
                f"each load must be finite with the shape (N, d) = {shape}, got "
                f"{np.shape(pattern)}; write loads=[pattern]"
            )
        force = nodal_mass @ np.asarray(pattern, float)
        columns.append(force[system.free_nodes].reshape(-1))
    loads = np.stack(columns, axis=1)
    return loads[:, np.any(loads != 0.0, axis=0)]


def _snapshots(system: System, motions: Sequence[Motion]) -> np.ndarray:
    """Return all displacements of the motions, (n, S), those of each motion of total size one."""
    columns = [np.zeros((system.size, 0))]
    for motion in motions:
        y = np.asarray(motion.displacement, float)
        if y.ndim != 3 or y.shape[1:] != (system.n_nodes, system.dimension):
            raise ValueError(
                f"training takes trajectories of this mesh, with displacements (T+1, N, d) = "
                f"(T+1, {system.n_nodes}, {system.dimension}); got {y.shape}"
            )
        free = y[:, system.free_nodes].reshape(len(y), -1).T
        size = np.linalg.norm(free)
        columns.append(free / (size if size > 0.0 else 1.0))
    return np.concatenate(columns, axis=1)


def _project(system: System, V: np.ndarray, pairs: np.ndarray, modes: int) -> System:
    """Return the Galerkin projection on the columns of V, (n_full, n), in double precision."""
    n, dtype, pairs = V.shape[1], system.dtype, pairs.astype(np.int32)

    def project(matrix: ComponentwiseMatrix | SymmetricMatrix) -> SymmetricMatrix:
        reduced = V.T @ (matrix.to_scipy().astype(float) @ V)
        return SymmetricMatrix(jnp.asarray(0.5 * (reduced + reduced.T), dtype), None)

    def identity(factor: float) -> ComponentwiseMatrix:
        return ComponentwiseMatrix(SymmetricMatrix(jnp.full((1, 1), factor, dtype), None), n)

    l2_mass = project(system.l2_mass)
    # With one density L is a multiple of M: no product with a matrix is needed.
    factor = float(np.mean(l2_mass.diagonal()))
    if np.allclose(
        l2_mass.values, factor * np.eye(n), rtol=0, atol=64 * jnp.finfo(dtype).eps * factor
    ):
        l2_mass = identity(factor)

    def dense(normals: ContactNormals) -> ContactNormals:
        return ContactNormals(jnp.asarray(normals.to_scipy() @ V, dtype), None, n)

    beside, vectors = system.open_pairs, jnp.asarray(V, dtype)
    mark = mark_of(np.asarray(vectors))
    return dataclasses.replace(
        system,
        mass=identity(1.0),
        stiffness=project(system.stiffness),
        viscosity=None if system.viscosity is None else project(system.viscosity),
        l2_mass=l2_mass,
        normals=dense(system.normals),
        load=jnp.asarray(np.asarray(system.load, float) @ V, dtype),
        rollers=None,
        basis=Basis(vectors, system.mass, system.normals, pairs, modes, mark),
        open_pairs=None
        if beside is None
        else dataclasses.replace(beside, normals=dense(beside.normals)),
    )
