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
symbolic phase (`plan.py`); a solve gathers and never scatters.

Source: A. George, SIAM J. Numer. Anal. 10 (1973); J. Liu, SIAM Review 34 (1992).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.linear.dissection.leaves import CouplingPlan
from jaxcontact.linear.dissection.numeric import condense_root, factorize_fronts
from jaxcontact.linear.dissection.plan import plan_for
from jaxcontact.linear.dissection.sweeps import (
    FrontBatch,
    LeafCoupling,
    sweep_down,
    sweep_up,
    with_trailing_axis,
)
from jaxcontact.linear.interface import Partial
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix, take, unknown_columns


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
    """Largest number of unknowns in a part that is not cut further, at least 1."""

    def __post_init__(self) -> None:
        """Check the option.

        Raises:
            ValueError: if the leaf size is not a positive integer.
        """
        if not isinstance(self.leaf_size, int) or self.leaf_size < 1:
            raise ValueError(
                f"leaf_size must be a positive integer, got {self.leaf_size!r}; 32 is the default"
            )

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
        if matrix.columns is None or normals.unknowns is None:
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

    def bytes_needed(self, size: int, dimension: int, itemsize: int) -> float:
        """Return the estimated memory of the factor, [bytes].

        The factor of a mesh of dimension d has about 9 n log2(n) entries for d <= 2 and 29 n^(4/3)
        for d = 3 (George 1973; the constants are measured).
        """
        if dimension == 3:
            return itemsize * 29.0 * size ** (4.0 / 3.0)
        return itemsize * 9.0 * size * math.log2(max(size, 2))


def _leaf_coupling(values: Array, plan: CouplingPlan) -> LeafCoupling:
    """Take the entries of a coupling from the matrix values, (width, n)."""
    values = jnp.append(values, jnp.zeros((), values.dtype))
    entries = take(values, jnp.asarray(plan.entries))
    return LeafCoupling(entries, jnp.asarray(plan.columns))


@with_trailing_axis
def _solve(factor: DissectionFactor, rhs: Array) -> Array:
    partial = sweep_up(factor, rhs)
    return sweep_down(factor, partial, partial.root)


@with_trailing_axis
def _condense(factor: DissectionFactor, rhs: Array) -> tuple[Partial, Array]:
    partial = sweep_up(factor, rhs)
    at_contact = take(partial.root, factor.contact_places)
    return partial, jnp.einsum("ck,ck...->c...", factor.contact_weights, at_contact)


@with_trailing_axis
def _expand(factor: DissectionFactor, partial: Partial, multiplier: Array) -> Array:
    correction = jnp.einsum("cj,c...->j...", factor.contact_response, multiplier)
    return sweep_down(factor, partial, partial.root - correction)
