"""A mass matrix without mass on the contact nodes in contact direction.

    M_r = E^T M E + C,    M_r N^T = 0.

E replaces the normal velocity of a contact node by that of the body just inside: (E v)_i =
(I - nu nu^T) v_i + nu nu^T sum_j w_ij v_j with nodes j inside, sum_j w_ij = 1 and no tangential
offset, sum_j w_ij (I - nu nu^T)(x_j - x_i) = 0. E^T M E is positive semidefinite with the kernel N^T
and the total mass of M, but it moves the centre of mass by O(h^2). C, one small block on each node
inside, is the smallest correction that gives every rigid velocity field (1D: every affine one) its
kinetic energy back: total mass, centre of mass and inertia are then those of M.

Extrapolating affine fields exactly (w with sum_j w_ij x_j = x_i) needs no C, but puts 8/3 of a cell's
mass on the first node of a bar, which rings after an impact: three times the error of the force.

Source: Khenous, Laborde, Renard, Eur. J. Mech. A/Solids 27 (2008) 918-932, 4, for the moments and
the smallest correction; Hager, Hueeber, Wohlmuth, Int. J. Numer. Meth. Engng 73 (2008) 1206-1225 for
moving the mass to the neighbours.
"""

from __future__ import annotations

import itertools

import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.schemes.block_matrix import BlockMatrix, from_symmetric
from jaxcontact.system import System


def redistribute(system: System) -> BlockMatrix:
    """Return M_r, singular: M_r N^T = 0.

    Raises:
        ValueError: if the contact pairs are not one per node, node positions or normals are
            traced, or a contact node has too few nodes inside the body near it.

    Derivative: with respect to the values of the mass matrix.
    """
    _check_pairs(system)
    inward = _inward_shift(system)
    mass = inward.transpose() @ from_symmetric(system.mass, system.dimension) @ inward
    corrected = mass.plus(_moment_correction(system, mass))
    _check_semidefinite(system, corrected)
    return corrected


def tangential_projection(system: System) -> BlockMatrix:
    """Return I - Q with Q = N^T N."""
    n_nodes, d = len(system.free_nodes), system.dimension
    normals = np.asarray(system.normals.weights)
    nodes = np.asarray(system.node_numbers)[np.asarray(system.contact_nodes)]
    blocks = np.tile(np.eye(d, dtype=normals.dtype), (n_nodes, 1, 1))
    np.subtract.at(blocks, nodes, np.einsum("ci,cj->cij", normals, normals))
    return BlockMatrix(np.arange(n_nodes), np.arange(n_nodes), blocks)


def _inward_shift(system: System) -> BlockMatrix:
    """Return E."""
    number = np.asarray(system.node_numbers)
    pairs, donors, weights = _stencils(system)
    normals = np.asarray(system.normals.weights)[pairs]
    blocks = np.einsum("z,zi,zj->zij", weights, normals, normals).astype(system.dtype)
    owners = np.asarray(system.contact_nodes)[pairs]
    shift = BlockMatrix(number[owners], number[donors], blocks)
    return tangential_projection(system).plus(shift)


def _moment_correction(system: System, mass: BlockMatrix) -> BlockMatrix:
    """Return C: blocks m_i R_i T R_i^T on the nodes inside, with R_i the rigid fields at node i.

    T solves sum_i m_i R_i^T R_i T R_i^T R_i = R^T (M - E^T M E) R, with the nodal volumes m_i.
    """
    free = np.asarray(system.free_nodes)
    inside = np.flatnonzero(~np.isin(free, np.asarray(system.contact_nodes)))
    fields = _rigid_fields(np.asarray(system.points)[free])  # (n,i,k)
    fields = fields.astype(system.dtype)
    lost = from_symmetric(system.mass, system.dimension).plus(mass.scaled(-1.0))
    pairs = fields[lost.rows].swapaxes(1, 2) @ lost.blocks @ fields[lost.columns]
    missing = pairs.sum(axis=0)
    volumes = np.asarray(system.nodal_mass.values).sum(axis=0)[free[inside]]
    gram = np.einsum("nik,nil->nkl", fields[inside], fields[inside])
    equations = np.einsum("nab,n,ncd->acbd", gram, volumes, gram, optimize=True)
    k = gram.shape[1]
    inverse = np.linalg.pinv(equations.reshape(k * k, k * k), hermitian=True)
    T = (inverse.astype(system.dtype) @ missing.reshape(-1)).reshape(k, k)
    rigid = fields[inside]
    weighted = rigid * volumes[:, None, None].astype(system.dtype)
    blocks = weighted @ (0.5 * (T + T.T)) @ rigid.swapaxes(1, 2)
    return BlockMatrix(inside, inside, blocks)


