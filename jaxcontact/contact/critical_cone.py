"""The variational inequality on the critical cone of a step: the directional derivative.

    D dw + N^T dp = dr,
    (N dw - db)_i = 0 on S,    0 <= dp_i  _|_  (db - N dw)_i >= 0 on W,    dp_i = 0 elsewhere,

with strong contact S and weak contact W. Block principal pivoting: solve with equality on a set A,
S <= A <= S + W, and move every weak pair with a wrong sign to the other side; when that stops
helping, move one pair at a time, which cannot cycle on an SPD problem. Without weak contact, one
solve. Source: paper, Theorem 4.20; Judice, Pires, Computers Ops Res. 21 (1994) 587-596.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact.complementarity import RELATIVE_TOLERANCE

#: Block steps that may pass without fewer wrong signs, before pairs are moved one at a time.
PATIENCE = 5


def solve(
    solve_on_set: Callable[[Array], tuple[Array, Array, Array]],
    strong: Array,
    weak: Array,
    compliance: Array,
) -> tuple[Array, Array]:
    """Solve the VI on the critical cone.

    Args:
        solve_on_set: maps A, (C,) bool, to dw (n,), dp (C,) and db - N dw (C,) of the linear
            problem with equality on A.
        strong: S, (C,) bool.
        weak: W, (C,) bool.
        compliance: diagonal of the contact compliance, (C,); a scale for the signs.

    Returns:
        dw (n,) and dp (C,); NaN if no set was found.
    """
    n_pairs = strong.shape[0]
    relative_tolerance = RELATIVE_TOLERANCE[str(compliance.dtype)]

    def is_wrong(active, p, gap):
        size = jnp.max(jnp.where(strong | weak, jnp.abs(gap) + compliance * jnp.abs(p), 0.0))
        noise = relative_tolerance * size
        return weak & jnp.where(active, compliance * p < -noise, gap < -noise)

    def is_unfinished(carry):
        _, wrong, _, _, _, _, steps = carry
        return jnp.any(wrong) & (steps < 50 + 10 * n_pairs)

    def advance(carry):
        active, wrong, best, patience, _, _, steps = carry
        count = jnp.sum(wrong)
        is_better = count < best
        patience = jnp.where(is_better, PATIENCE, patience - 1)
        is_last = jnp.arange(n_pairs) == jnp.max(jnp.where(wrong, jnp.arange(n_pairs), 0))
        moved = active ^ jnp.where(patience > 0, wrong, is_last)
        w, p, gap = solve_on_set(moved)
        best = jnp.minimum(best, count)
        return moved, is_wrong(moved, p, gap), best, patience, w, p, steps + 1

    w, p, gap = solve_on_set(strong)
    start = (
        strong,
        is_wrong(strong, p, gap),
        jnp.array(n_pairs + 1),
        jnp.array(PATIENCE),
        w,
        p,
        jnp.int32(0),
    )
    _, wrong, _, _, w, p, _ = jax.lax.while_loop(is_unfinished, advance, start)
    poison = jnp.where(jnp.any(wrong), jnp.nan, 1.0).astype(w.dtype)
    return w * poison, p * poison
