"""Nested dissection with dense fronts: factorise once on the device, solve by batched products.

A front with own unknowns 1 and boundary unknowns 2 (eliminated later) keeps two dense blocks,

    S11^-1   and   V = S21 S11^-1,

and passes S22 - V S21^T to its parent. A solve goes up the tree with z = S11^-1 r_1 and the update
r_2 - V r_1, and down with y_1 = z - V^T y_2. At the bottom of a large tree are *leaves*, where
S21 = D21, the sparse matrix itself, takes the place of V:

    r_2 - D21 z   on the way up,   y_1 = z - S11^-1 D21^T y_2   on the way down;

reading S11^-1 twice costs less than V. The contact unknowns lie in the root front, so that

    N D^-1 r = N_0 z_0,   and   y = D^-1 (r - N^T p)   has   y_0 = z_0 - S_0^-1 N_0^T p   (0: root):

the contact problem is solved between the sweep up and the sweep down. All index maps come from the
symbolic phase (`dissection_plan`); a solve gathers and never scatters.

Source: A. George, SIAM J. Numer. Anal. 10 (1973); J. Liu, SIAM Review 34 (1992).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.linear.dissection_numeric import condense_root, factorize_fronts
from jaxcontact.linear.dissection_plan import plan_for
from jaxcontact.sparse import ContactNormals, SymmetricMatrix, take, unknown_columns
from jaxcontact.symmetric_product import materialize

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


class Partial(NamedTuple):
    """The result of the sweep up, with the trailing axes of the right-hand side."""

    leaves: Array | None
    """z = S11^-1 r_1 of all leaves, (P,), if there are any."""
    values: tuple[tuple[Array, ...], ...]
    """z of each batch between leaves and root, (F, s), the lowest stage first."""
    root: Array
    """z of the root front, (s,)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DissectionFactor:
    """The factor of an SPD matrix D, (n, n), with the contact rows N, (C, n), at its root.

    A vmap over right-hand sides becomes one product with (n, r) matrices.
    Derivative: none defined here; callers treat a solve or a contact step as an implicit function.
    """

    leaves: tuple[Array, ...]
    """S11^-1 of each batch of leaves, (F, s, s)."""

    couplings: tuple[LeafCoupling, ...]
    """The matrix entries between the leaves and the rest: to the rest, and to the leaves."""

    stages: tuple[tuple[FrontBatch, ...], ...]
    """Batches of the fronts between leaves and root, the lowest stage first."""

    root_inverse: Array
    """S11^-1 of the root front, (s, s)."""

    root_sources: Array
    """Places in the update of the last stage that add up in each root position, (K, s) int32."""

    contact_weights: Array
    """Entries of N, (C, k)."""

    contact_places: Array
    """Position in the root front of the unknown of each entry of N, (C, k) int32."""

    contact_response: Array
    """N_0 S_0^-1, (C, s)."""

    compliance: Array
    """N D^-1 N^T, (C, C)."""

    unknown_of_position: Array
    """Unknown at each own position of all fronts, root first, leaves last, (P,) int32."""

    position_of_unknown: Array
    """Its inverse, (n,) int32."""

    origin: Array
    """Zero, () int32; a number that the compiler cannot know."""

    is_positive: Array
    """True if D is positive definite, () bool; if not, all results contain NaN."""

    def solve(self, rhs: Array) -> Array:
        """Return D^-1 rhs, (n,)."""
        return _solve(self, rhs)

    def condense(self, rhs: Array) -> tuple[Partial, Array]:
        """Return what `expand` needs and N D^-1 rhs, (C,)."""
        return _condense(self, rhs)

    def expand(self, partial: Partial, multiplier: Array) -> Array:
        """Return D^-1 (rhs - N^T multiplier), (n,)."""
        return _expand(self, partial, multiplier)


