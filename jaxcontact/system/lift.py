"""From unknowns to nodal fields."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lift:
    """What makes nodal fields of the unknowns of a system."""

    node_numbers: np.ndarray | Array | None
    """Position of each node among the free ones, (N,) int32; their number for a clamped node. None
    will do where no node is clamped."""

    vectors: Array | None
    """Basis of a reduced model, (n_full, n); None is all displacement components."""

    dimension: int = field(metadata={"static": True})
    """Space dimension d."""

    is_clamped: bool = field(metadata={"static": True})
    """Whether some nodes are clamped."""

    @property
    def is_reshape(self) -> bool:
        """Whether a nodal field is the unknowns in another shape."""
        return self.vectors is None and not self.is_clamped

    def __call__(self, x: Array) -> Array:
        """Return the nodal field (..., N, d) of unknowns (..., n); zero on clamped nodes."""
        return _lift(self, x)


@in_full_precision
@jax.jit
def _lift(lift: Lift, x: Array) -> Array:
    if lift.vectors is not None:
        x = x @ lift.vectors.T
    free = x.reshape(*x.shape[:-1], -1, lift.dimension)
    if not lift.is_clamped:
        return free
    assert lift.node_numbers is not None
    padding = jnp.zeros((*free.shape[:-2], 1, lift.dimension), x.dtype)
    free = jnp.concatenate([free, padding], axis=-2)
    return jnp.take(free, lift.node_numbers, axis=-2, mode="clip")
