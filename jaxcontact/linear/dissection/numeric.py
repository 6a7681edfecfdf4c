"""Numeric phase of the nested dissection: front matrices, their inverses and Schur complements.

With the Cholesky factor L of S11 and W = S21 L^-T, a batch of fronts gives

    S11^-1 = L^-T L^-1,    V = S21 S11^-1 = W L^-1,    S22 - V S21^T = S22 - W W^T,

all stages from the leaves to the root, all fronts of a batch at once. Padded own unknowns have a
unit diagonal and no coupling. A matrix that is not positive definite makes L, and with it every
later front, NaN.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.linear.dissection.batches import BatchPlan
from jaxcontact.linear.triangular import invert_triangular
from jaxcontact.system.sparse import take


@partial(jax.jit, static_argnames="with_leaves")
def factorize_fronts(
    values: Array, stages: tuple[tuple[BatchPlan, ...], ...], *, with_leaves: bool
) -> tuple[tuple[tuple[Array, ...], ...], tuple[tuple[Array, ...], ...], Array]:
    """Factorise all fronts.

    Args:
        values: entries of the matrix, (width, n).
        stages: batches of fronts, from the bottom; the root last.
        with_leaves: whether the first stage are leaves, which need no V.

    Returns:
        S11^-1, (F, s, s), of every batch, by stages; V, (F, b, s), of every batch, by stages, but
        nothing for the leaves; True if all pivots are positive, () bool.
    """
    inverses, couplings = [], []
    schur, is_positive = jnp.zeros(1, values.dtype), jnp.array(True)
    for stage in stages:
        stage_inverses, stage_couplings, complements = [], [], []
        for batch in stage:
            own_columns, rest = _assemble(batch, values, schur)
            inverse, coupling, complement, pivots = _eliminate(own_columns, rest)
            # NaN spreads to all other fronts. The dependence also keeps the batches in sequence:
            # XLA's CPU runtime may deadlock when several batched LAPACK calls run at once.
            values = values + 0 * jnp.min(pivots, initial=1.0)
            is_positive &= jnp.all(pivots > 0)
            stage_inverses.append(inverse)
            stage_couplings.append(coupling)
            complements.append(complement.reshape(-1))
        schur = jnp.concatenate([*complements, jnp.zeros(1, values.dtype)])
        inverses.append(tuple(stage_inverses))
        couplings.append(tuple(stage_couplings))
    if with_leaves:
        couplings[0] = ()
    return tuple(inverses), tuple(couplings), is_positive


@jax.jit
def condense_root(inverse: Array, weights: Array, places: Array) -> tuple[Array, Array]:
    """Apply the contact rows to the root: N_0 S_0^-1, (C, s), and N_0 S_0^-1 N_0^T, (C, C).

    Args:
        inverse: S_0^-1, (s, s).
        weights: entries of N, (C, k).
        places: position of each entry in the root front, (C, k).
    """
    response = jnp.einsum("ck,ckj->cj", weights, take(inverse, places))
    at_contact = take(response.T, places)  # (s,C),(C,k) -> (C,k,C)
    compliance = jnp.einsum("ck,ckj->cj", weights, at_contact)
    return response, 0.5 * (compliance + compliance.T)


def _assemble(batch: BatchPlan, values: Array, schur: Array) -> tuple[Array, Array]:
    """Front matrices: own columns S11 over S21, (F, s + b, s), and S22, (F, b, b).

    Args:
        batch: index maps.
        values: entries of the matrix, (width, n).
        schur: Schur complements of the earlier stage one after the other, with a zero behind them.
    """
    n_fronts, s = batch.own.shape
    b = batch.boundary.shape[1]
    own = jnp.zeros(n_fronts * (s + b) * s, values.dtype)
    own = own.at[batch.entries[1]].add(take(values.reshape(-1), batch.entries[0]))
    own = own.reshape(n_fronts, s + b, s)
    own = own + jnp.eye(s + b, s, dtype=own.dtype)[None] * batch.is_padding[:, None, :]
    rest = jnp.zeros((n_fronts, b, b), values.dtype)
    for child in range(batch.child_base.shape[0]):
        base = batch.child_base[child][:, None, None]
        stride = batch.child_stride[child][:, None, None]
        position = batch.child_position[child]

        def gather(
            rows: Array, columns: Array, base: Array = base, stride: Array = stride
        ) -> Array:
            """Entries (rows, columns) of the child's Schur complement, zero where it has none."""
            rows, columns = rows[:, :, None], columns[:, None, :]
            place = base + rows * stride + columns
            is_missing = (rows < 0) | (columns < 0)
            return take(schur, jnp.where(is_missing, schur.shape[0] - 1, place))

        own = own + gather(position, position[:, :s])
        rest = rest + gather(position[:, s:], position[:, s:])
    return own, rest


def _eliminate(own_columns: Array, rest: Array) -> tuple[Array, Array, Array, Array]:
    """S11^-1, V, the Schur complement and the pivots (diagonal of L) of a batch."""
    s = own_columns.shape[2]
    L = jax.lax.linalg.cholesky(own_columns[:, :s], symmetrize_input=False)
    L_inverse = invert_triangular(L)
    W = jnp.einsum("fbj,fij->fbi", own_columns[:, s:], L_inverse)
    inverse = jnp.einsum("fij,fik->fjk", L_inverse, L_inverse)
    coupling = jnp.einsum("fbi,fij->fbj", W, L_inverse)
    complement = rest - jnp.einsum("fbi,fci->fbc", W, W)
    return inverse, coupling, complement, jnp.diagonal(L, axis1=1, axis2=2)
