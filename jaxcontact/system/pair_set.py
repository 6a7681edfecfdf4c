"""Sets of contact pairs, such as those that are taken to stay open, and the choice of some."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import jax
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.system.sparse import ContactNormals
from jaxcontact.transforms.traced import is_traced, join_rows, take_rows


class Pairs(Protocol):
    """Contact pairs with their gap, such as those of a `System`."""

    @property
    def normals(self) -> ContactNormals:
        """N, (C, n)."""
        ...

    @property
    def gap(self) -> Array:
        """Initial gap, (C,) [m]."""
        ...

    @property
    def gap_rounding(self) -> Array:
        """Rounding error of the gap, (C,) [m]."""
        ...

    @property
    def contact_nodes(self) -> np.ndarray:
        """Node of each pair, (C,) int32."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PairSet:
    """Some contact pairs, P of them; see `Pairs`."""

    normals: ContactNormals
    """Their rows of N, (P, n)."""

    gap: Array
    """Their initial gap, (P,) [m]."""

    gap_rounding: Array
    """Rounding error of the gap, (P,) [m]."""

    contact_nodes: np.ndarray
    """Node of each of them, (P,) int32."""

    @classmethod
    def of(cls, pairs: Pairs, numbers: np.ndarray, beside: PairSet | None) -> PairSet | None:
        """Return some of the pairs, after those of another set; None if there are none."""
        chosen = cls(
            pairs.normals.rows(numbers),
            take_rows(pairs.gap, numbers),
            take_rows(pairs.gap_rounding, numbers),
            take_rows(pairs.contact_nodes, numbers),
        )
        if beside is not None:
            chosen = jax.tree.map(join_rows, beside, chosen)
        return chosen if chosen.normals.count else None


def pair_numbers(pairs: ArrayLike, count: int) -> np.ndarray:
    """Return the numbers of the chosen ones of C = `count` pairs, ascending, (P,) int.

    Raises:
        ValueError: if they are traced, not among those of the system, or a mask of another shape.
    """
    if is_traced(pairs):
        raise ValueError("the pairs that can touch must be concrete: choose them outside of jit")
    chosen = np.asarray(pairs)
    if chosen.dtype == bool and chosen.shape == (count,):
        return np.flatnonzero(chosen)
    if chosen.size == 0:
        return np.zeros(0, int)
    if chosen.dtype.kind not in "iu" or chosen.min() < 0 or chosen.max() >= count:
        raise ValueError(
            f"pairs must be a mask ({count},) bool or numbers from 0 to {count - 1}, got "
            f"{chosen.dtype} of shape {chosen.shape}"
        )
    return np.unique(chosen)
