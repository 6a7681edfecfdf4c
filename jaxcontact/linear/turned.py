"""A factor whose contact normals turn: condensed to the contact nodes, not to their normals.

With the components E of all contact nodes condensed, E D^-1 E^T is constant, and rows nu of any
direction at these nodes have the compliance nu E D^-1 E^T nu^T. Source: MATH.md 12.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.linear.interface import CondensingFactor, Partial
from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TurnedFactor:
    """A condensing factor for C contact rows at c nodes; make it with `turned_factor`."""

    nodal: CondensingFactor
    """The factor with the components of the contact nodes as rows: the first ones of all c nodes,
    then the next, (d c,)."""

    weights: Array
    """The contact rows at their nodes, (C, d)."""

    places: np.ndarray | None
    """Number of the node of each row, (C,) int32; None if they are those of the nodes."""

    compliance: Array
    """N D^-1 N^T, (C, C)."""

    @property
    def is_positive(self) -> Array:
        """True if D is positive definite, () bool; if not, all results contain NaN."""
        return self.nodal.is_positive

    def solve(self, rhs: Array) -> Array:
        """Return D^-1 rhs, (n,)."""
        return self.nodal.solve(rhs)

    def condense(self, rhs: Array) -> tuple[Partial, Array]:
        """Return what `expand` needs and N D^-1 rhs, (C,)."""
        partial, free = self.nodal.condense(rhs)
        free = free.reshape(self.weights.shape[1], -1)
        free = free if self.places is None else free[:, self.places]
        return partial, jnp.sum(self.weights.T * free, axis=0)

    def expand(self, partial: Partial, multiplier: Array) -> Array:
        """Return D^-1 (rhs - N^T multiplier), (n,)."""
        forces = self.weights.T * multiplier[None, :]
        if self.places is not None:
            d = len(forces)
            nodal = jnp.zeros((d, self.nodal.compliance.shape[0] // d), forces.dtype)
            forces = nodal.at[:, self.places].add(forces)
        return self.nodal.expand(partial, forces.reshape(-1))


@in_full_precision
def turned_factor(
    nodal: CondensingFactor, weights: Array, places: np.ndarray | None
) -> TurnedFactor:
    """Return the factor for contact rows (C, d) at the numbered contact nodes (C,)."""
    d = weights.shape[1]
    n_nodes = nodal.compliance.shape[0] // d
    blocks = nodal.compliance.reshape(d, n_nodes, d, n_nodes)

    def block(i: int, j: int) -> Array:
        whole = blocks[i, :, j]
        own = whole if places is None else whole[places][:, places]
        return weights[:, i, None] * own * weights[None, :, j]

    terms = [block(i, j) for i in range(d) for j in range(d)]
    return TurnedFactor(nodal, weights, places, sum(terms[1:], terms[0]))
