"""From a scene to its matrices by P1 finite elements."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.scene import (
    Scene,
    cellwise_material,
    check_scene,
    clamped_numbers,
    is_elastic,
)
from jaxcontact.system import assembly
from jaxcontact.system.contact_pairs import contact_pairs
from jaxcontact.system.parts import named_parts
from jaxcontact.system.placing import frames_of
from jaxcontact.system.rollers import check_movable, hold_rows, roller_rows
from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.traced import as_array


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

    Example:
        >>> system = jc.discretize(jc.scenes.bar_on_wall())
        >>> system.size, system.gap
        (21, Array([0.01], dtype=float64))
        >>> print(f"{system.mass.to_scipy().sum():.4f}")  # density times length
        0.0073
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
    material = cellwise_material(scene)
    values = assembly.scene_values(
        points,
        cells,
        material,
        pattern,
        all_nodes,
        free_nodes,
        None if scene.body_force is None else jnp.asarray(scene.body_force, dtype),
        {name: (mesh.facets[name], jnp.asarray(t, dtype)) for name, t in scene.traction.items()},
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

    system = System(
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
        parts=named_parts(scene, pairs, material, dtype),
        dimension=dimension,
        rollers=rollers,
    )
    if not scene.large_rotation or dimension == 1:
        return system
    return replace(system, frames=frames_of(scene, system, pairs))


def _check_dtype(dtype) -> None:
    if dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"dtype must be float32 or float64, got {dtype}")
    if dtype == jnp.float64 and not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "float64 is switched off in JAX. Add jax.config.update('jax_enable_x64', True) at the "
            "start of the program, or ask for discretize(scene, dtype=jnp.float32)"
        )
