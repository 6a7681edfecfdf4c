"""Rollers: nodes that are held in a direction and slide freely across it.

With unit rows R, (H, n), one for each direction in which a node is held, orthonormal at each node,

    P = I - R^T R

projects on the motions that the rollers allow; it acts on each node by itself. A step finds its
motion w = P w from the contact problem with

    P D P + s (I - P),    P r,    N P,    s > 0.

That is the problem on the range of P: what an elimination in a basis turned into the directions of
the rollers leaves out, stays here with the equation s (I - P) w = 0. The schemes see nothing of it.
Source: MATH.md 11.
"""

from __future__ import annotations

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.cells import end_signs
from jaxcontact.scene.mesh import Mesh
from jaxcontact.scene.scene import Scene
from jaxcontact.system.block_matrix import concatenate, scatter
from jaxcontact.system.mortar import area_vectors
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix
from jaxcontact.transforms.traced import as_array, is_traced

#: Facets at a node whose normals differ by more are two sides of an edge, each with its direction.
EDGE = np.deg2rad(40.0)
#: Directions at a node are one if the sine between them is below this power of the unit roundoff.
ROUNDING_POWER = 0.4


def roller_rows(
    scene: Scene, points: Array | np.ndarray, numbers: np.ndarray, dtype: np.dtype
) -> ContactNormals | None:
    """Return R, the directions in which nodes are held, (H, n); None without rollers.

    Args:
        scene: the scene.
        points: node positions, (N, d) [m].
        numbers: of the nodes that are not clamped, (N,), -1 for the others.
        dtype: type of the entries.

    Raises:
        ValueError: if all node positions are traced, so that no edges can be found.

    Derivative: by node positions and vectors, with the edges fixed.
    """
    if not scene.rollers:
        return None
    parts = [_facet_normals(scene, points)]
    for name, vector in scene.rollers.items():
        if vector is not None:
            nodes = np.unique(scene.mesh.facets[name])
            parts.append((nodes, _numpy_of(vector).tile(as_array(vector), (nodes.size, 1))))
    node = np.concatenate([nodes for nodes, _ in parts])
    is_free = numbers[node] >= 0
    node = node[is_free]
    rows = _orthonormal(node, concatenate(*(vectors for _, vectors in parts))[is_free])
    if not is_traced(rows):
        is_new = np.any(rows != 0.0, axis=1)
        node, rows = node[is_new], rows[is_new]
    d = points.shape[1]
    unknowns = numbers[node][:, None] * d + np.arange(d)[None, :]
    size = d * int(np.count_nonzero(numbers >= 0))
    return ContactNormals(jnp.asarray(rows, dtype), unknowns.astype(np.int32), size)


def hold(rollers: ContactNormals | None, x: Array) -> Array:
    """Return P x, (n,)."""
    if rollers is None:
        return x
    return x - rollers.transposed_product(rollers @ x, x.shape[0])


def hold_matrix(rollers: ContactNormals | None, matrix: SymmetricMatrix) -> SymmetricMatrix:
    """Return P D P + s (I - P) with the mean s of the diagonal of D, (n, n)."""
    if rollers is None:
        return matrix
    return SymmetricMatrix(_held_values(rollers, matrix), matrix.columns)


