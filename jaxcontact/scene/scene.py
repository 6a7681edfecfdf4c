"""A scene: bodies, their material, how they are held and loaded, and what they may touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.scene.compound import Along
from jaxcontact.scene.facets import Facets, check_each_interface_once, check_facets
from jaxcontact.scene.material import KelvinVoigt, check_material
from jaxcontact.scene.mesh import Mesh
from jaxcontact.scene.obstacle import Obstacle, check_obstacle
from jaxcontact.transforms.options import check_kind
from jaxcontact.transforms.traced import as_array, is_traced


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scene:
    """Viscoelastic bodies and the rigid obstacles or other bodies they may meet, without friction.

    `discretize` checks a scene and turns it into matrices.
    """

    mesh: Mesh
    """The bodies, connected parts of the mesh, in their stress-free reference configuration."""

    material: KelvinVoigt | Mapping[str, KelvinVoigt]
    """One material, or one for each region of the mesh (then every cell is in one region)."""

    clamped: tuple[str, ...] = field(default=(), metadata={"static": True})
    """Names of the facet sets that are held at zero displacement."""

    contact: Mapping[str, Obstacle | tuple[Obstacle, ...] | Facets] = field(default_factory=dict)
    """Facet sets that may touch, with the obstacle that each may touch: a rigid one, a tuple of
    rigid ones that each node may touch all, or `Facets` of another body. Nodes that are clamped
    too have no contact with rigid ones: their gap is checked in the scene, and no more where a
    `Schedule` moves obstacle or clamped set."""

    traction: Mapping[str, Array | np.ndarray] = field(default_factory=dict)
    """Facet sets with a constant surface force, each (d,) [N/m^(d-1)]."""

    body_force: Array | np.ndarray | None = None
    """Constant volume force, (d,) [N/m^d]; None is none."""

    rollers: Mapping[str, Array | np.ndarray | None] = field(default_factory=dict)
    """Facet sets whose nodes are held in one direction and slide freely across it, each a vector
    (d,) of any positive length, or None for the normal of the facets: rollers, planes of symmetry,
    slanted guides. A node on the edge of two sets, or of one set with an edge of more than 40
    degrees, is held in the directions of both."""

    large_rotation: bool = field(default=False, metadata={"static": True})
    """Whether bodies without clamps may turn by any angle, at small strain: each then deforms in a
    frame of its own, and meets its obstacles where it is. In one dimension nothing turns."""


def check_scene(scene: Scene) -> None:
    """Check everything in a scene that is concrete.

    Raises:
        ValueError: if it is no scene, a name is not in the mesh, a contact set is clamped as a
            whole or, before another body, in part, two bodies share nodes or constrain each other's
            facets, a vector has the wrong shape, is not finite or, of a roller, zero, or a material
            value is out of range.
    """
    check_kind("discretize", scene, Scene, "scene = jc.Scene(mesh, material, ...)")
    mesh = scene.mesh
    if isinstance(scene.clamped, str):
        raise ValueError(f"clamped must be a tuple of names; write clamped=({scene.clamped!r},)")
    if isinstance(scene.clamped, Mapping):
        raise ValueError(
            f"clamped must be a tuple of names, clamped={tuple(scene.clamped)}: these sets are "
            "held at zero; how they move is said by jc.simulate(..., schedule=jc.Schedule(motion="
            "{name: displacements (T+1, d)}))"
        )
    if not isinstance(scene.contact, Mapping):
        raise ValueError(
            "contact must be a mapping from facet sets to obstacles, such as contact={'bottom': "
            f"jc.HalfSpace(point, normal)}}; got a {type(scene.contact).__name__}"
        )
    for name in (*scene.clamped, *scene.rollers, *scene.contact, *scene.traction):
        if name not in mesh.facets:
            raise ValueError(f"facet set {name!r} is not in the mesh; it has {sorted(mesh.facets)}")
    clamped = clamped_nodes(scene)
    for name, obstacle in scene.contact.items():
        if obstacle == ():
            raise ValueError(f"contact[{name!r}] is an empty tuple; give it an obstacle")
        shared = np.intersect1d(clamped, mesh.facets[name])
        if shared.size and isinstance(obstacle, Facets):
            raise ValueError(
                f"contact set {name!r} and the clamped sets {sorted(scene.clamped)} share "
                f"{shared.size} nodes, first {shared[:5].tolist()}, and what may touch them moves: "
                f"write contact={{{obstacle.name!r}: jc.Facets({name!r})}}, or leave a row of "
                "facets between the two sets"
            )
        if shared.size == np.unique(mesh.facets[name]).size:
            raise ValueError(f"every node of contact set {name!r} is clamped; clamp fewer nodes")
        if isinstance(obstacle, Facets):
            check_facets(name, obstacle, mesh)
            continue
        for rigid in obstacle if isinstance(obstacle, tuple) else (obstacle,):
            check_obstacle(rigid, mesh.dimension)
    check_each_interface_once(scene.contact, mesh)
    vectors = {f"traction[{name!r}]": vector for name, vector in scene.traction.items()}
    if scene.body_force is not None:
        vectors["body_force"] = scene.body_force
    for name, vector in vectors.items():
        _check_vector(name, vector, mesh.dimension)
    for name, vector in scene.rollers.items():
        if vector is None:
            continue
        _check_vector(f"rollers[{name!r}]", vector, mesh.dimension)
        if not is_traced(vector) and not np.any(np.asarray(vector)):
            raise ValueError(
                f"rollers[{name!r}] must not be the zero vector; None takes the normals of the set"
            )
    if scene.large_rotation:
        _check_large_rotation(scene)
    _check_materials(scene)


def contact_obstacles(scene: Scene) -> list[tuple[str, Obstacle | Facets]]:
    """Return every obstacle with the name of its contact set, in the order of the names."""
    return [
        (name, obstacle)
        for name, value in sorted(scene.contact.items())
        for obstacle in (value if isinstance(value, tuple) else (value,))
    ]


def clamped_nodes(scene: Scene) -> np.ndarray:
    """Return the sorted clamped nodes, (n_clamped,) int32."""
    sets = [np.ravel(scene.mesh.facets[name]) for name in scene.clamped]
    return np.unique(np.concatenate(sets)) if sets else np.zeros(0, np.int32)


def clamped_numbers(scene: Scene) -> np.ndarray:
    """Return the number of a clamped set that each node is in, (N,) int, -1 for none."""
    numbers = np.full(scene.mesh.n_nodes, -1)
    for number, name in enumerate(scene.clamped):
        numbers[scene.mesh.facets[name]] = number
    return numbers


def cellwise_material(scene: Scene) -> KelvinVoigt:
    """Return the material with arrays as fields: scalars, or one value per cell (E,)."""
    if isinstance(scene.material, KelvinVoigt):
        values = {f.name: getattr(scene.material, f.name) for f in fields(KelvinVoigt)}
        return KelvinVoigt(**{name: jnp.asarray(value, float) for name, value in values.items()})
    region_of_cell = np.zeros(scene.mesh.n_cells, np.int32)
    for number, region in enumerate(scene.material):
        region_of_cell[scene.mesh.regions[region]] = number
    return _spread(tuple(scene.material.values()), region_of_cell)


@jax.jit
def _spread(materials: tuple[KelvinVoigt, ...], region_of_cell: Array) -> KelvinVoigt:
    """Return the material of every cell, its fields (E,), from those of the regions."""
    return jax.tree.map(
        lambda *values: jnp.stack([jnp.asarray(value, float) for value in values])[region_of_cell],
        *materials,
    )


def is_elastic(scene: Scene) -> bool:
    """Return True if every material of the scene is known to have no viscosity."""
    if isinstance(scene.material, KelvinVoigt):
        return scene.material.is_elastic()
    return all(material.is_elastic() for material in scene.material.values())


def _check_vector(name: str, vector: ArrayLike, dimension: int) -> None:
    vector = as_array(vector)
    if vector.shape != (dimension,):
        raise ValueError(f"{name} must have shape ({dimension},), got {vector.shape}")
    if not is_traced(vector) and not np.all(np.isfinite(np.asarray(vector))):
        raise ValueError(f"{name} must be finite, got {vector}")


def _check_large_rotation(scene: Scene) -> None:
    for name, obstacle in contact_obstacles(scene):
        if isinstance(obstacle, Facets | Along):
            raise ValueError(
                f"contact[{name!r}] is {type(obstacle).__name__}, which knows the reference "
                "configuration only; with large_rotation=True a contact set takes obstacles by "
                "their signed distance, such as jc.HalfSpace"
            )
    if scene.rollers:
        raise ValueError(
            f"the rollers {sorted(scene.rollers)} hold directions in space, but bodies turn with "
            "large_rotation=True; leave out one of the two"
        )


def _check_materials(scene: Scene) -> None:
    if isinstance(scene.material, KelvinVoigt):
        check_material(scene.material, scene.mesh.n_cells)
        return
    if not isinstance(scene.material, Mapping):
        raise ValueError(
            "material must be a KelvinVoigt or a mapping from region names to KelvinVoigt, got "
            f"{type(scene.material).__name__}"
        )
    covered = np.zeros(scene.mesh.n_cells, int)
    for region, material in scene.material.items():
        if region not in scene.mesh.regions:
            raise ValueError(
                f"region {region!r} is not in the mesh; it has {sorted(scene.mesh.regions)}"
            )
        check_material(material)
        covered[scene.mesh.regions[region]] += 1
    if np.any(covered != 1):
        wrong = np.flatnonzero(covered != 1)
        raise ValueError(
            f"{wrong.size} cells are not in exactly one region with a material, first "
            f"{wrong[:5].tolist()}; give every cell one material"
        )
