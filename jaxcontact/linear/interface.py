"""What a linear solver must offer to the contact step.

For an SPD matrix D (n, n) and the contact operator N (C, n), a step asks for w and a multiplier p
with D w + N^T p = r. `condense` reduces r to the free contact velocity N D^-1 r, the contact
solver finds p from it and the compliance N D^-1 N^T, and `expand` returns w. Together the two
cost one solve, so that the n x C matrix D^-1 N^T need not exist.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from jax import Array

from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix


class Factor(Protocol):
    """A factorised SPD matrix, a pytree; none of it is differentiated through."""

    @property
    def compliance(self) -> Array:
        """N D^-1 N^T, (C, C)."""
        ...

    def solve(self, rhs: Array) -> Array:
        """Return D^-1 rhs, (n,)."""
        ...

    def condense(self, rhs: Array) -> tuple[Any, Array]:
        """Return what `expand` needs and N D^-1 rhs, (C,)."""
        ...

    def expand(self, partial: Any, multiplier: Array) -> Array:
        """Return D^-1 (rhs - N^T multiplier), (n,)."""
        ...


class LinearSolver(Protocol):
    """An option object: static, hashable, without arrays."""

    def factorize(
        self,
        matrix: SymmetricMatrix,
        normals: ContactNormals,
        coordinates: np.ndarray | None = None,
    ) -> Any:
        """Factorise a matrix with concrete pattern and possibly traced values.

        Args:
            matrix: D, SPD, (n, n).
            normals: N, (C, n).
            coordinates: positions of the unknowns, (n, d), a hint for the ordering.

        Returns:
            A `Factor`, or an `IterativeFactor` that offers the same without a condensed compliance.
        """
        ...
