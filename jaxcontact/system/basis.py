"""The space of a reduced model."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace

import jax
import numpy as np
from jax import Array

from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Basis:
    """The space of a reduced model: y = V q with V^T M V = I; n_full unknowns of the full one."""

    vectors: Array
    """V, (n_full, n) [kg^-1/2]: displacement components of the free nodes."""

    mass: ComponentwiseMatrix | SymmetricMatrix
    """M of the full model, (n_full, n_full) [kg]."""

    normals: ContactNormals
    """N of the full model, (C, n_full): whether a given nodal field is admissible."""

    pairs: np.ndarray
    """Number of each pair among those of the full model, (C,) int32."""

    modes: int = field(metadata={"static": True})
    """Number of vibrations, or of what took their place."""

    mark: str = field(metadata={"static": True})
    """Fingerprint of V, see `mark_of`: whether unknowns of two models mean the same field. Models
    that are stacked for vmap are of one mark: replace it in all of them by the same word."""

    def restrict(self, free: Array) -> Array:
        """Return V^T M y, the M-orthogonal projection (..., n) of free components (..., n_full)."""
        columns = free.reshape(-1, free.shape[-1]).T
        projected = (self.mass @ columns).T @ self.vectors
        return projected.reshape(*free.shape[:-1], -1)

    def with_pairs(self, kept: np.ndarray) -> Basis:
        """Return the space with some of the contact pairs, their numbers (P,) int."""
        return replace(self, normals=self.normals.rows(kept), pairs=self.pairs[kept])


def mark_of(vectors: np.ndarray) -> str:
    """Return the fingerprint of a concrete V."""
    return hashlib.blake2b(vectors.tobytes(), digest_size=8).hexdigest()
