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
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxcontact.scene.cells import boundary_facets, cell_volumes, components, facet_keys
from jaxcontact.transforms.traced import as_array, is_traced

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
        x = _as_points(points)
        n_nodes, d = x.shape
        corners = _as_indices(cells, "cells", (d + 1,), n_nodes)
        _check_cells(corners, n_nodes)
        _check_geometry(x, corners)
        boundary = boundary_facets(corners)
        facet_sets = {}
        for name, facet_set in facets.items():
            indices = _as_indices(facet_set, f"facet set {name!r}", (d,), n_nodes)
            facet_sets[name] = _match_boundary(name, indices, boundary)
        cell_sets = {
            name: _as_indices(region, f"region {name!r}", (), len(corners))
            for name, region in regions.items()
        }
        return cls(x, corners, facet_sets, cell_sets, layout=_layout(x, None))

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
        x = _as_points(points)
        if x.shape != self.points.shape:
            raise ValueError(f"points have shape {x.shape}; pass {self.points.shape}, all nodes")
        _check_geometry(x, self.cells)
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
        d, motion = self.dimension, (rotation, translation)
        turn, shift = (np.eye(d) if rotation is None else as_array(rotation)), np.zeros(d)
        if translation is not None:
            shift = as_array(translation)
        if turn.shape != (d, d) or shift.shape != (d,):
            raise ValueError(
                f"a mesh of dimension {d} needs a rotation ({d}, {d}) and a translation ({d},), "
                f"got {turn.shape} and {shift.shape}"
            )
        if not is_traced(turn) and not _is_rotation(np.asarray(turn)):
            raise ValueError(f"rotation must be orthogonal with determinant 1, got {turn.tolist()}")

        def move(x: Any) -> Any:
            # A product only where there is one: a translation leaves x @ 1 its digits.
            turned = x if rotation is None else x @ turn.T
            return turned + shift[None, :]

        mesh = (
            self
            if self.layout is None or is_traced(motion)
            else dataclasses.replace(self, layout=move(self.layout))
        )
        return mesh.with_points(move(self.points))

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


def _layout(points: Any, last: np.ndarray | None) -> np.ndarray | None:
    """Concrete positions as NumPy; the last ones if these are traced."""
    return last if isinstance(points, Tracer) else np.asarray(points)


def _is_rotation(matrix: np.ndarray) -> bool:
    """Whether a matrix (d,d) is a rotation, up to rounding in float32."""
    is_orthogonal = np.allclose(matrix @ matrix.T, np.eye(len(matrix)), atol=1e-5)
    return is_orthogonal and np.linalg.det(matrix) > 0.0


def _match_boundary(name: str, facets: np.ndarray, boundary: np.ndarray) -> np.ndarray:
    """The rows of `boundary` with the nodes of `facets`, (F,d), (B,d) -> (F,d)."""
    n_nodes = int(max(facets.max(), boundary.max())) + 1
    keys, boundary_keys = facet_keys(facets, n_nodes), facet_keys(boundary, n_nodes)
    order = np.argsort(boundary_keys)
    found = order[np.searchsorted(boundary_keys[order], keys).clip(max=len(order) - 1)]
    stray = np.flatnonzero(boundary_keys[found] != keys)
    if stray.size:
        raise ValueError(
            f"facet set {name!r}: rows {_listed(stray)} are not on the boundary, the first is "
            f"{facets[stray[0]].tolist()}: choose rows of "
            "jaxcontact.scene.mesh.boundary_facets(cells)"
        )
    repeated = np.flatnonzero(np.bincount(found)[found] > 1)
    if repeated.size:
        raise ValueError(
            f"facet set {name!r}: rows {_listed(repeated)} are not unique: list each facet once"
        )
    return boundary[found]


def _as_points(points: ArrayLike) -> Any:
    """Node positions as float64 NumPy, or as the JAX array they are, with their shape checked."""
    is_kept = isinstance(points, jax.Array) and jnp.issubdtype(points.dtype, jnp.floating)
    array: Any = points if is_kept else np.array(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] not in (1, 2, 3) or not len(array):
        raise ValueError(f"points have shape {array.shape}; pass 1, 2 or 3 coordinates per node")
    return array


def _as_indices(array: ArrayLike, what: str, columns: tuple[int, ...], size: int) -> np.ndarray:
    """Concrete int32 indices of shape (rows, *columns) with values in [0, size)."""
    if isinstance(array, Tracer):
        raise ValueError(
            f"{what}: topology must be concrete, but JAX traces it; build the mesh outside of "
            "jit, grad and vmap and move its nodes there with mesh.with_points(points)"
        )
    indices = np.asarray(array)
    if indices.size == 0:
        raise ValueError(f"{what}: empty; list at least one or leave it out")
    if indices.ndim != 1 + len(columns) or indices.shape[1:] != columns:
        shape = ", ".join(["rows", *map(str, columns)])
        raise ValueError(f"{what}: shape {indices.shape}, expected ({shape}) for this mesh")
    if indices.dtype.kind not in "iu":
        raise ValueError(f"{what}: dtype {indices.dtype}, expected integer indices counted from 0")
    outside = np.flatnonzero(((indices < 0) | (indices >= size)).reshape(len(indices), -1).any(1))
    if outside.size:
        raise ValueError(
            f"{what}: rows {_listed(outside)} have an index outside 0..{size - 1}, the first is "
            f"{indices[outside[0]].tolist()}: count from 0 to the size of the mesh"
        )
    return indices.astype(np.int32)


def _check_cells(cells: np.ndarray, n_nodes: int) -> None:
    """Raise if a cell names a node twice or a node is in no cell."""
    ordered = np.sort(cells, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if repeated.size:
        raise ValueError(f"cells {_listed(repeated)} name a node twice: remove these cells")
    unused = np.flatnonzero(np.bincount(cells.ravel(), minlength=n_nodes) == 0)
    if unused.size:
        advice = "used, cells = np.unique(cells, return_inverse=True); points = points[used]"
        raise ValueError(f"nodes {_listed(unused)} are in no cell: remove them ({advice})")


def _check_geometry(points: Any, cells: np.ndarray) -> None:
    """Raise if concrete positions are not finite or leave a cell without positive volume."""
    if isinstance(points, Tracer) or isinstance(cells, Tracer):
        return
    x = np.asarray(points)
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise ValueError(f"nodes {_listed(bad)} have a NaN or infinite coordinate: correct them")
    d = x.shape[1]
    determinant = cell_volumes(x, cells) * math.factorial(d)
    # A determinant this small cannot be told from zero after rounding the coordinates.
    corners = x[cells]  # (N,d) -> (E,d+1,d)
    diameter = np.ptp(corners, axis=1).max(axis=1)
    round_off = 16 * np.finfo(x.dtype).eps * np.abs(corners).max(axis=(1, 2)) * diameter ** (d - 1)
    degenerate = np.flatnonzero(np.abs(determinant) <= round_off)
    if degenerate.size:
        raise ValueError(f"cells {_listed(degenerate)} have no volume: remove or remesh them")
    inverted = np.flatnonzero(determinant < 0)
    if inverted.size:
        advice = "cells[inverted, -2:] = cells[inverted, :-3:-1]"
        raise ValueError(f"cells {_listed(inverted)} are inverted: swap two nodes ({advice})")


def _listed(indices: np.ndarray) -> str:
    """The first offending indices and how many there are."""
    return f"{indices[:5].tolist()} ({len(indices)} in all)"