def hold_rows(rollers: ContactNormals | None, rows: ContactNormals) -> ContactNormals:
    """Return N P, (C, n)."""
    if rollers is None:
        return rows
    d = rollers.weights.shape[1]
    assert rows.unknowns is not None
    weights = rows.weights.reshape(rows.count, rows.weights.shape[1] // d, d)  # (C, node, i)
    nodes = np.asarray(rows.unknowns).reshape(weights.shape)[:, :, 0] // d
    held = jnp.einsum("cni,cnij->cnj", weights, _projections(rollers)[nodes])
    return ContactNormals(held.reshape(rows.weights.shape), rows.unknowns, rows.size)


def check_movable(scene: Scene, rows: ContactNormals, nodes: np.ndarray) -> None:
    """Check that no roller holds a contact node along its contact normal.

    Args:
        scene: the scene, for the message.
        rows: N P, (C, n).
        nodes: contact node of each row, (C,).

    Raises:
        ValueError: if the own part of a concrete row vanishes.
    """
    if is_traced(rows.weights):
        return
    own = np.asarray(rows.weights)[:, : scene.mesh.dimension]
    held = np.linalg.norm(own, axis=1) <= float(np.finfo(own.dtype).eps) ** ROUNDING_POWER
    if np.any(held):
        raise ValueError(
            f"rollers {sorted(scene.rollers)} hold {np.count_nonzero(held)} nodes of the contact "
            f"sets {sorted(scene.contact)} along their contact normals, first "
            f"{nodes[held][:5].tolist()}; these can never touch: leave a row of facets between the "
            "sets"
        )


def _projections(rollers: ContactNormals) -> Array:
    """Return the block of P of each node, (n/d, d, d)."""
    assert rollers.size is not None
    assert rollers.unknowns is not None
    d = rollers.weights.shape[1]
    outer = rollers.weights[:, :, None] * rollers.weights[:, None, :]
    identity = jnp.tile(jnp.eye(d, dtype=outer.dtype), (rollers.size // d, 1, 1))
    return identity.at[rollers.unknowns[:, 0] // d].add(-outer)


# The values alone: the pattern must stay concrete where the caller is under jit.
@jax.jit
def _held_values(rollers: ContactNormals, matrix: SymmetricMatrix) -> Array:
    blocks = _projections(rollers)
    n_nodes, d, _ = blocks.shape
    columns = jnp.asarray(matrix.columns)
    values = matrix.values.reshape(-1, d, n_nodes, d)  # (slot, column j, row, row i)
    values = jnp.einsum("nia,wbna,wnbj->wjni", blocks, values, blocks[columns])
    scale = jax.lax.stop_gradient(jnp.mean(matrix.diagonal()))
    # Padded slots name their own row too.
    own = columns == jnp.arange(n_nodes, dtype=columns.dtype)[None, :]
    is_diagonal = own & (jnp.cumsum(own, axis=0) == 1)
    rest = scale * (jnp.eye(d, dtype=blocks.dtype)[None] - blocks)
    values = values + jnp.where(is_diagonal[:, None, :, None], rest.transpose(1, 0, 2)[None], 0.0)
    return values.reshape(matrix.values.shape)


def _facet_normals(
    scene: Scene, points: Array | np.ndarray
) -> tuple[np.ndarray, Array | np.ndarray]:
    """Return nodes (r,) and outward normals (r, d) of the sets held along their own normals.

    A node has the sum of the area vectors around it, one for each side of an edge.
    """
    mesh = scene.mesh
    sets = [mesh.facets[name] for name, vector in scene.rollers.items() if vector is None]
    if not sets:
        return np.zeros(0, int), np.zeros((0, points.shape[1]))
    facets, ends = np.unique(np.concatenate(sets), axis=0), end_signs(mesh.cells)
    node, row = _sides(facets, area_vectors(_known_positions(mesh), facets, ends))
    vectors = area_vectors(points, facets, ends)
    return node, scatter(
        _numpy_of(vectors).repeat(vectors, facets.shape[1], axis=0), row, len(node)
    )


def _sides(facets: np.ndarray, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group the facets at each node by their normals: first facet first, then what is left.

    Args:
        facets: (F, d).
        vectors: their normals, (F, d).

    Returns:
        The node of each group (r,), and the group of each corner of the facets (F d,).
    """
    corners = facets.ravel()
    normals = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    normals = np.repeat(normals, facets.shape[1], axis=0)
    group, nodes = np.full(corners.size, -1), np.zeros(0, corners.dtype)
    while np.any(group < 0):
        left = np.flatnonzero(group < 0)
        found, first, place = np.unique(corners[left], return_index=True, return_inverse=True)
        cosines = np.sum(normals[left] * normals[left[first[place]]], axis=1)
        is_near = cosines >= np.cos(EDGE)
        group[left[is_near]] = nodes.size + place[is_near]
        nodes = np.concatenate([nodes, found])
    return nodes, group


def _orthonormal(node: np.ndarray, vectors: Array | np.ndarray) -> Array | np.ndarray:
    """Return unit vectors (r, d), orthogonal at each node, zero if they depend on earlier ones."""
    xp = _numpy_of(vectors)
    nodes, place, counts = np.unique(node, return_inverse=True, return_counts=True)
    order = np.argsort(place, kind="stable")
    slot = np.empty(node.size, int)
    slot[order] = np.arange(node.size) - np.repeat(np.cumsum(counts) - counts, counts)
    width = int(counts.max(initial=0))
    # A zero vector becomes NaN: traced, it cannot raise.
    units = vectors / xp.linalg.norm(vectors, axis=1, keepdims=True)
    table = scatter(units, place * width + slot, nodes.size * width)
    table = table.reshape(nodes.size, width, vectors.shape[1])
    tolerance = float(np.finfo(table.dtype).eps) ** ROUNDING_POWER
    basis = []
    for k in range(width):
        u = table[:, k]
        for b in (*basis, *basis):  # twice: once leaves the rounding error of nearly equal ones
            u = u - xp.sum(b * u, axis=1, keepdims=True) * b
        square = xp.sum(u**2, axis=1, keepdims=True)
        is_old = square <= tolerance**2
        basis.append(xp.where(is_old, 0.0, u / xp.sqrt(xp.where(is_old, 1.0, square))))
    return xp.stack(basis, axis=1)[place, slot] if basis else units


def _known_positions(mesh: Mesh) -> np.ndarray:
    points = mesh.layout if is_traced(mesh.points) else mesh.points
    if points is None or is_traced(points):
        raise ValueError(
            "rollers find the edges of their facet sets on concrete node positions, and JAX traces "
            "them; build the mesh outside of jit, grad and vmap and move its nodes there with "
            "mesh.with_points(points), or give the rollers vectors"
        )
    return np.asarray(points, float)


def _numpy_of(*values: object) -> ModuleType:
    """Return jax.numpy if a value is traced, else numpy."""
    return jnp if is_traced(values) else np