@dataclass(frozen=True)
class NestedDissection:
    """Factorise by nested dissection: for meshes of some hundred to some 100 000 unknowns.

    The ordering and the index maps are found once per sparsity pattern on the host and kept.
    """

    leaf_size: int = 32
    """Largest number of unknowns in a part that is not cut further."""

    def factorize(
        self,
        matrix: SymmetricMatrix,
        normals: ContactNormals,
        coordinates: np.ndarray | None = None,
    ) -> DissectionFactor:
        """Return the factor; `is_positive` is False (and results are NaN) if D is not SPD.

        Args:
            matrix: D, SPD, (n, n), with a concrete pattern and possibly traced values.
            normals: N, (C, n), with concrete unknowns and possibly traced weights.
            coordinates: concrete positions of the unknowns, (n, d); without them the ordering
                uses distances in the graph of the matrix.

        Raises:
            ValueError: if the matrix is dense, or its pattern, `normals.unknowns` or the
                coordinates are traced.
        """
        if matrix.columns is None:
            raise ValueError("matrices of a reduced model are dense; use linear_solver=jc.Dense()")
        columns = unknown_columns(matrix.columns, matrix.values.shape[1])
        plan = plan_for(columns, normals.unknowns, coordinates, self.leaf_size)
        with_leaves = bool(plan.couplings)
        inverses, couplings, is_positive = factorize_fronts(
            matrix.values, plan.stages, with_leaves=with_leaves
        )
        (root,), (root_inverse,) = plan.stages[-1], inverses[-1]
        places = jnp.asarray(plan.contact_places)
        response, compliance = condense_root(root_inverse[0], normals.weights, places)
        between = slice(int(with_leaves), -1)
        stages = tuple(
            tuple(
                FrontBatch(inverse, coupling, jnp.asarray(maps.boundary), jnp.asarray(maps.sources))
                for inverse, coupling, maps in zip(*stage, strict=True)
            )
            for stage in zip(
                inverses[between], couplings[between], plan.stages[between], strict=True
            )
        )
        return DissectionFactor(
            leaves=inverses[0] if with_leaves else (),
            couplings=tuple(_leaf_coupling(matrix.values, x) for x in plan.couplings),
            stages=stages,
            root_inverse=root_inverse[0],
            root_sources=jnp.asarray(root.sources[:, 0]),
            contact_weights=jnp.asarray(normals.weights),
            contact_places=places,
            contact_response=response,
            compliance=compliance,
            unknown_of_position=jnp.asarray(plan.unknown_of_position),
            position_of_unknown=jnp.asarray(plan.position_of_unknown),
            origin=jnp.zeros((), jnp.int32),
            is_positive=is_positive,
        )


def _leaf_coupling(values, plan):
    values = jnp.append(values, jnp.zeros((), values.dtype))
    entries = take(values, jnp.asarray(plan.entries))
    return LeafCoupling(entries, jnp.asarray(plan.columns))


# Every sweep is written for right-hand sides (n,) and (n, r); the trailing axis stays last in all
# vectors. custom_vmap moves the batch axis there, where the products become matrix products.


def _with_trailing_axis(sweep):
    """Let vmap over the operands (not over the factor) append to the trailing axis."""
    batched = jax.custom_batching.custom_vmap(sweep)

    @batched.def_vmap
    def _(size, is_batched, factor, *operands):
        is_factor_batched = jax.tree.map(lambda flag: 0 if flag else None, is_batched[0])
        if any(jax.tree.leaves(is_batched[0])):
            axes = jax.tree.map(lambda flag: 0 if flag else None, is_batched[1:])
            result = jax.vmap(sweep, in_axes=(is_factor_batched, *axes))(factor, *operands)
            return result, jax.tree.map(lambda _: True, result)
        is_matrix = operands[-1].ndim - is_batched[-1] == 2

        def append(x, flag):
            x = jnp.moveaxis(x, 0, -1) if flag else jnp.broadcast_to(x[..., None], (*x.shape, size))
            return x.reshape(*x.shape[:-2], -1) if is_matrix else x

        def split(x):
            x = x.reshape(*x.shape[:-1], -1, size) if is_matrix else x
            return jnp.moveaxis(x, -1, 0)

        result = batched(factor, *jax.tree.map(append, operands, tuple(is_batched[1:])))
        return jax.tree.map(split, result), jax.tree.map(lambda _: True, result)

    return batched


def _sum_sources(update, sources):
    """Add up the contributions of the children, (K, ...) places -> (...)."""
    total = take(update, sources[0])
    for k in range(1, sources.shape[0]):
        total = total + take(update, sources[k])
    return total


def _multiply_leaves(factor, x):
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


def _couple(coupling, x):
    """Multiply values of the positions on one side by D21 or its transpose: those of the other."""
    entries = coupling.entries.reshape(*coupling.entries.shape, *(1 for _ in x.shape[1:]))
    product = entries[0] * take(x, coupling.columns[0])
    for k in range(1, entries.shape[0]):
        product = product + entries[k] * take(x, coupling.columns[k])
    return product


def _up(factor, rhs) -> Partial:
    """Sweep from the leaves to the root."""
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


def _down(factor, partial, root) -> Array:
    """Sweep from the root, with its solution (s,), to the leaves."""
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
    if factor.leaves:
        coupled = materialize(_couple(factor.couplings[1], solution), factor.origin)
        y = partial.leaves - _multiply_leaves(factor, coupled)
        solution = jax.lax.dynamic_update_slice_in_dim(solution, y, place, axis=0)
    return take(solution, factor.position_of_unknown)


@_with_trailing_axis
def _solve(factor, rhs):
    partial = _up(factor, rhs)
    return _down(factor, partial, partial.root)


@_with_trailing_axis
def _condense(factor, rhs):
    partial = _up(factor, rhs)
    at_contact = take(partial.root, factor.contact_places)
    return partial, jnp.einsum("ck,ck...->c...", factor.contact_weights, at_contact)


@_with_trailing_axis
def _expand(factor, partial, multiplier):
    correction = jnp.einsum("cj,c...->j...", factor.contact_response, multiplier)
    return _down(factor, partial, partial.root - correction)
