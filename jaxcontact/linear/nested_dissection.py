"""Nested dissection with dense fronts: factorise once on the device, solve by a few batched products.

A front with own unknowns 1 and boundary unknowns 2 (eliminated later) keeps two dense blocks,

    S11^-1   and   V = S21 S11^-1,

and passes S22 - V S21^T to its parent. A solve goes up the tree with z = S11^-1 r_1 and the update
r_2 - V r_1, and down with y_1 = z - V^T y_2. The contact unknowns lie in the root front, so that

    N D^-1 r = N_root S_root^-1 r_root     and     D^-1 (r - N^T p): y_root = z - S_root^-1 N_root^T p:

the contact problem is solved between the sweep up and the sweep down. Every index map comes from the
symbolic phase (`dissection_plan`); a solve gathers and never scatters.

Source: A. George (1973); J. Liu, The multifrontal method, SIAM Review 34 (1992).
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.linear.dissection_plan import DissectionPlan, build_plan
from jaxcontact.sparse import ContactNormals, SymmetricMatrix, take


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
    """Places in the update of the earlier stage that add up in a position, (K, F, s + b) int32."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DissectionFactor:
    """The factor of an SPD matrix D, (n, n), with the contact rows N, (C, n), at its root."""

    stages: tuple[tuple[FrontBatch, ...], ...]
    """Batches of fronts, leaves first; the last stage is the root, one front of s unknowns."""

    places: Array
    """Place of each unknown in the solution of all stages, root first, (n,) int32."""

    contact_weights: Array
    """Entries of N, (C, k)."""

    contact_places: Array
    """Position of the unknown of each entry of N in the root front, (C, k) int32."""

    contact_response: Array
    """S_root^-1 N_root^T, (s, C)."""

    compliance: Array
    """N D^-1 N^T, (C, C)."""

    is_positive: Array
    """True if D is positive definite, () bool; otherwise every result contains NaN."""

    def solve(self, rhs: Array) -> Array:
        """Return D^-1 rhs, (n,)."""
        return _solve(self, rhs)

    def condense(self, rhs: Array) -> tuple[tuple, Array]:
        """Return what `expand` needs and N D^-1 rhs, (C,)."""
        return _condense(self, rhs)

    def expand(self, partial: tuple, multiplier: Array) -> Array:
        """Return D^-1 (rhs - N^T multiplier), (n,)."""
        return _expand(self, partial, multiplier)
