"""From a scene to its matrices: the semi-discrete system of MATH.md 1.

    M y'' + B y' + A y + N^T p = f,    N y <= psi,  p >= 0,  p . (psi - N y) = 0

on the n unknowns: the displacement components of the nodes that are not clamped.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.scene.scene import (
    Scene,
    cellwise_material,
    check_scene,
    clamped_numbers,
    is_elastic,
)
from jaxcontact.system import assembly
from jaxcontact.system.contact_pairs import contact_pairs
from jaxcontact.system.parts import Parts, named_parts
from jaxcontact.system.rollers import check_movable, hold_rows, roller_rows
from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.traced import as_array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Basis:
    """The space of a reduced model: y = vectors q, with M-orthonormal vectors."""

    vectors: Array
    """Basis vectors, (n_full, n): displacement components of the free nodes."""

    projector: Array
    """M vectors, (n_full, n): q = projector^T y is the M-orthogonal projection."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class System:
    """The matrices of a scene; n unknowns, N nodes, C contact pairs, dimension d."""

    mass: ComponentwiseMatrix | SymmetricMatrix
    """M, consistent mass matrix with density, (n, n) [kg]; dense in a reduced model."""

    stiffness: SymmetricMatrix
    """A, elastic stiffness matrix, (n, n) [N/m]."""

    viscosity: SymmetricMatrix | None
    """B, viscosity matrix, (n, n) [N s/m]; None if the material has no viscosity."""

    l2_mass: ComponentwiseMatrix | SymmetricMatrix
    """L on the unknowns: mass matrix without density, (n, n) [m^d]."""

    nodal_mass: SymmetricMatrix
    """Scalar L on all nodes, (N, N) [m^d]; the inner product of controls (N, d), clamped too."""

    normals: ContactNormals
    """N, contact operator, (C, n); rows point from the body to the obstacle, or to the other body,
    whose displacement they subtract. With rollers N P: they leave out what is held."""

    gap: Array
    """Initial gap psi of the contact pairs, (C,) [m]; negative means penetration."""

    gap_rounding: Array
    """Rounding error of the gap, (C,) [m]: that of the positions it was measured between."""

    load: Array
    """Constant load of body force and traction, (n,) [N]."""

    contact_nodes: np.ndarray
    """Node of each contact pair, (C,) int32."""

    contact_area: Array
    """Integral of the hat function over the contact set, (C,) [m^(d-1)], between bodies over what
    lies before the other one; impulse / (dt area) is the contact pressure."""

    points: Array
    """Node positions in the reference configuration, (N, d) [m]."""

    free_nodes: np.ndarray
    """Nodes that are not clamped, (n/d,) int32."""

    node_numbers: np.ndarray
    """Position of each node among the free ones, (N,) int32; n/d for a clamped node."""

    directions: Array
    """Unit vector nu of each contact pair towards the obstacle or the other body, (C, d)."""

    parts: Parts
    """The facet sets, obstacles and clamped sets by name, for what changes in time."""

    dimension: int = field(metadata={"static": True})
    """Space dimension d."""

    rollers: ContactNormals | None = None
    """Orthonormal directions in which nodes are held by rollers, (H, n); None without rollers."""

    basis: Basis | None = None
    """Space of a reduced model (see `reduce`); None is all displacement components."""

    @property
    def size(self) -> int:
        """Number of unknowns, n."""
        return self.load.shape[-1]

    @property
    def n_nodes(self) -> int:
        """Number of mesh nodes, N."""
        return self.points.shape[-2]

    @property
    def is_clamped(self) -> bool:
        """Whether some nodes are clamped."""
        return len(self.free_nodes) < self.n_nodes

    @property
    def dtype(self):
        """Floating point type of every array."""
        return self.load.dtype

    def with_gap(self, gap: ArrayLike) -> System:
        """Return the system with another initial gap of the contact pairs, (C,) [m].

        Raises:
            ValueError: if the gap has another shape.

        Derivative: the identity from the argument to the field `gap`.
        """
        gap = as_array(gap)
        if gap.shape != self.gap.shape:
            raise ValueError(
                f"gap has shape {gap.shape}; pass {self.gap.shape}, one for each of `contact_nodes`"
            )
        gap = jnp.asarray(gap, self.dtype)
        own = 4.0 * jnp.finfo(self.dtype).eps * jnp.abs(gap)
        rounding = jnp.maximum(self.gap_rounding, jax.lax.stop_gradient(own))
        return replace(self, gap=gap, gap_rounding=rounding)

    def lift(self, x: Array) -> Array:
        """Return the nodal field (..., N, d) of unknowns (..., n); zero on clamped nodes."""
        return _lift(self, x)

    @in_full_precision
    @jax.jit
    def restrict(self, y: Array) -> Array:
        """Return the unknowns (..., n) of a nodal field (..., N, d).

        Of a reduced model, the unknowns of the M-orthogonal projection.
        """
        free = _free_components(self, y)
        return free if self.basis is None else free @ self.basis.projector

    @in_full_precision
    def control_load(self, control: Array) -> Array:
        """Return the load (n,) [N] of a force density (N, d) [N/m^d]: L u of MATH.md 1."""
        return self.nodal_load(self.nodal_mass @ control)

    @in_full_precision
    def nodal_load(self, forces: Array) -> Array:
        """Return the load (..., n) [N] of forces on the nodes (..., N, d) [N]."""
        load = _free_components(self, forces)
        return load if self.basis is None else load @ self.basis.vectors


