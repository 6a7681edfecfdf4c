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
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact.complementarity import RELATIVE_TOLERANCE, last_of

#: Block steps that may pass without fewer wrong signs, before pairs are moved one at a time.
PATIENCE = 5


class _Search(NamedTuple):
    """The pivoting over sets of closed pairs."""

    active: Array
    """The set, (C,) bool."""

    wrong: Array
    """Weak pairs with a wrong sign on it, (C,) bool."""

    fewest: Array
    """Fewest wrong signs so far, int32."""

    patience: Array
    """Block steps that may still pass without fewer, int32."""

    w: Array
    """dw on the set, (n,)."""

    p: Array
    """dp on the set, (C,)."""

    steps: Array
    """Sets so far, int32."""


def solve(
    solve_with: Callable[[Array], tuple[Array, Array, Array]],
    strong: Array,
    weak: Array,
    compliance: Array,
) -> tuple[Array, Array]:
    """Solve the VI on the critical cone.

    Args:
        solve_with: maps A, (C,) bool, to dw (n,), dp (C,) and db - N dw (C,) of the linear
            problem with equality on A.
        strong: S, (C,) bool.
        weak: W, (C,) bool.
        compliance: diagonal of the contact compliance, (C,); a scale for the signs.

    Returns:
        dw (n,) and dp (C,); NaN if no set was found.
    """
    n_pairs = strong.shape[0]
    relative_tolerance = RELATIVE_TOLERANCE[str(compliance.dtype)]

    def try_set(active: Array) -> tuple[Array, Array, Array]:
        w, p, gap = solve_with(active)
        size = jnp.max(jnp.where(strong | weak, jnp.abs(gap) + compliance * jnp.abs(p), 0.0))
        noise = relative_tolerance * size
        return weak & jnp.where(active, compliance * p < -noise, gap < -noise), w, p

    def is_unfinished(search: _Search) -> Array:
        return jnp.any(search.wrong) & (search.steps < 50 + 10 * n_pairs)

    def advance(search: _Search) -> _Search:
        count = jnp.sum(search.wrong)
        patience = jnp.where(count < search.fewest, PATIENCE, search.patience - 1)
        moved = search.active ^ jnp.where(patience > 0, search.wrong, last_of(search.wrong))
        wrong, w, p = try_set(moved)
        fewest = jnp.minimum(search.fewest, count)
        return _Search(moved, wrong, fewest, patience, w, p, search.steps + 1)

    wrong, w, p = try_set(strong)
    start = _Search(strong, wrong, jnp.array(n_pairs + 1), jnp.array(PATIENCE), w, p, jnp.int32(0))
    found = jax.lax.while_loop(is_unfinished, advance, start)
    poison = jnp.where(jnp.any(found.wrong), jnp.nan, 1.0).astype(w.dtype)
    return found.w * poison, found.p * poison
