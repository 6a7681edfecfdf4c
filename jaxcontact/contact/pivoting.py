"""The contact compliance solved for a set of closed pairs, kept while the set does not change.

For the set A, with B the open pairs, the principal pivot transform of the compliance W is

    S = [ -W_AA^-1         W_AA^-1 W_AB               ]
        [ W_BA W_AA^-1     W_BB - W_BA W_AA^-1 W_AB   ],

so that W p + q = 0 on A with p = 0 on B gives p_A = S_AA q_A. A pair k enters or leaves the set by
one exchange in O(C^2),

    S <- S - s s^T / S_kk,   S_k <- +-s / S_kk,   S_kk <- -1 / S_kk   (s: row k; + to enter),

instead of a new factorisation in O(C^3). Exchanges gather rounding errors, so a solution is refined
with W itself, and S is made anew when a refinement finds it worn or when many pairs change.

Source: Tucker, A combinatorial equivalence of matrices (1960); Goodnight, A tutorial on the SWEEP
operator, The American Statistician 33 (1979).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.linear.triangular import invert_triangular

#: A set that differs in more than C / 8 pairs is factorised anew: an exchange reads and writes the
#: matrix once, a factorisation costs about as much as C / 8 of them.
PAIRS_PER_EXCHANGE = 8

#: Number of exchanges that marks a transform as worn: the next one is made anew.
WORN = 2**30


class PivotedCompliance(NamedTuple):
    """The compliance solved for the pairs of a set."""

    matrix: Array
    """S, (C, C)."""

    pairs: Array
    """A, (C,) bool."""

    exchanges: Array
    """Exchanges since S was made, int32; from `WORN` on, S has to be made anew."""


def unpivoted(compliance: Array) -> PivotedCompliance:
    """Return the compliance W itself, solved for no pair."""
    return PivotedCompliance(compliance, jnp.zeros(compliance.shape[0], bool), jnp.int32(0))


def pivot(pivoted: PivotedCompliance, compliance: Array, pairs: Array) -> PivotedCompliance:
    """Solve the compliance W, (C, C), for another set of pairs, (C,) bool."""
    n_changes = jnp.sum(pivoted.pairs != pairs)
    is_far = PAIRS_PER_EXCHANGE * (n_changes - 1) > pairs.shape[0]

    # A loop of at most one turn: vmap evaluates both branches of a cond, but it can skip a loop.
    def make_anew(carry: tuple[PivotedCompliance, Array]) -> tuple[PivotedCompliance, Array]:
        fresh = PivotedCompliance(_transform(compliance, pairs), pairs, jnp.int32(0))
        return fresh, jnp.bool_(False)

    start = (pivoted, (pivoted.exchanges >= WORN) | is_far)
    pivoted, _ = jax.lax.while_loop(lambda carry: carry[1], make_anew, start)

    def differs(pivoted: PivotedCompliance) -> Array:
        return jnp.any(pivoted.pairs != pairs)

    def exchange_next(pivoted: PivotedCompliance) -> PivotedCompliance:
        return _exchange(pivoted, jnp.argmax(pivoted.pairs != pairs))

    return jax.lax.while_loop(differs, exchange_next, pivoted)


def solve(
    pivoted: PivotedCompliance, compliance: Array, offset: Array
) -> tuple[Array, PivotedCompliance]:
    """Solve W p + q = 0 on the pairs of the set, p = 0 elsewhere.

    Args:
        pivoted: S and its set.
        compliance: W, (C, C).
        offset: q, (C,).

    Returns:
        p, (C,), refined once, and S, marked if the refinement found it worn.
    """
    pairs = pivoted.pairs

    def on_set(x: Array) -> Array:
        return jnp.where(pairs, pivoted.matrix @ jnp.where(pairs, x, 0.0), 0.0)

    p = on_set(offset)
    error = jnp.where(pairs, compliance @ p + offset, 0.0)
    size = jnp.max(jnp.diagonal(compliance) * jnp.abs(p))
    # Not fine is also what is not a number.
    is_fine = jnp.max(jnp.abs(error)) <= 0.1 * jnp.finfo(p.dtype).eps ** 0.5 * size
    exchanges = jnp.where(~is_fine & (pivoted.exchanges > 0), WORN, pivoted.exchanges)
    return p + on_set(error), pivoted._replace(exchanges=exchanges)


def _transform(compliance: Array, pairs: Array) -> Array:
    """Return S by a factorisation."""
    # Scaling by the diagonal keeps pairs of very different stiffness apart.
    scale = jax.lax.rsqrt(jnp.diagonal(compliance))
    scaled = compliance * scale[:, None] * scale[None, :]
    identity = jnp.eye(pairs.shape[0], dtype=compliance.dtype)
    inside = pairs[:, None] & pairs[None, :]
    across = jnp.where(pairs[:, None] & ~pairs[None, :], scaled, 0.0)
    L = jax.lax.linalg.cholesky(jnp.where(inside, scaled, identity), symmetrize_input=False)
    L_inverse = invert_triangular(L[None])[0]
    inverse = jnp.where(inside, L_inverse.T @ L_inverse, 0.0)
    elimination = inverse @ across
    outside = ~pairs[:, None] & ~pairs[None, :]
    rest = jnp.where(outside, scaled, 0.0) - across.T @ elimination
    back = jnp.where(pairs, scale, 1.0 / scale)
    return (rest + elimination + elimination.T - inverse) * back[:, None] * back[None, :]


def _exchange(pivoted: PivotedCompliance, k: Array) -> PivotedCompliance:
    """Let the pair k enter or leave the set."""
    S, pairs, exchanges = pivoted
    row = S[k]
    scaled = row / row[k]
    is_k = jnp.arange(row.shape[0]) == k
    sign = jnp.where(pairs[k], -1.0, 1.0).astype(row.dtype)
    changed = S - row[:, None] * scaled[None, :]
    changed = jnp.where(is_k[:, None], sign * scaled[None, :], changed)
    changed = jnp.where(is_k[None, :], sign * scaled[:, None], changed)
    changed = jnp.where(is_k[:, None] & is_k[None, :], -1.0 / row[k], changed)
    return PivotedCompliance(changed, pairs ^ is_k, exchanges + 1)
