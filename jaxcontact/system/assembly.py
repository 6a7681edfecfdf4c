"""P1 assembly in any dimension: element matrices in JAX, sparsity patterns in NumPy.

With the constant gradients g_a of the hat functions of a cell of volume V in dimension d,

    mass       integral phi_a phi_b                    = V (1 + delta_ab) / ((d + 1)(d + 2))
    stiffness  a(phi_b e_j, phi_a e_i)                 = V (lambda g_ai g_bj + mu g_aj g_bi
                                                            + mu delta_ij g_a . g_b)

(2.1) for the isotropic tensor. Patterns are found once on the host from the connectivity; the
values follow in JAX and can be differentiated by material and node positions. Legend of shape
comments: e cell, a b local node, i j component.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import Array

from jaxcontact.scene.material import KelvinVoigt, is_admissible
from jaxcontact.transforms.traced import poison_unless


class NodePattern(NamedTuple):
    """Sparsity of a matrix on the selected nodes of a mesh, in padded ELL layout (host arrays)."""

    columns: np.ndarray
    """Column of each entry, (width, n) int32, in the numbering of the selected nodes."""

    rows: np.ndarray
    """Row of the local node a of each cell, (E, d+1) int32; n for a node that is left out."""

    slots: np.ndarray
    """Position of b in the row of a, (E, d+1, d+1) int32."""


def node_pattern(cells: np.ndarray, number: np.ndarray) -> NodePattern:
    """Return the pattern of the nodes that share a cell.

    Args:
        cells: connectivity, (E, d+1).
        number: new number of each node, (N,), or -1 for a node that is left out.
    """
    local = number[cells]
    n = int(number.max(initial=-1)) + 1
    row, column = np.broadcast_arrays(local[:, :, None], local[:, None, :])
    keep = (row >= 0) & (column >= 0)
    key = row.astype(np.int64) * n + column
    ones = np.ones(np.count_nonzero(keep), np.int8)
    graph = scipy.sparse.coo_array((ones, (row[keep], column[keep])), shape=(n, n)).tocsr()
    graph.sum_duplicates()
    counts = np.diff(graph.indptr)
    owner = np.repeat(np.arange(n), counts)
    position = np.arange(graph.nnz) - graph.indptr[owner]
    columns = np.tile(np.arange(n, dtype=np.int32), (counts.max(initial=1), 1))
    columns[position, owner] = graph.indices
    # The sorted CSR entries have increasing keys, so a binary search finds the slot of each pair.
    entry = np.searchsorted(owner * np.int64(n) + graph.indices, np.where(keep, key, 0))
    slots = position[np.minimum(entry, max(graph.nnz - 1, 0))] if graph.nnz else np.zeros_like(key)
    rows = np.where(local >= 0, local, n)
    return NodePattern(columns, rows.astype(np.int32), np.where(keep, slots, -1).astype(np.int32))


def assemble(pattern: NodePattern, blocks: Array) -> Array:
    """Sum element blocks into the values of a matrix with c components per node.

    Args:
        pattern: where the entries go.
        blocks: element matrices, (E, d+1, d+1, c, c) as (e, a, b, i, j).

    Returns:
        Values in ELL layout, (width * c, n * c); component is the fast index of the unknowns.
    """
    width, n = pattern.columns.shape
    n_components = blocks.shape[-1]
    # An out-of-bounds slot is dropped; -1 would wrap around to the last one.
    slots = jnp.where(pattern.slots < 0, width, pattern.slots)
    rows = jnp.broadcast_to(pattern.rows[:, :, None], slots.shape)
    values = jnp.zeros((width, n, n_components, n_components), blocks.dtype)
    values = values.at[slots, rows].add(blocks, mode="drop")  # (slot, row, i, j)
    values = values.transpose(0, 3, 1, 2)  # (slot, j, row, i)
    return values.reshape(width * n_components, n * n_components)


def hat_gradients(points: Array, cells: Array | np.ndarray) -> tuple[Array, Array]:
    """Return hat function gradients (E, d+1, d) [1/m] and cell volumes (E,) [m^d]."""
    corners = points[cells]
    edges = corners[:, 1:] - corners[:, :1]  # (e, a, i)
    dimension = points.shape[1]
    volumes = jnp.linalg.det(edges) / float(np.prod(np.arange(1, dimension + 1)))
    gradients = jnp.swapaxes(jnp.linalg.inv(edges), 1, 2)  # row a: gradient of hat a+1
    first = -jnp.sum(gradients, axis=1, keepdims=True)
    return jnp.concatenate([first, gradients], axis=1), volumes


def mass_blocks(volumes: Array, dimension: int) -> Array:
    """Return the scalar element mass matrices with density one, (E, d+1, d+1, 1, 1) [m^d]."""
    n_local = dimension + 1
    reference = (np.ones((n_local, n_local)) + np.eye(n_local)) / (n_local * (n_local + 1))
    blocks = volumes[:, None, None] * jnp.asarray(reference, volumes.dtype)[None]
    return blocks[:, :, :, None, None]


def stiffness_blocks(gradients: Array, volumes: Array, lame: tuple) -> Array:
    """Return the element matrices of the isotropic form, (E, d+1, d+1, d, d).

    Args:
        gradients: of the hat functions, (E, d+1, d).
        volumes: of the cells, (E,).
        lame: lambda and mu, each a scalar or (E,).
    """
    first, second = (jnp.asarray(value, volumes.dtype) * volumes for value in lame)
    outer = jnp.einsum("eai,ebj->eabij", gradients, gradients)
    dots = jnp.einsum("eai,ebi->eab", gradients, gradients)
    identity = jnp.eye(gradients.shape[2], dtype=volumes.dtype)
    isotropic = jnp.swapaxes(outer, 3, 4) + dots[:, :, :, None, None] * identity[None, None, None]
    return first[:, None, None, None, None] * outer + second[:, None, None, None, None] * isotropic


@jax.jit
def nodal_areas(points: Array, facets: Array | np.ndarray) -> Array:
    """Return the integral of each hat function over a facet set, (N,) [m^(d-1)] (1D: one)."""
    corners = points[facets]
    dimension = points.shape[1]
    if dimension == 1:
        areas = jnp.ones(facets.shape[0], points.dtype)
    else:
        edges = corners[:, 1:] - corners[:, :1]
        gram = jnp.einsum("fai,fbi->fab", edges, edges)
        areas = jnp.sqrt(jnp.linalg.det(gram)) / float(np.prod(np.arange(1, dimension)))
    shares = jnp.repeat(areas / dimension, dimension)
    return jnp.zeros(points.shape[0], points.dtype).at[jnp.ravel(facets)].add(shares)


class SceneValues(NamedTuple):
    """Entries of the matrices in ELL layout, those of the masses scalar; load (n,)."""

    mass: Array
    stiffness: Array
    viscosity: Array | None
    l2_mass: Array
    nodal_mass: Array
    load: Array


# One program for all of it: compiling operation by operation takes seconds for every new mesh.
@partial(jax.jit, static_argnames="is_elastic")
def scene_values(
    points: Array,
    cells: Array,
    material: KelvinVoigt,
    pattern: NodePattern,
    all_nodes: NodePattern,
    free_nodes: Array,
    body_force: Array | None,
    tractions: dict[str, tuple[Array, Array]],
    *,
    is_elastic: bool,
) -> SceneValues:
    """Return the entries of all matrices of a scene, and its constant load.

    Args:
        points: node positions, (N, d) [m].
        cells: connectivity, (E, d+1).
        material: scalars, or one value per cell (E,).
        pattern: sparsity on the free nodes.
        all_nodes: sparsity on all nodes.
        free_nodes: the nodes whose displacement components are the unknowns, (n/d,).
        body_force: (d,) [N/m^d], or None.
        tractions: facets (F, d) and traction (d,) [N/m^(d-1)] of each loaded set.
        is_elastic: whether there is no viscosity.
    """
    dimension = points.shape[1]
    gradients, volumes = hat_gradients(points, cells)
    l2_blocks = mass_blocks(volumes, dimension)
    density = jnp.broadcast_to(jnp.asarray(material.density, points.dtype), volumes.shape)

    def isotropic(lame: tuple) -> Array:
        blocks = stiffness_blocks(gradients, volumes, lame)
        return assemble(pattern, blocks)

    load = jnp.zeros(points.shape, points.dtype)
    if body_force is not None:
        shares = jnp.repeat(volumes / (dimension + 1), dimension + 1)
        weights = jnp.zeros(points.shape[0], points.dtype).at[jnp.ravel(cells)].add(shares)
        load = load + weights[:, None] * body_force[None, :]
    for facets, traction in tractions.values():
        load = load + nodal_areas(points, facets)[:, None] * traction[None, :]
    values = SceneValues(
        mass=assemble(pattern, density[:, None, None, None, None] * l2_blocks),
        stiffness=isotropic(material.elastic_lame()),
        viscosity=None if is_elastic else isotropic(material.viscous_lame()),
        l2_mass=assemble(pattern, l2_blocks),
        nodal_mass=assemble(all_nodes, l2_blocks),
        load=load[free_nodes].reshape(-1),
    )
    # Concrete values were checked before; traced ones cannot raise.
    return poison_unless(is_admissible(material) & jnp.all(volumes > 0.0), values)
