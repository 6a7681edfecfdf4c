"""Reduced models: Galerkin projection that keeps every structural property of the full system.

The space holds the lowest free vibrations, A phi = omega^2 M phi, and the static responses to a
unit normal force on each contact pair, A z = N^T e_i: without them the local deformation at the
contact, and with it the contact force, does not converge. Dissipation, the contact problem and
the exact adjoint carry over, because the reduced system is again a system.
Source: Craig, Bampton, AIAA J. 6 (1968); MacNeal, Comput. Struct. 1 (1971).
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse.linalg
from jax.core import Tracer

from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix
from jaxcontact.system.system import Basis, System
from jaxcontact.transforms.precision import in_full_precision


@in_full_precision
def reduce(system: System, modes: int, *, contact_responses: bool = True) -> System:
    """Project a system on its lowest modes and its responses to contact forces.

    The basis is computed once on the host; the reduced matrices are differentiable by the values
    of the full ones with the basis held fixed.

    Args:
        system: the full system, with concrete matrices.
        modes: number of free vibrations.
        contact_responses: add the static response to each contact pair (recommended).

    Returns:
        A system with at most `modes` + C unknowns and dense matrices, used like any other;
        displacements and controls keep their shapes.

    Raises:
        ValueError: if the system is traced, reduced already or has rollers, or `modes` does not lie
            between 1 and n - 1.
    """
    if system.basis is not None:
        raise ValueError("the system is reduced already; reduce the full system instead")
    if system.rollers is not None:
        raise ValueError(
            "a system with rollers is not reduced; clamp the facet set, or use the full system"
        )
    if isinstance(system.stiffness.values, Tracer):
        raise ValueError(
            "reduce needs concrete matrices, since it computes eigenvectors on the host; call it "
            "outside of jit, grad and vmap"
        )
    if not 1 <= modes < system.size:
        raise ValueError(f"modes must lie between 1 and n - 1 = {system.size - 1}, got {modes}")
    vectors = _basis(system, modes, contact_responses)
    V = jnp.asarray(vectors, system.dtype)

    def project(matrix: ComponentwiseMatrix | SymmetricMatrix) -> SymmetricMatrix:
        reduced = V.T @ (matrix @ V)
        return SymmetricMatrix(0.5 * (reduced + reduced.T), None)

    normals = jnp.sum(system.normals.weights[:, :, None] * V[system.normals.unknowns], axis=1)
    unknowns = np.broadcast_to(np.arange(V.shape[1], dtype=np.int32), normals.shape)
    return dataclasses.replace(
        system,
        mass=project(system.mass),
        stiffness=project(system.stiffness),
        viscosity=None if system.viscosity is None else project(system.viscosity),
        l2_mass=project(system.l2_mass),
        normals=ContactNormals(normals, unknowns, V.shape[1]),
        load=system.load @ V,
        basis=Basis(V, system.mass @ V),
    )


def _basis(system: System, modes: int, contact_responses: bool) -> np.ndarray:
    """Return M-orthonormal basis vectors, (n, m)."""
    mass, stiffness = system.mass.to_scipy(), system.stiffness.to_scipy()
    # A free body has rigid motions, on which the stiffness vanishes: shift by a small frequency.
    shift = 1e-3 * _lowest_scale(mass, stiffness)
    solve = scipy.sparse.linalg.splu((stiffness + shift * mass).tocsc()).solve
    shifted = scipy.sparse.linalg.LinearOperator(
        mass.shape,
        matvec=solve,  # type: ignore[reportCallIssue]
        dtype=float,  # type: ignore[reportCallIssue]
    )
    start = np.random.default_rng(0).standard_normal(system.size)
    _, vibrations = scipy.sparse.linalg.eigsh(
        stiffness, k=modes, M=mass, sigma=-shift, OPinv=shifted, v0=start
    )
    vectors = vibrations
    if contact_responses and system.normals.count:
        responses = solve(system.normals.to_scipy().T.toarray())
        vectors = np.concatenate([vibrations, responses], axis=1)
    vectors = vectors / np.sqrt(np.sum(vectors * (mass @ vectors), axis=0))
    # The square roots of the Gram matrix's eigenvalues are singular values in the M norm.
    values, rotation = scipy.linalg.eigh(vectors.T @ (mass @ vectors))
    keep = values > 1e-14 * values[-1]
    vectors = vectors @ (rotation[:, keep] / np.sqrt(values[keep]))
    # Once more: the first pass leaves errors of the size eps / smallest kept value.
    factor = scipy.linalg.cholesky(vectors.T @ (mass @ vectors), lower=True)
    return scipy.linalg.solve_triangular(factor, vectors.T, lower=True).T


def _lowest_scale(mass, stiffness) -> float:
    """Return a lower estimate of the squared elastic frequencies, by the largest one and n."""
    largest = scipy.sparse.linalg.norm(stiffness, 1) / scipy.sparse.linalg.norm(mass, 1)
    return float(largest) / mass.shape[0]
