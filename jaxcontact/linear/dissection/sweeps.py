"""The sweeps of a solve by nested dissection, from the leaves to the root and back (device).

Every sweep is written for right-hand sides (n,) and (n, r); the trailing axis stays last in all
vectors. custom_vmap moves the batch axis there, where the products become matrix products. All
index maps come from the symbolic phase; a sweep gathers and never scatters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.linear.interface import Partial
from jaxcontact.system.sparse import take
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.symmetric_product import materialize

if TYPE_CHECKING:
    from jaxcontact.linear.dissection.nested_dissection import DissectionFactor

R = TypeVar("R")

MAX_SUMMED_ROWS = 64
"""Rows of a leaf that are summed one by one. XLA's CPU runtime shares such a sum between its
threads, which it does not do with a batched matrix-vector product; compilation takes longer."""


class FrontBatch(NamedTuple):
    """F fronts of one stage between leaves and root, padded to s own and b boundary unknowns."""

    inverse: Array
    """S11^-1, (F, s, s)."""
    coupling: Array
    """V = S21 S11^-1, (F, b, s)."""
    boundary: Array
    """Position of each boundary unknown, (F, b) int32."""
    sources: Array
    """Places in the update of the earlier stage that add up in each position, (K, F, s + b)."""


class LeafCoupling(NamedTuple):
    """The matrix entries D21 in rows of the rest and columns of the leaves, or the transpose."""

    entries: Array
    """Up to w entries at each of P positions, (w, P)."""
    columns: Array
    """Position of the column of each entry, counted from the first of the other side, (w, P)."""


def with_trailing_axis(sweep: Callable[..., R]) -> Callable[..., R]:
    """Let vmap over the operands (not over the factor) append to the trailing axis.

    The sweep is under jit, so that it is not traced anew at every call.
    """
    sweep = in_full_precision(sweep)  # traced again under vmap
    batched = jax.custom_batching.custom_vmap(sweep)

    @batched.def_vmap
    def _(
        size: int, is_batched: list, factor: DissectionFactor, *operands: Array | Partial
    ) -> tuple[R, R]:
        is_factor_batched = jax.tree.map(lambda flag: 0 if flag else None, is_batched[0])
        if any(jax.tree.leaves(is_batched[0])):
            # Several matrices: nothing is shared, the plain rule is right.
            axes = jax.tree.map(lambda flag: 0 if flag else None, is_batched[1:])
            result = jax.vmap(sweep, in_axes=(is_factor_batched, *axes))(factor, *operands)
            return result, jax.tree.map(lambda _: True, result)
        # The last operand is one array; with a trailing axis already, both become one.
        is_matrix = jax.tree.leaves(operands)[-1].ndim - jax.tree.leaves(is_batched)[-1] == 2

        def append(x: Array, flag: bool) -> Array:
            """Move the batch axis to the end: (n,) -> (n, size), (n, r) -> (n, r size)."""
            x = jnp.moveaxis(x, 0, -1) if flag else jnp.broadcast_to(x[..., None], (*x.shape, size))
            return x.reshape(*x.shape[:-2], -1) if is_matrix else x

        def split(x: Array) -> Array:
            """Undo `append`: the batch axis comes first."""
            x = x.reshape(*x.shape[:-1], -1, size) if is_matrix else x
            return jnp.moveaxis(x, -1, 0)

        result = batched(factor, *jax.tree.map(append, operands, tuple(is_batched[1:])))
        return jax.tree.map(split, result), jax.tree.map(lambda _: True, result)

    return jax.jit(batched)


def _sum_sources(update: Array, sources: Array) -> Array:
    """Add up the contributions of the children, (K, ...) places -> (...)."""
    total = take(update, sources[0])
    for k in range(1, sources.shape[0]):
        total = total + take(update, sources[k])
    return total


def _multiply_leaves(factor: DissectionFactor, x: Array) -> Array:
    """Multiply values of all leaf positions, (P,), by S11^-1."""
    tail, place, products = x.shape[1:], 0, []
    for inverse in factor.leaves:
        n_fronts, s, _ = inverse.shape
        own = x[place : place + n_fronts * s].reshape(n_fronts, s, *tail)
        place += n_fronts * s
        if tail or s > MAX_SUMMED_ROWS:
            product = jnp.einsum("fij,fj...->fi...", inverse, own)
        else:
            product = inverse[:, 0] * own[:, :1]
            for i in range(1, s):
                product = product + inverse[:, i] * own[:, i : i + 1]
            product = materialize(product, factor.origin)
        products.append(product.reshape(-1, *tail))
    return jnp.concatenate(products)


def _couple(coupling: LeafCoupling, x: Array) -> Array:
    """Multiply values of the positions on one side by D21 or its transpose: those of the other."""
    entries = coupling.entries.reshape(*coupling.entries.shape, *(1 for _ in x.shape[1:]))
    product = entries[0] * take(x, coupling.columns[0])
    for k in range(1, entries.shape[0]):
        product = product + entries[k] * take(x, coupling.columns[k])
    return product


def sweep_up(factor: DissectionFactor, rhs: Array) -> Partial:
    """Sweep from the leaves to the root.

    `place` is the first position of what is done: positions run from the root to the leaves. The
    right-hand side of a front is its own part and what its children have passed on.
    """
    tail = rhs.shape[1:]
    rhs = take(materialize(rhs, factor.origin), factor.unknown_of_position)
    leaves = None
    if factor.leaves:
        rhs = materialize(rhs, factor.origin)
        place = factor.couplings[0].entries.shape[1]
        leaves = _multiply_leaves(factor, rhs[place:])
        rhs = rhs[:place] - _couple(factor.couplings[0], leaves)
        rhs = materialize(rhs, factor.origin)
    place, values, update = rhs.shape[0], [], None
    for stage in factor.stages:
        place -= sum(batch.inverse.shape[0] * batch.inverse.shape[1] for batch in stage)
        end, stage_values, updates = place, [], []
        for batch in stage:
            n_fronts, s, _ = batch.inverse.shape
            start, end = end, end + n_fronts * s
            own, passed = rhs[start:end].reshape(n_fronts, s, *tail), 0.0
            if update is not None:
                own = own + _sum_sources(update, batch.sources[:, :, :s])
                passed = _sum_sources(update, batch.sources[:, :, s:])
            stage_values.append(jnp.einsum("fij,fj...->fi...", batch.inverse, own))
            change = passed - jnp.einsum("fbj,fj...->fb...", batch.coupling, own)
            updates.append(change.reshape(-1, *tail))
        values.append(tuple(stage_values))
        update = jnp.concatenate([*updates, jnp.zeros((1, *tail), rhs.dtype)])
    own = rhs[:place]
    if update is not None and factor.root_sources.shape[0]:
        own = own + _sum_sources(update, factor.root_sources)
    root = jnp.einsum("ij,j...->i...", factor.root_inverse, own)
    return Partial(leaves, tuple(values), root)


def sweep_down(factor: DissectionFactor, partial: Partial, root: Array) -> Array:
    """Sweep from the root, with its solution (s,), to the leaves.

    The solution is complete at all positions before `place`, where every boundary lies.
    """
    tail = root.shape[1:]
    n_other = factor.unknown_of_position.shape[0] - root.shape[0]
    solution = jnp.concatenate([root, jnp.zeros((n_other, *tail), root.dtype)])
    place = root.shape[0]
    for stage, stage_values in zip(factor.stages[::-1], partial.values[::-1], strict=True):
        found = []
        for batch, z in zip(stage, stage_values, strict=True):
            later = take(solution, batch.boundary)
            y = z - jnp.einsum("fbj,fb...->fj...", batch.coupling, later)
            found.append(y.reshape(-1, *tail))
        # In place: nothing reads the old solution after this.
        solution = jax.lax.dynamic_update_slice_in_dim(
            solution, jnp.concatenate(found), place, axis=0
        )
        place += sum(y.shape[0] for y in found)
    if partial.leaves is not None:
        coupled = materialize(_couple(factor.couplings[1], solution), factor.origin)
        y = partial.leaves - _multiply_leaves(factor, coupled)
        solution = jax.lax.dynamic_update_slice_in_dim(solution, y, place, axis=0)
    return take(solution, factor.position_of_unknown)
