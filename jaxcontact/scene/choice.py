"""Boundary facets that a function of their place and normal chooses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.scene.cells import area_vectors, boundary_facets, end_signs


def chosen_facets(
    name: str,
    x: np.ndarray,
    cells: np.ndarray,
    predicate: Callable[[np.ndarray, np.ndarray], ArrayLike],
) -> np.ndarray:
    """Return the boundary facets for which a predicate holds, (F, d) int32.

    Args:
        name: of the set, for messages.
        x: node positions, (N, d) [m].
        cells: (E, d+1).
        predicate: see `Mesh.with_set`.

    Raises:
        ValueError: if it does not return one bool for each facet or chooses none.
    """
    boundary = boundary_facets(cells)
    vectors = area_vectors(x, boundary, end_signs(cells))
    normals = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    is_chosen = np.asarray(predicate(x[boundary].mean(axis=1), normals))
    if is_chosen.dtype != bool or is_chosen.shape != (len(boundary),):
        raise ValueError(
            f"the predicate must return bool of shape ({len(boundary)},), one for each "
            f"boundary facet; it returned {is_chosen.dtype} of shape {is_chosen.shape}"
        )
    if not is_chosen.any():
        low, high = x[boundary].min(axis=(0, 1)), x[boundary].max(axis=(0, 1))
        raise ValueError(
            f"facet set {name!r}: the predicate chooses none of the {len(boundary)} boundary "
            f"facets, whose nodes lie between {low.tolist()} and {high.tolist()}"
        )
    return boundary[is_chosen]
