"""Simplicial meshes: nodes, cells, and named parts of the boundary and of the body.

A mesh of dimension d = 1, 2 or 3 consists of segments, triangles or tetrahedra. Every cell
(x_0, ..., x_d) is positively oriented,

    det(x_1 - x_0, ..., x_d - x_0) > 0,    volume = det / d!,

that is x_1 > x_0 in 1D and counter-clockwise in 2D. Boundary facets carry the orientation of their
cell, so that the outward normal of a facet (a, b) in 2D is b - a turned clockwise by 90 degrees and
that of (a, b, c) in 3D points along (b - a) x (c - a).

Topology is concrete and lives on the host; node positions may be traced (shape derivatives).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np
from jax import Array
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxcontact.scene.cells import boundary_facets, cell_volumes, components, facet_keys
from jaxcontact.scene.choice import chosen_facets
from jaxcontact.scene.mesh_checks import (
    as_indices,
    as_motion,
    as_points,
    check_cells,
    check_geometry,
    match_boundary,
)
from jaxcontact.scene.quality import MeshQuality, mesh_quality
from jaxcontact.scene.refine import edges_of, refine_cells, refine_facets, refine_points
from jaxcontact.transforms.show import shown_by
from jaxcontact.transforms.traced import Values, is_traced

if TYPE_CHECKING:
    import meshio

__all__ = ["Mesh", "boundary_facets", "cell_volumes", "facet_keys"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Mesh:
    """Simplicial mesh with named facet sets and regions; build it with `from_arrays`."""

    points: Array | np.ndarray
    """Node positions, (N,d) [m]: float64 NumPy, or the JAX array that was given."""
    cells: np.ndarray
    """Node indices of the positively oriented cells, (E,d+1) int32."""
    facets: dict[str, np.ndarray]
    """Node indices of the boundary facets of each set, (F,d) int32, oriented outward."""
    regions: dict[str, np.ndarray]
    """Cell indices of each region, (R,) int32."""
    layout: np.ndarray | None = None
    """Last concrete node positions, (N,d) [m]: where `points` are traced, the facets that meet are
    found here. None if there were none."""

    @classmethod
    def from_arrays(
        cls,
        points: ArrayLike,
        cells: ArrayLike,
        facets: Mapping[str, ArrayLike] | None = None,
        regions: Mapping[str, ArrayLike] | None = None,
    ) -> Mesh:
        """Check node positions and topology and make them a mesh.

        Holds afterwards: every node belongs to a cell, every facet to at most two cells, every cell
        has positive volume, every named facet is a boundary facet and points outward (the order
        of its nodes may change for that).

        Args:
            points: Node positions, (N,d) [m] with d = 1, 2 or 3. A JAX array is kept as it is;
                when it is traced, nothing is checked that needs its values.
            cells: Node indices, (E,d+1), positively oriented.
            facets: Node indices of boundary facets by name, (F,d) each.
            regions: Cell indices by name, (R,) each.

        Returns:
            The mesh, with float64 points (unless they were a JAX array) and int32 indices.

        Raises:
            ValueError: A shape, dtype or name does not fit, a position is not finite, an index is
                out of range, topology is traced, a node is in no cell, a cell is inverted or flat,
                a facet has more than two cells, or a set is empty, off the boundary or has doubles.
        """
        facets, regions = facets or {}, regions or {}
        if odd := [name for name in (*facets, *regions) if not isinstance(name, str)]:
            raise ValueError(f"facet sets and regions {odd} have to be named by strings")
        x = as_points(points)
        n_nodes, d = x.shape
        corners = as_indices(cells, "cells", (d + 1,), n_nodes)
        check_cells(corners, n_nodes)
        check_geometry(x, corners)
        boundary = boundary_facets(corners)
        facet_sets = {}
        for name, facet_set in facets.items():
            indices = as_indices(facet_set, f"facet set {name!r}", (d,), n_nodes)
            facet_sets[name] = match_boundary(name, indices, boundary)
        cell_sets = {
            name: as_indices(region, f"region {name!r}", (), len(corners))
            for name, region in regions.items()
        }
        return cls(x, corners, facet_sets, cell_sets, layout=_layout(x, None))

    @staticmethod
    def from_meshio(source: meshio.Mesh, *, dimension: int | None = None) -> Mesh:
        """The mesh in an object of meshio, its groups included; see `read_mesh`."""
        from jaxcontact.scene.io import mesh_of

        return mesh_of(source, Path("the meshio mesh"), dimension)

    @staticmethod
    def from_gmsh(*, dimension: int | None = None) -> Mesh:
        """The mesh of the current model of Gmsh, its physical groups as sets and regions.

        Raises:
            ImportError: The package gmsh is not installed.
            ValueError: Gmsh is not initialised or holds no mesh, or as of `read_mesh`.
        """
        from jaxcontact.scene.gmsh_model import current_model

        return current_model(dimension)

    def with_points(self, points: ArrayLike) -> Mesh:
        """The same topology at other node positions, for moving meshes and shape derivatives.

        Args:
            points: Node positions, (N,d) [m]; may be traced.

        Returns:
            The mesh with these positions.

        Raises:
            ValueError: The shape differs, or concrete positions are not finite or invert a cell.

        Derivative: the identity from `points` to the field `points`.
        """
        x = as_points(points)
        if x.shape != self.points.shape:
            raise ValueError(f"points have shape {x.shape}; pass {self.points.shape}, all nodes")
        check_geometry(x, self.cells)
        return dataclasses.replace(self, points=x, layout=_layout(x, self.layout))

    def moved(
        self, rotation: ArrayLike | None = None, translation: ArrayLike | None = None
    ) -> Mesh:
        """The mesh in another place: rotation @ x + translation for every node x.

        Args:
            rotation: Rotation matrix about the origin, (d,d); None is none. May be traced.
            translation: (d,) [m]; None is none. May be traced.

        Returns:
            The mesh with the same sets and regions.

        Raises:
            ValueError: A shape does not fit, or a concrete matrix is no rotation.

        Derivative: by `points`, the rotation and the translation.
        """
        turn, shift = as_motion(rotation, translation, self.dimension)

        def move(x: Values) -> Values:
            # A product only where there is one: a translation leaves x @ 1 its digits.
            turned = x if rotation is None else x @ turn.T
            return turned + shift[None, :]

        mesh = (
            self
            if self.layout is None or is_traced((turn, shift))
            else dataclasses.replace(self, layout=move(self.layout))
        )
        return mesh.with_points(move(self.points))

    def refined(self) -> Mesh:
        """The mesh with every edge halved: 2^d cells of half the size for each cell.

        New nodes lie in the middle of the old edges and come after the old nodes, so that a curved
        boundary stays the polygon that it is; move its nodes with `with_points`. The children of
        cell k are the cells 2^d k to 2^d (k + 1) - 1; they do not degenerate, however often this is
        repeated (`scene/refine.py`).

        Returns:
            The mesh, with the sets and regions that hold the children of their facets and cells.

        Raises:
            ValueError: In 3D if no concrete node positions are known, which choose the cut.

        Derivative: by `points`.
        """
        edges, n_children = edges_of(self.cells), 2**self.dimension
        choice = self.positions("refinement") if self.dimension == 3 else self.points
        children = np.arange(n_children, dtype=np.int32)
        return Mesh(
            refine_points(self.points, edges),
            refine_cells(self.cells, edges, choice),
            {key: refine_facets(x, edges, self.n_nodes) for key, x in self.facets.items()},
            {key: (n_children * x[:, None] + children).ravel() for key, x in self.regions.items()},
            None if self.layout is None else refine_points(self.layout, edges),
        )

    def with_set(self, name: str, predicate: Callable[[np.ndarray, np.ndarray], ArrayLike]) -> Mesh:
        """The mesh with one more facet set: the boundary facets that a function chooses.

        Args:
            name: Name of the new set.
            predicate: Maps the centres (B,d) [m] and the outward unit normals (B,d) of all boundary
                facets to bool (B,), for instance `lambda x, n: n[:, -1] < -0.7` for what looks
                down. It gets NumPy arrays.

        Returns:
            The mesh with the set.

        Raises:
            ValueError: There is a set of this name, the function does not return one bool for each
                facet or chooses none, or no concrete node positions are known.
        """
        if not isinstance(name, str) or name in self.facets:
            raise ValueError(
                f"a new facet set needs a name, a string, beside those of {sorted(self.facets)}; "
                f"got {name!r}"
            )
        x = self.positions("the choice of facets")
        chosen = chosen_facets(name, x, self.cells, predicate)
        return dataclasses.replace(self, facets={**self.facets, name: chosen})

    def quality(self) -> MeshQuality:
        """The mean ratio and the smallest height of every cell; print it to see the worst cells.

        Raises:
            ValueError: No concrete node positions are known.
        """
        return mesh_quality(self.positions("mesh quality"), self.cells)

    def positions(self, purpose: str) -> np.ndarray:
        """The node positions if they are concrete, else the last concrete ones, (N,d) [m].

        Args:
            purpose: What needs them, for the message.

        Raises:
            ValueError: There are none.
        """
        if not is_traced(self.points):
            return np.asarray(self.points, float)
        if self.layout is None or is_traced(self.layout):
            raise ValueError(
                f"{purpose} needs concrete node positions, and JAX traces them; build the mesh "
                "outside of jit, grad and vmap and move its nodes there with "
                "mesh.with_points(points)"
            )
        return np.asarray(self.layout, float)

    @property
    def dimension(self) -> int:
        """Space dimension d."""
        return self.points.shape[1]

    @property
    def n_nodes(self) -> int:
        """Number of nodes N."""
        return self.points.shape[0]

    @property
    def n_cells(self) -> int:
        """Number of cells E."""
        return self.cells.shape[0]

    def components(self) -> np.ndarray:
        """The connected part of each node, (N,) int32, numbered from 0 on by their first nodes.

        A mesh of several bodies has several. A body that should be one has too, if its parts do
        not share the nodes at which they meet; merge these, or the parts move independently.
        """
        return components(self.cells, self.n_nodes)

    def _facts(self) -> dict[str, object]:
        return {
            "dimension": self.dimension,
            "nodes": self.n_nodes,
            "cells": self.n_cells,
            "facets": {name: len(facets) for name, facets in self.facets.items()},
            "regions": {name: len(cells) for name, cells in self.regions.items()},
        }

    __repr__, _repr_html_ = shown_by(_facts)


def _layout(points: Values, last: np.ndarray | None) -> np.ndarray | None:
    """Concrete positions as NumPy; the last ones if these are traced."""
    return last if isinstance(points, Tracer) else np.asarray(points)
