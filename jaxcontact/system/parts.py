"""The named parts of a scene, so that loads, obstacles and supports can change in time by name.

Small arrays only: what belongs to one facet set, or to the nodes around it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.cells import end_signs
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.material import KelvinVoigt
from jaxcontact.scene.scene import Scene
from jaxcontact.system.pairs import ContactPairs
from jaxcontact.transforms.traced import as_array, take_rows


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ClampedSet:
    """A clamped facet set, and the cells through which the other nodes feel it move."""

    nodes: np.ndarray
    """Nodes of the set, (k,) int32."""

    cells: np.ndarray
    """Nodes of the z cells that touch the set, (z, d+1) int32."""

    material: KelvinVoigt
    """Material of these cells, its values scalars or (z,)."""

    is_alone: np.ndarray
    """Whether no node is in another clamped set too, () bool; else it cannot move by itself."""

    shares: Array
    """Share of the set in what each contact pair is measured from, (C,); zero without `Facets`."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Parts:
    """The named parts of a scene with C contact pairs."""

    facets: dict[str, np.ndarray]
    """Nodes of the facets of each set of the mesh, (F, d) int32, oriented outward."""

    ends: np.ndarray
    """1 at right and -1 at left ends of bodies in one dimension, (N,); (0,) in more."""

    obstacles: dict[str, np.ndarray]
    """Which pairs move with the rigid obstacle of each contact set, (C,): 1, and 0 for the others;
    2 or more for a pair that stands for several sets: with which of them it moves is not known."""

    clamped: dict[str, ClampedSet]
    """The clamped sets."""

    def with_pairs(self, kept: np.ndarray) -> Parts:
        """Return the parts with some of the contact pairs, their numbers (P,) int."""
        clamped = {
            name: replace(moved, shares=take_rows(moved.shares, kept))
            for name, moved in self.clamped.items()
        }
        obstacles = {name: take_rows(members, kept) for name, members in self.obstacles.items()}
        return replace(self, obstacles=obstacles, clamped=clamped)


def named_parts(
    scene: Scene,
    pairs: ContactPairs,
    material: KelvinVoigt,
    dtype: np.dtype,
) -> Parts:
    """Return the named parts of a scene.

    Args:
        scene: the scene.
        pairs: its contact pairs.
        material: its values scalars, or one for each cell (E,).
        dtype: type of the values.
    """
    mesh = scene.mesh
    n_sets = np.count_nonzero(pairs.members, axis=1)
    obstacles = {
        name: np.where(pairs.members[:, column], n_sets, 0).astype(dtype)
        for column, name in enumerate(sorted(scene.contact))
        if not isinstance(scene.contact[name], Facets)
    }
    sets = {name: np.unique(mesh.facets[name]).astype(np.int32) for name in scene.clamped}
    clamped = {}
    for number, name in enumerate(scene.clamped):
        others = [nodes for other, nodes in sets.items() if other != name]
        shared = np.intersect1d(sets[name], np.concatenate(others)) if others else np.zeros(0)
        touching = np.flatnonzero(np.any(np.isin(mesh.cells, sets[name]), axis=1))
        clamped[name] = ClampedSet(
            nodes=sets[name],
            cells=np.asarray(mesh.cells)[touching],
            material=_of_cells(material, touching, dtype),
            is_alone=np.asarray(shared.size == 0),
            shares=jnp.asarray(pairs.held[:, number], dtype),
        )
    return Parts(dict(mesh.facets), end_signs(mesh.cells).astype(dtype), obstacles, clamped)


def _of_cells(material: KelvinVoigt, cells: np.ndarray, dtype: np.dtype) -> KelvinVoigt:
    """Return the material of some cells, from scalars or from the values of all cells (E,)."""

    def of_cells(x: Array) -> Array:
        return jnp.asarray(x if np.ndim(x) == 0 else take_rows(as_array(x), cells), dtype)

    return jax.tree.map(of_cells, material)
