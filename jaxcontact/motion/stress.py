"""Strain and stress of a displacement, cell by cell and averaged at the nodes.

    eps = (grad y + grad y^T) / 2,    sigma = lambda tr(eps) I + 2 mu eps   (+ the same of y'),

constant in a P1 cell. What the body does not do still has a stress: in plane strain, and in a bar
between rigid walls (1D), the other directions carry lambda tr(eps). Source: MATH.md 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.scene.scene import Scene, cellwise_material, check_scene
from jaxcontact.system.assembly import hat_gradients
from jaxcontact.system.discretize import discretize
from jaxcontact.system.placing import deformation
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.traced import as_array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stress:
    """Stress of one or more states (...); E cells, N nodes, dimension d. Tension is positive."""

    strain: Array
    """Linear strain of every cell, (..., E, d, d)."""

    elastic: Array
    """Elastic part of the stress, (..., E, d, d) [N/m^(d-1)]."""

    viscous: Array | None
    """Viscous part of the stress, (..., E, d, d) [N/m^(d-1)]; None if no velocity was given."""

    out_of_plane: Array
    """Normal stress in the directions that the model leaves out, (..., E) [N/m^(d-1)]: the third
    one of plane strain, both lateral ones in 1D; zero in 3D."""

    volumes: Array
    """Volume of every cell, (E,) [m^d]."""

    nodal_volumes: Array
    """Sum of the volumes of the cells around every node, (N,) [m^d]."""

    nodes_of_cells: np.ndarray
    """Nodes of every cell, (E, d+1) int32."""

    @property
    def cells(self) -> Array:
        """Stress of every cell, elastic and viscous, (..., E, d, d) [N/m^(d-1)]."""
        return self.elastic if self.viscous is None else self.elastic + self.viscous

    @property
    def nodes(self) -> Array:
        """Stress at the nodes, (..., N, d, d): mean of the cells around, weighted by volume."""
        return self._at_nodes(self.cells)

    @property
    def von_mises(self) -> Array:
        """Von Mises stress at the nodes, (..., N) [N/m^(d-1)], of the averaged stress."""
        return _von_mises(self.nodes, self._at_nodes(self.out_of_plane))

    @property
    def von_mises_cells(self) -> Array:
        """Von Mises stress of every cell, (..., E) [N/m^(d-1)]."""
        return _von_mises(self.cells, self.out_of_plane)

    @property
    def principal(self) -> Array:
        """Principal stresses at the nodes in the space of the body, (..., N, d), largest first."""
        return jnp.linalg.eigvalsh(self.nodes)[..., ::-1]

    @property
    def energy_density(self) -> Array:
        """Elastic energy per volume of every cell, (..., E) [J/m^d]."""
        return 0.5 * jnp.sum(self.elastic * self.strain, axis=(-2, -1))

    def _at_nodes(self, values: Array) -> Array:
        """Return the means (..., N, ...) of values (..., E, ...) of the cells around a node."""
        axis = self.strain.ndim - 3
        parts = jnp.einsum("e,e...->e...", self.volumes, jnp.moveaxis(values, axis, 0))
        total = jnp.zeros((*self.nodal_volumes.shape, *parts.shape[1:]), values.dtype)
        total = total.at[self.nodes_of_cells].add(jnp.expand_dims(parts, 1))
        means = jnp.einsum("n...,n->n...", total, 1.0 / self.nodal_volumes)
        return jnp.moveaxis(means, 0, axis)


@in_full_precision
def stress(scene: Scene, displacement: ArrayLike, velocity: ArrayLike | None = None) -> Stress:
    """Return the stress of a displacement.

    Args:
        scene: the scene, for its mesh and material.
        displacement: nodal displacement, (..., N, d) [m], of a state or a whole trajectory. With
            `Scene.large_rotation` strain and stress are in the axes of the body that has turned.
        velocity: nodal velocity, (..., N, d) [m/s], for the viscous part; default none.

    Raises:
        ValueError: if a shape does not fit the mesh, a velocity is given where bodies turn, or as
            `check_scene`.

    Derivative: by displacement, velocity, material and node positions. The principal stresses have
    none where two of them are equal; where it is zero, that of the von Mises stress is zero.

    Example:
        >>> bar = jc.Scene(jc.meshes.interval(1.0, h=0.5), jc.KelvinVoigt(young=2.0, poisson=0.0))
        >>> jc.stress(bar, 0.1 * bar.mesh.points).cells.ravel()  # stretched by a tenth
        Array([0.2, 0.2], dtype=float64)
    """
    check_scene(scene)
    displacement = as_array(displacement)
    fields = {"displacement": displacement, "velocity": velocity}
    for name, value in fields.items():
        if value is not None and np.shape(value)[-2:] != scene.mesh.points.shape:
            raise ValueError(
                f"{name} has shape {np.shape(value)}; pass nodal vectors, (..., N, d) with "
                f"(N, d) = {scene.mesh.points.shape}"
            )
    if scene.large_rotation and scene.mesh.dimension > 1:
        if velocity is not None:
            raise ValueError(
                "the viscous stress of bodies that turn is not known; with large_rotation=True "
                "leave out the velocity"
            )
        displacement = jnp.asarray(displacement)
        displacement = deformation(discretize(scene, displacement.dtype), displacement)
    return _stress(
        jnp.asarray(scene.mesh.points, jnp.result_type(displacement, jnp.float32)),
        np.asarray(scene.mesh.cells),
        cellwise_material(scene),
        displacement,
        None if velocity is None else jnp.asarray(velocity),
    )


@jax.jit
def _stress(points, cells, material, displacement, velocity) -> Stress:
    gradients, volumes = hat_gradients(points, cells)

    def strain_of(field: Array) -> Array:
        gradient = jnp.einsum("eaj,...eai->...eij", gradients, field[..., cells, :])
        return 0.5 * (gradient + jnp.swapaxes(gradient, -2, -1))

    def stress_of(strain: Array, lame: tuple) -> tuple[Array, Array]:
        first, second = (
            jnp.broadcast_to(jnp.asarray(x, strain.dtype), volumes.shape) for x in lame
        )
        lateral = jnp.einsum("e,...eii->...e", first, strain)
        return _isotropic(lateral, strain) + 2.0 * jnp.einsum(
            "e,...eij->...eij", second, strain
        ), lateral

    strain = strain_of(displacement)
    elastic, lateral = stress_of(strain, material.elastic_lame())
    viscous = None
    if velocity is not None:
        viscous, more = stress_of(strain_of(velocity), material.viscous_lame())
        lateral = lateral + more
    if strain.shape[-1] == 3:
        lateral = jnp.zeros_like(lateral)
    around = jnp.zeros(points.shape[0], points.dtype).at[cells].add(volumes[:, None])
    return Stress(strain, elastic, viscous, lateral, volumes, around, cells)


def _von_mises(stress: Array, lateral: Array) -> Array:
    """Return sqrt(3/2 s:s) of the deviator s, with the lateral stress in the missing directions."""
    missing = 3 - stress.shape[-1]
    mean = (jnp.trace(stress, axis1=-2, axis2=-1) + missing * lateral) / 3.0
    deviator = stress - _isotropic(mean, stress)
    square = jnp.sum(deviator**2, axis=(-2, -1)) + missing * (lateral - mean) ** 2
    is_loaded = square > 0.0
    return jnp.where(is_loaded, jnp.sqrt(1.5 * jnp.where(is_loaded, square, 1.0)), 0.0)


def _isotropic(value: Array, like: Array) -> Array:
    """Return value I, (..., d, d), for tensors like (..., d, d)."""
    return jnp.einsum("...,ij->...ij", value, jnp.eye(like.shape[-1], dtype=like.dtype))
