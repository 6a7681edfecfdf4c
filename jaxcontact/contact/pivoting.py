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

from jaxcontact.contact.complementarity import rank_shift
from jaxcontact.linear.triangular import invert_triangular
from jaxcontact.transforms.precision import in_full_precision

#: A set that differs in more than C / 8 pairs is factorised anew: an exchange reads and writes the
#: matrix once, a factorisation costs about as much as C / 8 of them.
PAIRS_PER_EXCHANGE = 8

#: In a batch of scenes the transforms that are due are made by an eighth of the batch at a time.
PARTS_OF_A_BATCH = 8

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

    pivoted = _renew(pivoted, compliance, pairs, (pivoted.exchanges >= WORN) | is_far)

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
    limit = 0.1 * jnp.finfo(p.dtype).eps ** 0.5 + 2.0 * rank_shift(compliance)
    is_fine = jnp.max(jnp.abs(error)) <= limit * size
    exchanges = jnp.where(~is_fine & (pivoted.exchanges > 0), WORN, pivoted.exchanges)
    return p + on_set(error), pivoted._replace(exchanges=exchanges)


@jax.custom_batching.custom_vmap
def _renew(
    pivoted: PivotedCompliance, compliance: Array, pairs: Array, is_due: Array
) -> PivotedCompliance:
    """Make S anew if it is due."""

    def make_anew() -> PivotedCompliance:
        return PivotedCompliance(_transform(compliance, pairs), pairs, jnp.int32(0))

    return jax.lax.cond(is_due, make_anew, lambda: pivoted)


@_renew.def_vmap
@in_full_precision
def _renew_in_parts(size, is_batched, pivoted, compliance, pairs, is_due):
    """Make those of a batch anew that are due: seldom all of them in one step."""
    at_once = -(-size // PARTS_OF_A_BATCH)
    is_compliance_batched = is_batched[1]

    def for_all(x: Array, is_batched: bool) -> Array:
        return x if is_batched else jnp.broadcast_to(x, (size, *x.shape))

    pivoted, pairs, is_due = jax.tree.map(
        for_all, (pivoted, pairs, is_due), (is_batched[0], *is_batched[2:])
    )

    def is_any_due(carry: tuple[Array, Array]) -> Array:
        return jnp.any(carry[1])

    def make_some(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        matrices, is_due = carry
        (some,) = jnp.nonzero(is_due, size=at_once, fill_value=size)
        own = compliance.at[some].get(mode="clip") if is_compliance_batched else compliance
        transform = jax.vmap(_transform, in_axes=(0 if is_compliance_batched else None, 0))
        made = transform(own, pairs.at[some].get(mode="clip"))
        matrices = matrices.at[some].set(made, mode="drop")
        return matrices, is_due.at[some].set(False, mode="drop")

    matrices, _ = jax.lax.while_loop(is_any_due, make_some, (pivoted.matrix, is_due))
    renewed = PivotedCompliance(
        matrices,
        jnp.where(is_due[:, None], pairs, pivoted.pairs),
        jnp.where(is_due, 0, pivoted.exchanges),
    )
    return renewed, jax.tree.map(lambda _: True, renewed)


def _transform(compliance: Array, pairs: Array) -> Array:
    """Return S by a factorisation."""
    # Scaling by the diagonal keeps pairs of very different stiffness apart.
    scale = jax.lax.rsqrt(jnp.diagonal(compliance))
    scaled = compliance * scale[:, None] * scale[None, :]
    identity = jnp.eye(pairs.shape[0], dtype=compliance.dtype)
    inside = pairs[:, None] & pairs[None, :]
    across = jnp.where(pairs[:, None] & ~pairs[None, :], scaled, 0.0)
    shifted = jnp.where(inside, scaled, identity) + rank_shift(compliance) * identity
    L = jax.lax.linalg.cholesky(shifted, symmetrize_input=False)
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
