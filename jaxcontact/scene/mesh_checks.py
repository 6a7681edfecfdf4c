"""What arrays must satisfy to be a mesh."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxcontact.scene.cells import cell_volumes, facet_keys
from jaxcontact.transforms.traced import Values, as_array, is_traced


def match_boundary(name: str, facets: np.ndarray, boundary: np.ndarray) -> np.ndarray:
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


def as_points(points: ArrayLike) -> Values:
    """Node positions as float64 NumPy, or as the JAX array they are, with their shape checked."""
    is_kept = isinstance(points, jax.Array) and jnp.issubdtype(points.dtype, jnp.floating)
    array: Values = points if is_kept else np.array(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] not in (1, 2, 3) or not len(array):
        raise ValueError(f"points have shape {array.shape}; pass 1, 2 or 3 coordinates per node")
    return array


def as_indices(array: ArrayLike, what: str, columns: tuple[int, ...], size: int) -> np.ndarray:
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


def as_motion(
    rotation: ArrayLike | None, translation: ArrayLike | None, d: int
) -> tuple[Values, Values]:
    """A rotation (d,d) and a translation (d,) [m], checked; None is none."""
    turn = np.eye(d) if rotation is None else as_array(rotation)
    shift = np.zeros(d) if translation is None else as_array(translation)
    if turn.shape != (d, d) or shift.shape != (d,):
        raise ValueError(
            f"a mesh of dimension {d} needs a rotation ({d}, {d}) and a translation ({d},), "
            f"got {turn.shape} and {shift.shape}"
        )
    if is_traced(turn):
        return turn, shift
    matrix = np.asarray(turn)
    # Up to rounding in float32.
    is_orthogonal = np.allclose(matrix @ matrix.T, np.eye(d), atol=1e-5)
    if not is_orthogonal or np.linalg.det(matrix) <= 0.0:
        raise ValueError(f"rotation must be orthogonal with determinant 1, got {matrix.tolist()}")
    return turn, shift


def check_cells(cells: np.ndarray, n_nodes: int) -> None:
    """Raise if a cell names a node twice or a node is in no cell."""
    ordered = np.sort(cells, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if repeated.size:
        raise ValueError(f"cells {_listed(repeated)} name a node twice: remove these cells")
    unused = np.flatnonzero(np.bincount(cells.ravel(), minlength=n_nodes) == 0)
    if unused.size:
        advice = "used, cells = np.unique(cells, return_inverse=True); points = points[used]"
        raise ValueError(f"nodes {_listed(unused)} are in no cell: remove them ({advice})")


def check_geometry(points: Values, cells: np.ndarray) -> None:
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