def _rigid_fields(points: np.ndarray) -> np.ndarray:
    """Return translations and rotations (1D: translation and stretch) at the points, (n, d, k)."""
    n, d = points.shape
    x = points - points.mean(axis=0)
    x = x / np.abs(x).max()
    fields = [np.broadcast_to(axis, (n, d)) for axis in np.eye(d)]
    for i, j in itertools.combinations(range(d), 2):
        rotation = np.zeros((n, d))
        rotation[:, i], rotation[:, j] = -x[:, j], x[:, i]
        fields.append(rotation)
    return np.stack([*fields, x] if d == 1 else fields, axis=-1)


def _check_semidefinite(system: System, mass: BlockMatrix) -> None:
    """Check a concrete M_r of a coarse mesh, where the correction is large."""
    if isinstance(mass.blocks, Tracer) or system.size > 1000:
        return
    matrix = mass.to_symmetric(len(system.free_nodes)).to_scipy().toarray()
    lowest, *_, largest = np.linalg.eigvalsh(matrix)
    if lowest < -1e3 * np.finfo(matrix.dtype).eps * largest:
        raise ValueError(
            "the mesh is too coarse to move the mass of its contact nodes inside without moving "
            "the centre of mass; refine it, or use jc.ContactStabilized()"
        )


def _stencils(system: System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return contact pair, donor node and weight of every term of the shift, (Z,) each."""
    points = np.asarray(system.points)
    contact_nodes = np.asarray(system.contact_nodes)
    is_donor = np.zeros(len(points), bool)
    is_donor[np.asarray(system.free_nodes)] = True
    is_donor[contact_nodes] = False
    neighbours = np.asarray(system.nodal_mass.columns).T
    pairs, donors, weights = [], [], []
    for pair, node in enumerate(contact_nodes):
        normal = np.asarray(system.normals.weights)[pair]
        ring = np.array([node])
        for _ in range(4):
            ring = np.unique(neighbours[ring])
            inside = ring[is_donor[ring]]
            found = _shift_weights(points[inside] - points[node], normal)
            if found is not None:
                break
        else:
            raise ValueError(
                f"contact node {node} has too few free nodes outside the contact set near it that "
                "its mass could move to; refine the mesh, or use jc.ContactStabilized()"
            )
        pairs.append(np.full(inside.size, pair))
        donors.append(inside)
        weights.append(found)
    return np.concatenate(pairs), np.concatenate(donors), np.concatenate(weights)


def _shift_weights(offsets: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """Return the smallest weights (Z,) with sum 1 and without tangential offset, or None."""
    d = len(normal)
    if len(offsets) < d:
        return None
    distance = np.linalg.norm(offsets, axis=1)
    size = distance.mean()
    tangential = offsets - np.outer(offsets @ normal, normal)
    # Far nodes are dear: a weight is measured times its distance.
    conditions = np.concatenate([np.ones((1, len(offsets))), tangential.T / size]) * size / distance
    if np.linalg.svd(conditions, compute_uv=False)[d - 1] < 0.1:
        return None
    target = np.eye(d + 1)[0]
    return size / distance * np.linalg.lstsq(conditions, target, rcond=1e-8)[0]


def _check_pairs(system: System) -> None:
    """Check that every contact pair is one node against a rigid obstacle, and concrete."""
    if isinstance(system.points, Tracer) or isinstance(system.normals.weights, Tracer):
        raise ValueError(
            "RedistributedMass moves mass on the host and needs concrete node positions and "
            "contact normals; to differentiate by shape or obstacle use jc.ContactStabilized()"
        )
    d, nodes = system.dimension, np.asarray(system.contact_nodes)
    if system.size != d * len(system.free_nodes) or system.normals.unknowns.shape[1] != d:
        raise ValueError(
            "RedistributedMass needs the nodes of a mesh against rigid obstacles, not a reduced "
            "model or two bodies; use jc.ContactStabilized()"
        )
    shared = nodes.size - np.unique(nodes).size
    if shared:
        raise ValueError(
            f"{shared} nodes have more than one contact pair; RedistributedMass needs one normal "
            "per node: merge the contact sets, or use jc.ContactStabilized()"
        )
