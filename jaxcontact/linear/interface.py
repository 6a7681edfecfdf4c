"""What a linear solver must offer to the contact step.

For an SPD matrix D (n, n) and the contact operator N (C, n), a step asks for w and a multiplier p
with D w + N^T p = r. A factor offers one of two ways to it (see `can_condense`):

- condensed (`CondensingFactor`): `condense` reduces r to the free contact velocity N D^-1 r, the
  contact solver finds p from it and the compliance N D^-1 N^T, and `expand` returns w. Together
  the two cost one solve, so that the n x C matrix D^-1 N^T need not exist.
- on a fixed active set (`ConstrainedFactor`): one solve with the constraint; `compliance` is None.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jax import Array

from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix

if TYPE_CHECKING:
    from typing_extensions import TypeIs


class Partial(NamedTuple):
    """What a solve has found before the contact problem is solved: z of every front.

    A factor of one front, such as the dense inverse, fills the root alone. Trailing axes are those
    of the right-hand side.
    """

    leaves: Array | None
    """z = S11^-1 r_1 of all leaves, (P,), if there are any."""

    values: tuple[tuple[Array, ...], ...]
    """z of each batch between leaves and root, (F, s), the lowest stage first."""

    root: Array
    """z of the root front, (s,)."""


class CondensingFactor(Protocol):
    """A factorised SPD matrix, a pytree; none of it is differentiated through."""

    @property
    def is_positive(self) -> Array:
        """True if D is positive definite, () bool; if not, all results contain NaN."""
        ...

    @property
    def compliance(self) -> Array:
        """N D^-1 N^T, (C, C)."""
        ...

    def solve(self, rhs: Array) -> Array:
        """Return D^-1 rhs, (n,)."""
        ...

    def condense(self, rhs: Array) -> tuple[Partial, Array]:
        """Return what `expand` needs and N D^-1 rhs, (C,)."""
        ...

    def expand(self, partial: Partial, multiplier: Array) -> Array:
        """Return D^-1 (rhs - N^T multiplier), (n,)."""
        ...


class ConstrainedFactor(Protocol):
    """An SPD matrix that is solved with by iteration, a pytree; nothing is factorised."""

    @property
    def is_positive(self) -> Array:
        """True if D is positive definite, () bool; if not, all results contain NaN."""
        ...

    @property
    def compliance(self) -> None:
        """None: the contact cannot be condensed (nothing is factorised)."""
        ...

    @property
    def approximate_compliance(self) -> Array:
        """About the diagonal of N D^-1 N^T, (C,): a scale, not a solution."""
        ...

    @property
    def normals(self) -> ContactNormals:
        """N, (C, n)."""
        ...

    def solve(self, rhs: Array) -> Array:
        """Return D^-1 rhs, (n,)."""
        ...

    def solve_constrained(self, active: Array, rhs: Array, bound: Array) -> tuple[Array, Array]:
        """Solve D w + N^T p = rhs with N w = bound on the active set, p = 0 elsewhere.

        Args:
            active: A, (C,) bool.
            rhs: r, (n,).
            bound: b, (C,); read on A only.

        Returns:
            w (n,) and p (C,).
        """
        ...


#: What a linear solver returns; `can_condense` tells which of the two it is.
Factor: TypeAlias = CondensingFactor | ConstrainedFactor


def can_condense(factor: Factor) -> TypeIs[CondensingFactor]:
    """Return whether a factor has a compliance; else it solves on fixed active sets alone."""
    return factor.compliance is not None


@runtime_checkable
class LinearSolver(Protocol):
    """An option object: static, hashable, without arrays."""

    def factorize(
        self,
        matrix: SymmetricMatrix,
        normals: ContactNormals,
        coordinates: np.ndarray | None = None,
    ) -> Factor:
        """Factorise a matrix with concrete pattern and possibly traced values.

        Args:
            matrix: D, SPD, (n, n).
            normals: N, (C, n).
            coordinates: positions of the unknowns, (n, d), a hint for the ordering.

        Returns:
            The factor; what is wrong with its values is told by `is_positive`.
        """
        ...

    def bytes_needed(self, size: int, dimension: int, itemsize: int) -> float:
        """Return the memory that factor and factorisation need, an estimate [bytes].

        Args:
            size: number of unknowns, n.
            dimension: space dimension.
            itemsize: bytes per number.
        """
        ...
