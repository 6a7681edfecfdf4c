"""Inverses of triangular matrices by products.

XLA calls LAPACK for a triangular solve on CPUs: slow for many small matrices, and inside a compiled
program its threads and those of XLA wait for each other (2.8 ms for a 32 x 32 matrix were seen).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

_MAX_DOUBLING = 256
"""Largest triangular matrix that is inverted by doubling; its work is log2(s) / 2 times larger."""


def invert_triangular(L: Array) -> Array:
    """Invert lower triangular matrices, (F, s, s).

    Diagonal blocks of doubling size are inverted together, by products only: the inverse of
    [[A, 0], [B, C]] is that of diag(A, C) minus its product with B on both sides. Large ones are
    few and left to a triangular solve.
    """
    s = L.shape[-1]
    if s > _MAX_DOUBLING:
        identity = jnp.broadcast_to(jnp.eye(s, dtype=L.dtype), L.shape)
        return jax.lax.linalg.triangular_solve(L, identity, left_side=True, lower=True)
    diagonal = jnp.diagonal(L, axis1=1, axis2=2)
    identity = jnp.eye(s, dtype=L.dtype)[None]

    def double(k: Array, inverse: Array) -> Array:
        """Go from the inverses of the blocks of size 2^k to those of size 2^(k + 1)."""
        block = jnp.arange(s) >> k
        is_pair = (block[:, None] == block[None, :] + 1) & (block[None, :] % 2 == 0)
        B = jnp.where(is_pair[None], L, 0)
        return inverse - jnp.einsum("fij,fjk->fik", inverse, jnp.einsum("fij,fjk->fik", B, inverse))

    return jax.lax.fori_loop(0, (s - 1).bit_length(), double, identity / diagonal[:, None, :])
