"""Nested dissection with dense fronts: factorise once on the device, solve by batched products.

A front with own unknowns 1 and boundary unknowns 2 (eliminated later) keeps two dense blocks,

    S11^-1   and   V = S21 S11^-1,

and passes S22 - V S21^T to its parent. A solve goes up the tree with z = S11^-1 r_1 and the update
r_2 - V r_1, and down with y_1 = z - V^T y_2. The contact unknowns lie in the root front, so that

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


class FrontBatch(NamedTuple):
    """F fronts of one stage, padded to s own and b boundary unknowns."""

    inverse: Array
    """S11^-1, (F, s, s)."""
    coupling: Array
    """V = S21 S11^-1, (F, b, s)."""
    own: Array
    """Unknown of each own position, (F, s) int32."""
    boundary: Array
    """Place of each boundary value in the solution of the later stages, (F, b) int32."""
    sources: Array
    """Places in the update of the earlier stage that add up in each position, (K, F, s + b)."""


class Partial(NamedTuple):
    """The result of the sweep up, with the trailing axes of the right-hand side."""

    values: tuple[tuple[Array, ...], ...]
    """z = S11^-1 r_1 of each batch but the root, (F, s), leaves first."""
    root: Array
    """z of the root front, (s,)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DissectionFactor:
    """The factor of an SPD matrix D, (n, n), with the contact rows N, (C, n), at its root.

    A vmap over right-hand sides becomes one product with (n, r) matrices.
    Derivative: none defined here; callers treat a solve or a contact step as an implicit function.
    """

    stages: tuple[tuple[FrontBatch, ...], ...]
    """Batches of all fronts but the root, leaves first."""

    root_inverse: Array
    """S11^-1 of the root front, (s, s)."""

    root_own: Array
    """Unknown of each position of the root front, (s,) int32."""

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

    places: Array
    """Place of each unknown in the solution of all stages, root first, (n,) int32."""

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
        blocks, inverse, is_positive = factorize_fronts(matrix.values, plan.stages)
        places = jnp.asarray(plan.contact_places)
        response, compliance = condense_root(inverse, normals.weights, places)
        stages = tuple(
            tuple(
                FrontBatch(
                    inverse=batch_blocks[0],
                    coupling=batch_blocks[1],
                    own=jnp.asarray(batch.own),
                    boundary=jnp.asarray(batch.boundary),
                    sources=jnp.asarray(batch.sources),
                )
                for batch, batch_blocks in zip(batches, stage_blocks, strict=True)
            )
            for batches, stage_blocks in zip(plan.stages[:-1], blocks, strict=True)
        )
        (top,) = plan.stages[-1]
        return DissectionFactor(
            stages=stages,
            root_inverse=inverse,
            root_own=jnp.asarray(top.own[0]),
            root_sources=jnp.asarray(top.sources[:, 0]),
            contact_weights=jnp.asarray(normals.weights),
            contact_places=places,
            contact_response=response,
            compliance=compliance,
            places=jnp.asarray(plan.places),
            origin=jnp.zeros((), jnp.int32),
            is_positive=is_positive,
        )


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


def _up(factor, rhs) -> Partial:
    """Sweep from the leaves to the root."""
    rhs = materialize(rhs, factor.origin)
    values, update = [], None
    for stage in factor.stages:
        stage_values, updates = [], []
        for batch in stage:
            s = batch.own.shape[1]
            own, passed = take(rhs, batch.own), 0.0
            if update is not None:
                own = own + _sum_sources(update, batch.sources[:, :, :s])
                passed = _sum_sources(update, batch.sources[:, :, s:])
            stage_values.append(jnp.einsum("fij,fj...->fi...", batch.inverse, own))
            change = passed - jnp.einsum("fbj,fj...->fb...", batch.coupling, own)
            updates.append(change.reshape(-1, *rhs.shape[1:]))
        values.append(tuple(stage_values))
        update = jnp.concatenate([*updates, jnp.zeros((1, *rhs.shape[1:]), rhs.dtype)])
    own = take(rhs, factor.root_own)
    if update is not None and factor.root_sources.shape[0]:
        own = own + _sum_sources(update, factor.root_sources)
    return Partial(tuple(values), jnp.einsum("ij,j...->i...", factor.root_inverse, own))


def _down(factor, values, root) -> Array:
    """Sweep from the root, with its solution (s,), to the leaves."""
    tail = root.shape[1:]
    n_values = sum(z.shape[0] * z.shape[1] for z in jax.tree.leaves(values))
    solution = jnp.concatenate([root, jnp.zeros((n_values, *tail), root.dtype)])
    place = root.shape[0]
    for stage, stage_values in zip(factor.stages[::-1], values[::-1], strict=True):
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
    return take(solution, factor.places)


@_with_trailing_axis
def _solve(factor, rhs):
    values, root = _up(factor, rhs)
    return _down(factor, values, root)


@_with_trailing_axis
def _condense(factor, rhs):
    partial = _up(factor, rhs)
    at_contact = take(partial.root, factor.contact_places)
    return partial, jnp.einsum("ck,ck...->c...", factor.contact_weights, at_contact)


@_with_trailing_axis
def _expand(factor, partial, multiplier):
    correction = jnp.einsum("cj,c...->j...", factor.contact_response, multiplier)
    return _down(factor, partial.values, partial.root - correction)