@in_full_precision
def discretize(scene: Scene, dtype=jnp.float64) -> System:
    """Assemble the P1 system of a scene.

    Traceable in material, obstacles, loads and node positions; the connectivity and the names
    must be concrete. What cannot raise because it is traced makes the system NaN: a material out of
    range, an inverted cell, an obstacle that is none.

    Args:
        scene: the scene.
        dtype: floating point type, float64 or float32.

    Returns:
        The system, with n = d (number of nodes that are not clamped) unknowns.

    Raises:
        ValueError: if the scene is inconsistent (see `check_scene`) or leaves nothing to move.
        RuntimeError: if float64 is asked for while JAX has it switched off.
    """
    dtype = jnp.dtype(dtype)
    _check_dtype(dtype)
    check_scene(scene)
    mesh, dimension = scene.mesh, scene.mesh.dimension
    points = jnp.asarray(mesh.points, dtype)
    cells = np.asarray(mesh.cells)

    clamped_set = clamped_numbers(scene)
    is_free = clamped_set < 0
    free_nodes = np.flatnonzero(is_free).astype(np.int32)
    if free_nodes.size == 0:
        raise ValueError("every node is clamped; refine the mesh or clamp a smaller facet set")
    numbers = np.where(is_free, np.cumsum(is_free) - 1, -1)

    pattern = assembly.node_pattern(cells, numbers)
    all_nodes = assembly.node_pattern(cells, np.arange(mesh.n_nodes))
    around = {name: assembly.neighbourhood(cells, mesh.facets[name]) for name in scene.clamped}
    values = assembly.scene_values(
        points,
        cells,
        cellwise_material(scene),
        pattern,
        all_nodes,
        free_nodes,
        None if scene.body_force is None else jnp.asarray(scene.body_force, dtype),
        {name: (mesh.facets[name], jnp.asarray(t, dtype)) for name, t in scene.traction.items()},
        around,
        is_elastic=is_elastic(scene),
    )
    # Under jit too, what is concrete stays so and can be checked and compared.
    with jax.ensure_compile_time_eval():
        # In the digits of the mesh: a gap is a small difference of large positions.
        pairs = contact_pairs(scene, as_array(mesh.points), clamped_set, dtype)
        weights = jnp.asarray(pairs.row_weights(), dtype)
        rollers = roller_rows(scene, as_array(mesh.points), numbers, dtype)
    components = np.arange(dimension, dtype=np.int32)
    rows = numbers[pairs.row_nodes].astype(np.int32)[:, :, None]
    unknowns = (rows * dimension + components[None, None, :]).reshape(weights.shape)

    normals = ContactNormals(weights, unknowns, dimension * free_nodes.size)
    if rollers is not None:
        normals = hold_rows(rollers, normals)
        check_movable(scene, normals, pairs.nodes)

    def on_free(values: Array) -> SymmetricMatrix:
        return SymmetricMatrix(values, pattern.columns)

    return System(
        mass=ComponentwiseMatrix(on_free(values.mass), dimension),
        stiffness=on_free(values.stiffness),
        viscosity=None if values.viscosity is None else on_free(values.viscosity),
        l2_mass=ComponentwiseMatrix(on_free(values.l2_mass), dimension),
        nodal_mass=SymmetricMatrix(values.nodal_mass, all_nodes.columns),
        normals=normals,
        gap=jnp.asarray(pairs.gap, dtype),
        gap_rounding=jnp.asarray(pairs.rounding, dtype),
        load=values.load,
        contact_nodes=pairs.nodes,
        contact_area=jnp.asarray(pairs.area, dtype),
        points=points,
        free_nodes=free_nodes,
        node_numbers=np.where(is_free, numbers, free_nodes.size).astype(np.int32),
        directions=jnp.asarray(pairs.normals, dtype),
        parts=named_parts(scene, pairs, around, values.clamped, dtype),
        dimension=dimension,
        rollers=rollers,
    )


def _check_dtype(dtype) -> None:
    if dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"dtype must be float32 or float64, got {dtype}")
    if dtype == jnp.float64 and not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "float64 is switched off in JAX. Add jax.config.update('jax_enable_x64', True) at the "
            "start of the program, or ask for discretize(scene, dtype=jnp.float32)"
        )


def _free_components(system: System, y: Array) -> Array:
    if system.is_clamped:
        y = jnp.take(y, system.free_nodes, axis=-2, mode="clip")
    return y.reshape(*y.shape[:-2], -1)


@in_full_precision
@jax.jit
def _lift(system: System, x: Array) -> Array:
    if system.basis is not None:
        x = x @ system.basis.vectors.T
    free = x.reshape(*x.shape[:-1], -1, system.dimension)
    if not system.is_clamped:
        return free
    padding = jnp.zeros((*free.shape[:-2], 1, system.dimension), x.dtype)
    free = jnp.concatenate([free, padding], axis=-2)
    return jnp.take(free, system.node_numbers, axis=-2, mode="clip")
