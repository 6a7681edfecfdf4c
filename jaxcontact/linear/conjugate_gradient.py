"""Jacobi-preconditioned conjugate gradients, for matrices whose factor does not fit in memory.

The matrix of a time step is well conditioned while c tau / h is about one, so that a few dozen
iterations suffice. Contact cannot be condensed here (that takes one solve per contact pair);
instead a fixed active set A is eliminated by the projection P = I - N_A^T N_A, which is local
because every contact pair has a node of its own:

    w = N_A^T b_A + z,   P D P z = P (r - D N_A^T b_A),   p_A = N_A (r - D w).

The preconditioner has one number per node, so that it commutes with P.
Source: Hestenes, Stiefel (1952); Gould, Hribar, Nocedal, SIAM J. Sci. Comput. 23 (2001).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix

#: Vectors (n,) that a solve keeps: preconditioner, right-hand side, lifted bound, iterate,
#: residual, direction, its image and the scaled residual.
N_VECTORS = 8


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class IterativeFactor:
    """A matrix that is solved with by iteration: nothing is factorised."""

    matrix: SymmetricMatrix
    """D, (n, n)."""

    normals: ContactNormals
    """N, (C, n), with orthogonal rows."""

    preconditioner: Array
    """One over the mean diagonal entry of each node, (n,)."""

    tolerance: float = field(metadata={"static": True})
    """Residual at which the iteration stops, relative to the right-hand side."""

    max_iterations: int = field(metadata={"static": True})
    """Iterations after which a solve gives NaN."""

    @property
    def is_positive(self) -> Array:
        """True if the diagonal is positive and a solve succeeds, () bool; costs that solve."""
        return _is_positive(self)

    @property
    def compliance(self) -> None:
        """None: the contact cannot be condensed (nothing is factorised)."""
        return None

    @property
    def approximate_compliance(self) -> Array:
        """Mean of the preconditioner on the unknowns of each pair, (C,): a scale, not a solution.

        It stands for the diagonal of N D^-1 N^T with unit normals.
        """
        return jnp.mean(self.preconditioner[self.normals.unknowns], axis=1)

    def solve(self, rhs: Array) -> Array:
        """Return D^-1 rhs, (n,)."""
        nothing = jnp.zeros(self.normals.count, bool)
        return self.solve_constrained(nothing, rhs, jnp.zeros(self.normals.count, rhs.dtype))[0]

    def solve_constrained(self, active: Array, rhs: Array, bound: Array) -> tuple[Array, Array]:
        """Solve with N w = bound on the active set.

        Args:
            active: A, (C,) bool.
            rhs: r, (n,).
            bound: b, (C,); read on A only.

        Returns:
            w (n,) and the multiplier p (C,), zero outside A; NaN if the iteration did not end.
        """
        normals, n = self.normals, rhs.shape[0]
        lengths = jnp.sum(normals.weights**2, axis=1)

        def restrict(x: Array) -> Array:
            stretch = jnp.where(active, (normals @ x) / lengths, 0.0)
            return x - normals.transposed_product(stretch, n)

        lifted = normals.transposed_product(jnp.where(active, bound / lengths, 0.0), n)
        rest = restrict(rhs - self.matrix @ lifted)
        w = lifted + self._iterate(restrict, rest, rhs)
        force = rhs - self.matrix @ w
        return w, jnp.where(active, (normals @ force) / lengths, 0.0)

    def _iterate(self, restrict, rest: Array, rhs: Array) -> Array:
        """Run projected conjugate gradients from zero for the residual `rest`, (n,)."""
        goal = self.tolerance**2 * jnp.sum(self.preconditioner * rhs**2)

        def is_unfinished(carry):
            _, _, _, rho, steps = carry
            return (rho > goal) & (steps < self.max_iterations)

        def advance(carry):
            z, residual, direction, rho, steps = carry
            image = restrict(self.matrix @ direction)
            step = rho / jnp.vdot(direction, image)
            z = z + step * direction
            residual = residual - step * image
            scaled = self.preconditioner * residual
            rho_next = jnp.vdot(residual, scaled)
            return z, residual, scaled + (rho_next / rho) * direction, rho_next, steps + 1

        scaled = self.preconditioner * rest
        rho = jnp.vdot(rest, scaled)
        start = (jnp.zeros_like(rest), rest, scaled, rho, jnp.int32(0))
        z, _, _, rho, _ = jax.lax.while_loop(is_unfinished, advance, start)
        return z * jnp.where(rho <= goal, 1.0, jnp.nan)


@jax.jit
def _is_positive(factor: IterativeFactor) -> Array:
    """Solve with ones; compiled as one program, not operation by operation."""
    weights = factor.preconditioner
    return jnp.all(weights > 0.0) & jnp.all(jnp.isfinite(factor.solve(jnp.ones_like(weights))))


@dataclass(frozen=True)
class ConjugateGradient:
    """Solve every step by preconditioned conjugate gradients; no factor is stored.

    Works with `SemismoothNewton` and with contact sets in which no node occurs twice.
    """

    tolerance: float = 1e-12
    """Residual at which the iteration stops, relative to the right-hand side; float32 stops at
    a few rounding errors if that is larger."""

    max_iterations: int = 2000
    """Iterations after which a solve counts as failed; about 20 to 100 are usual."""

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ValueError: if the tolerance is not in (0, 1e-2] or no iteration is allowed.
        """
        if not 0.0 < self.tolerance <= 1e-2:
            raise ValueError(
                f"tolerance must be in (0, 1e-2], got {self.tolerance!r}; gradients need 1e-10 or "
                "less, 1e-12 is the default"
            )
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise ValueError(
                f"max_iterations must be a positive integer, got {self.max_iterations!r}; 2000 is "
                "the default"
            )

    def factorize(
        self,
        matrix: SymmetricMatrix,
        normals: ContactNormals,
        coordinates: np.ndarray | None = None,
    ) -> IterativeFactor:
        """Return the matrix with its preconditioner.

        Args:
            matrix: D, SPD, (n, n).
            normals: N, (C, n).
            coordinates: not used.

        Raises:
            ValueError: if a node belongs to two contact pairs.
        """
        unknowns = np.asarray(normals.unknowns)
        if np.unique(unknowns).size != unknowns.size:
            raise ValueError(
                "ConjugateGradient needs contact sets without common nodes; use "
                "linear_solver=jc.NestedDissection()"
            )
        floor = 8.0 * float(jnp.finfo(matrix.values.dtype).eps)
        diagonal = matrix.diagonal()
        # The components of a contact node share one number, so that the projection commutes.
        mean = jnp.mean(diagonal[unknowns], axis=1, keepdims=True)
        diagonal = diagonal.at[unknowns].set(jnp.broadcast_to(mean, unknowns.shape))
        tolerance = max(self.tolerance, floor)
        return IterativeFactor(matrix, normals, 1.0 / diagonal, tolerance, self.max_iterations)

    def bytes_needed(self, size: int, dimension: int, itemsize: int) -> float:
        """Return the memory of the vectors (n,) that an iteration keeps, [bytes]."""
        del dimension
        return float(N_VECTORS * itemsize * size)
