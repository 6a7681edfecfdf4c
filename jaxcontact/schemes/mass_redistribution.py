"""A mass matrix without mass on the contact nodes in contact direction.

    M_r = E^T M E + C,    M_r S = 0.

S projects on the contact directions: nu_i at the node of a contact pair, and between two bodies, at
a node k of the other one that pairs meet with the shares m_ik, the direction of sum_i m_ik nu_i;
with one direction nu for all, N = N S. A body whose surface keeps its mass would chatter against a
massless one.

E replaces the normal velocity of a contact node by that of the body just inside: (E v)_i =
(I - nu nu^T) v_i + nu nu^T sum_j w_ij v_j with nodes j inside, sum_j w_ij = 1 and no tangential
offset, sum_j w_ij (I - nu nu^T)(x_j - x_i) ~ 0. E^T M E is positive semidefinite with the kernel
S and the total mass of M, but it moves the centre of mass by O(h^2). C, one small block on each
node inside, is the smallest correction that gives every rigid velocity field (1D: every affine
one) of every body its kinetic energy back: mass, centre of mass and inertia of each connected part
of the mesh are then those of M.

Extrapolating affine fields exactly (w with sum_j w_ij x_j = x_i) needs no C, but puts 8/3 of a
cell's mass on the first node of a bar, which rings after an impact: three times the error of the
force.

Source: Khenous, Laborde, Renard, Eur. J. Mech. A/Solids 27 (2008) 918-932, for the moments and
the smallest correction; Hager, Hueeber, Wohlmuth, Int. J. Numer. Meth. Engng 73 (2008) 1206-1225,
for moving the mass to the neighbours.
"""

from __future__ import annotations

import itertools
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.system.block_matrix import (
    BlockMatrix,
    concatenate,
    from_symmetric,
    on_host,
)
from jaxcontact.system.bodies import body_numbers
from jaxcontact.system.system import System
from jaxcontact.transforms.traced import poison_unless

#: How dear a tangential offset of a donor is, against a distant donor.
OFFSET_PENALTY = 1e4
#: Share in the pairs of another body from which on a node has a contact direction.
LEAST_SHARE = 1e-6


