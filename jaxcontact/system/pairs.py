"""The contact pairs of a scene as arrays."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


class ContactPairs(NamedTuple):
    """All contact pairs of a scene."""

    nodes: np.ndarray
    """Node of each pair, (C,) int32."""

    masters: np.ndarray
    """Nodes of the other body that a pair is coupled to, (C, m) int32; its own node for none."""

    gap: Array | np.ndarray
    """Distance to the obstacle, (C,) [m]."""

    normals: Array | np.ndarray
    """Unit normals towards the obstacle, (C, d)."""

    area: Array | np.ndarray
    """Integral of the hat function of the node over its contact set, (C,) [m^(d-1)]; with another
    body, over what lies before that."""

    rounding: Array | np.ndarray
    """Rounding error of the gap, that of the positions of node and obstacle included, (C,) [m]."""

    shares: Array | np.ndarray
    """Share of each of them in what the pair is measured from, (C, m); zero for none."""

    held: Array | np.ndarray
    """Share of the nodes of each clamped set, (C, S); see `clamped_numbers`."""

    owner: np.ndarray
    """Number of its obstacle in `merged_obstacles`, (C,) int32."""

    members: np.ndarray
    """Whether a pair stands for one of each contact set, in the order of their names, (C, K)."""

    @property
    def row_nodes(self) -> np.ndarray:
        """Nodes of the rows of N, the node of the pair first, (C, 1+m) int32."""
        return np.concatenate([self.nodes[:, None], self.masters], axis=1)

    def row_weights(self) -> Array:
        """Return the entries of the rows of N, nu and -m_k nu, (C, (1+m) d)."""
        return _row_weights(self.normals, self.shares)


@jax.jit
def _row_weights(normals: Array, shares: Array) -> Array:
    own = jnp.ones((len(normals), 1), normals.dtype)
    factors = jnp.concatenate([own, -shares.astype(own.dtype)], axis=1)
    entries = factors[:, :, None] * normals[:, None, :]  # (C, node, i)
    return entries.reshape(len(entries), entries.shape[1] * entries.shape[2])