def contact_directions(system: System) -> Array:
    """Return the unit contact direction of each unknown node, zero elsewhere, (n/d, d).

    It is that of the forces of equal pressure, N^T 1, up to the sign.
    """
    normals, d = system.normals, system.dimension
    if normals.count == 0:  # of a reduced model too, whose unknowns are no components of nodes
        return jnp.zeros((system.size, 1), system.dtype)
    force = normals.transposed_product(jnp.ones(normals.count, system.dtype), system.size)
    force = force.reshape(system.size // d, d)
    squares = jnp.sum(force**2, axis=1, keepdims=True)
    has_one = squares > LEAST_SHARE**2
    return jnp.where(has_one, force * jax.lax.rsqrt(jnp.where(has_one, squares, 1.0)), 0.0)


def along_directions(directions: Array, x: Array) -> Array:
    """Return S x, (n,), of x (n,) and the contact directions (n/d, d)."""
    nodal = x.reshape(directions.shape)
    return (directions * jnp.sum(directions * nodal, axis=1, keepdims=True)).reshape(x.shape)


def redistribute(system: System) -> BlockMatrix:
    """Return M_r, singular: M_r S = 0.

    Traceable in every value of the system; which nodes receive mass follows from the mesh alone.
    A traced M_r that is indefinite is NaN.

    Raises:
        ValueError: if a node has two contact pairs, a contact node has too few nodes inside the
            body near it, or the mesh is so coarse that M_r is indefinite.
    """
    _check_pairs(system)
    inward = _inward_shift(system)
    mass = inward.transpose() @ from_symmetric(system.mass.expand(), system.dimension) @ inward
    corrected = mass.plus(_moment_correction(system, mass))
    return _checked(system, corrected)


def tangential_projection(system: System) -> BlockMatrix:
    """Return I - S."""
    n_nodes, d = len(system.free_nodes), system.dimension
    directions = on_host(contact_directions(system))
    identity = np.eye(d, dtype=system.dtype)[None]
    nodes = np.arange(n_nodes)
    outer = directions[:, :, None] * directions[:, None, :]
    return BlockMatrix(nodes, nodes, identity - outer)


def _massless_nodes(system: System) -> np.ndarray:
    """Return the nodes of contact pairs, and those of the other body that they meet, (K,)."""
    unknowns = np.asarray(system.normals.unknowns)
    return np.asarray(system.free_nodes)[np.unique(unknowns // system.dimension)]


def _inward_shift(system: System) -> BlockMatrix:
    """Return E."""
    number = np.asarray(system.node_numbers)
    contact_nodes = _massless_nodes(system)
    points = on_host(system.points)
    normals = on_host(contact_directions(system))[number[contact_nodes]]
    pairs, donors, size = _donors(system, contact_nodes)
    offsets = points[donors] - points[contact_nodes[pairs]]  # (z, d)
    # Donors of one contact node are a row of the table; missing ones have no weight.
    column = np.arange(pairs.size) - np.searchsorted(pairs, pairs)
    table = np.zeros((contact_nodes.size, size), int)
    table[pairs, column] = np.arange(pairs.size)
    is_donor = np.zeros(table.shape, bool)
    is_donor[pairs, column] = True
    weights = _shift_weights(offsets[table], is_donor, normals)[pairs, column]
    along = normals[pairs]
    blocks = weights[:, None, None] * along[:, :, None] * along[:, None, :]
    shift = BlockMatrix(number[contact_nodes[pairs]], number[donors], blocks)
    return tangential_projection(system).plus(shift)


def _shift_weights(offsets, is_donor: np.ndarray, normals) -> Array | np.ndarray:
    """Return weights (C, m) with sum 1, small tangential offset and few distant donors.

    The minimum of sum_j (w_j |x_j|)^2 + penalty |sum_j w_j t_j|^2 with the tangential offsets t_j.
    """
    xp = _numpy_of(offsets, normals)
    squares = xp.sum(offsets**2, axis=2)
    # The weights do not depend on it; the derivative of a maximum is NaN where a compiler rounds
    # its argument in two ways.
    size = _constant(xp.max(xp.where(is_donor, squares, 0.0), axis=1))[:, None]
    normal_part = xp.sum(offsets * normals[:, None, :], axis=2)
    tangential = offsets - normal_part[:, :, None] * normals[:, None, :]
    tangential = xp.where(is_donor[:, :, None], tangential, 0.0)
    distances = xp.where(is_donor, squares / size, 1.0)
    matrix = OFFSET_PENALTY * tangential @ xp.swapaxes(tangential, 1, 2) / size[:, :, None]
    identity = np.eye(is_donor.shape[1], dtype=distances.dtype)
    matrix = matrix + distances[:, :, None] * identity[None]
    ones = is_donor.astype(distances.dtype)
    raw = xp.linalg.solve(matrix, ones[:, :, None])[:, :, 0] * ones
    return raw / xp.sum(raw, axis=1)[:, None]


def _moment_correction(system: System, mass: BlockMatrix) -> BlockMatrix:
    """Return C, which gives every body of the mesh its own moments back."""
    body = body_numbers(system)[np.asarray(system.free_nodes)]
    is_inside = ~np.isin(np.asarray(system.free_nodes), _massless_nodes(system))
    lost = from_symmetric(system.mass.expand(), system.dimension).plus(mass.scaled(-1.0))
    corrections = [
        _body_correction(system, lost, body == number, is_inside)
        for number in np.unique(body[~is_inside])
    ]
    nodes = np.concatenate([correction.rows for correction in corrections])
    blocks = concatenate(*(correction.blocks for correction in corrections))
    return BlockMatrix(nodes, nodes, blocks)


def _body_correction(
    system: System, lost: BlockMatrix, is_body: np.ndarray, is_inside: np.ndarray
) -> BlockMatrix:
    """Return blocks m_i R_i T R_i^T on the inner nodes i of a body, R_i its rigid fields there.

    T solves sum_i m_i R_i^T R_i T R_i^T R_i = R^T (M - E^T M E) R, with the nodal volumes m_i.

    Args:
        system: the system.
        lost: M - E^T M E on the free nodes.
        is_body: free nodes of the body, (n,).
        is_inside: free nodes without contact, (n,).
    """
    free, nodes = np.asarray(system.free_nodes), np.flatnonzero(is_body)
    position = np.cumsum(is_body) - 1
    fields = rigid_fields(on_host(system.points)[free[nodes]])  # (n, i, k)
    entries = np.flatnonzero(is_body[lost.rows])
    left = fields[position[lost.rows[entries]]].swapaxes(1, 2)
    right = fields[position[lost.columns[entries]]]
    missing = (left @ on_host(lost.blocks)[entries] @ right).sum(axis=0)
    inside = np.flatnonzero(is_body & is_inside)
    volumes = on_host(system.nodal_mass.values).sum(axis=0)[free[inside]]
    rigid = fields[position[inside]]
    gram = rigid.swapaxes(1, 2) @ rigid
    k = gram.shape[1]
    flat = gram.reshape(-1, k * k)
    equations = (flat.T @ (volumes[:, None] * flat)).reshape(k, k, k, k)
    equations = equations.transpose(0, 2, 1, 3).reshape(k * k, k * k)
    xp = _numpy_of(fields, missing)
    # The equations are singular, and what is zero but for rounding depends on the precision.
    rtol = 10.0 * k * k * float(jnp.finfo(equations.dtype).eps)
    inverse = xp.linalg.pinv(equations, rtol=rtol, hermitian=True)
    T = (inverse @ missing.reshape(-1)).reshape(k, k)
    blocks = volumes[:, None, None] * (rigid @ (0.5 * (T + T.T))[None] @ rigid.swapaxes(1, 2))
    return BlockMatrix(inside, inside, blocks)


def rigid_fields(points: Array | np.ndarray) -> Array | np.ndarray:
    """Return translations and rotations at the points, then the stretch in 1D, (n, d, k)."""
    xp = _numpy_of(points)
    n, d = points.shape
    x = points - points.mean(axis=0)[None, :]
    x = x / _constant(abs(x).max())  # C does not depend on the length of the fields
    fields = [xp.broadcast_to(xp.asarray(axis)[None, :], (n, d)) for axis in np.eye(d)]
    for i, j in itertools.combinations(range(d), 2):
        turn = np.zeros((d, d))
        turn[i, j], turn[j, i] = 1.0, -1.0
        fields.append(x @ turn)
    if d == 1:
        fields.append(x)
    return xp.stack(fields, axis=-1).astype(points.dtype)


def _donors(system: System, contact_nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the contact node, by its place, and the donor of every term, and the most of one."""
    is_donor = np.zeros(system.n_nodes, bool)
    is_donor[np.asarray(system.free_nodes)] = True
    is_donor[contact_nodes] = False
    neighbours = np.asarray(system.nodal_mass.columns).T
    pairs, donors = [], []
    for pair, node in enumerate(contact_nodes):
        ring = np.array([node])
        for _ in range(3):
            ring = np.unique(neighbours[ring])
            inside = ring[is_donor[ring]]
            if inside.size >= system.dimension:
                break
        if not inside.size:
            raise ValueError(
                f"contact node {node} has no free node outside the contact set near it that its "
                "mass could move to; refine the mesh, or use jc.ContactStabilized()"
            )
        pairs.append(np.full(inside.size, pair))
        donors.append(inside)
    return np.concatenate(pairs), np.concatenate(donors), max(map(len, donors))


def _constant(x: Array | np.ndarray) -> Array | np.ndarray:
    """Return a value that counts as constant in derivatives."""
    return jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x


def _numpy_of(*values: Array | np.ndarray) -> ModuleType:
    """Return jax.numpy if a value is traced, else numpy."""
    return jnp if any(isinstance(value, Tracer) for value in values) else np


def _checked(system: System, mass: BlockMatrix) -> BlockMatrix:
    """Return M_r, after a check that it is positive where it should be, on a coarse mesh only.

    The correction is large there. With its mean diagonal entry on the contact directions M_r is
    positive definite or indefinite.
    """
    if system.size > 1000:
        return mass
    n_nodes, d = len(system.free_nodes), system.dimension
    matrix = mass.to_symmetric(n_nodes)
    directions = contact_directions(system)
    scale = jnp.mean(matrix.diagonal())
    held = jax.vmap(lambda x: matrix @ x + scale * along_directions(directions, x))
    lower = jnp.linalg.cholesky(held(jnp.eye(n_nodes * d, dtype=system.dtype)))
    is_positive = jnp.all(jnp.isfinite(lower))
    if isinstance(is_positive, Tracer):
        return mass._replace(blocks=poison_unless(is_positive, mass.blocks))
    if not is_positive:
        raise ValueError(
            "the mesh is too coarse to move the mass of its contact nodes inside without moving "
            "the centre of mass; refine it, or use jc.ContactStabilized()"
        )
    return mass


def _check_pairs(system: System) -> None:
    """Check that every contact pair is one node against an obstacle or another body."""
    if system.basis is not None:
        raise ValueError(
            "RedistributedMass moves mass from contact nodes to their neighbours, and the unknowns "
            "of a reduced model belong to no node; use jc.ContactStabilized()"
        )
    nodes = np.asarray(system.contact_nodes)
    shared = nodes.size - np.unique(nodes).size
    # Of the other body the nodes of many pairs may be one, but not one that has its own pair.
    others = np.asarray(system.normals.unknowns)[:, system.dimension :]
    own = np.asarray(system.normals.unknowns)[:, : system.dimension]
    padded = others.reshape(len(nodes), -1, system.dimension) == own[:, None, :]
    shared += np.intersect1d(others[~padded.reshape(others.shape)], own).size
    if shared:
        raise ValueError(
            f"{shared} nodes have more than one contact pair; RedistributedMass needs one normal "
            "per node: merge the contact sets, or use jc.ContactStabilized()"
        )
