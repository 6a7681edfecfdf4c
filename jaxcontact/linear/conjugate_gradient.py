"""Jacobi-preconditioned conjugate gradients, for matrices whose factor does not fit in memory.

The matrix of a time step is well conditioned while c tau / h is about one, so that a few dozen
iterations suffice. Contact cannot be condensed here (that takes one solve per contact pair);
instead a fixed active set A is eliminated by the projection P = I - N_A^T G^-1 N_A M^-1 with
G = N_A M^-1 N_A^T and the diagonal M of D, of forces, and its transpose of velocities:

    w = M^-1 N_A^T G^-1 b_A + z,   P D z = P (r - D w + D z),   p_A = G^-1 N_A M^-1 (r - D w).

Velocities have the norm |w| = sqrt(w^T M w), residuals |r| = sqrt(r^T M^-1 r), in which P is
orthogonal. With m, the smallest eigenvalue of M^-1 D, which P does not lower, the error
|w - exact w| is at most |P (r - D w)| / m: the iteration goes on until this is small, and a solve
that cannot get there gives NaN.

Source: Gould, Hribar, Nocedal, SIAM J. Sci. Comput. 23 (2001).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.linear.pair_gram import PairGram, pair_gram
from jaxcontact.linear.projected_iteration import iterate
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix

#: Vectors (n,) that a solve keeps: preconditioner, right-hand side, lifted bound, iterate,
#: residual, direction, its image and the scaled residual.
N_VECTORS = 8

#: Powers of the tolerance, 1e-9 and 1e-6 of 1e-12: the relative error of w that ill-conditioned
#: matrices are iterated to, and that above which a solve counts as failed.
WANTED_ERROR, LARGEST_ERROR = 0.75, 0.5

#: Residual that rounding leaves, in rounding errors of its terms.
ROUNDING = 4.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class IterativeFactor:
    """A matrix that is solved with by iteration: nothing is factorised.

    A result is NaN if the iteration did not end or if the estimated error of w exceeds
    sqrt(tolerance) (|w| + |r| + |lifted b_A|), 1e-6 for the default tolerance. float64 attains that
    up to a condition of M^-1 D of about 1e9.
    """

    matrix: SymmetricMatrix
    """D, (n, n)."""

    normals: ContactNormals
    """N, (C, n)."""

    preconditioner: Array
    """One over the diagonal entries of D, (n,): the diagonal of M^-1."""

    gram: PairGram
    """G = N M^-1 N^T of all pairs."""

    smallest_eigenvalue: Array
    """m, the smallest eigenvalue of M^-1 D, scalar; estimated from above, within a factor of about
    five. NaN if the solve that finds it failed."""

    tolerance: float = field(metadata={"static": True})
    """Residual at which the iteration stops, relative to the terms of the equation."""

    max_iterations: int = field(metadata={"static": True})
    """Iterations of each of the two runs of a solve; NaN if the second does not end in them."""

    @property
    @jax.jit
    def is_positive(self) -> Array:
        """True if diagonal and smallest eigenvalue are positive, () bool.

        False also if the solve that finds the eigenvalue did not end.
        """
        return jnp.all(self.preconditioner > 0.0) & (self.smallest_eigenvalue > 0.0)

    @property
    def compliance(self) -> None:
        """None: the contact cannot be condensed (nothing is factorised)."""
        return None

    @property
    def approximate_compliance(self) -> Array:
        """Diagonal of N M^-1 N^T, (C,), for that of N D^-1 N^T: a scale, not a solution."""
        return self.gram.diagonal

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
            w (n,) and the multiplier p (C,), zero outside A; NaN if the solve failed.
        """
        normals, scaled, n = self.normals, self.gram.scaled, rhs.shape[0]
        by_gram = self.gram.inverse_on(active)

        def restrict(x: Array, rows: ContactNormals, columns: ContactNormals) -> Array:
            # Twice: what is left along the normals is then relative to the result, not to x.
            for _ in range(2):
                x = x - columns.transposed_product(by_gram(rows @ x), n)
            return x

        def without_pressure(force: Array) -> Array:
            return restrict(force, scaled, normals)

        lifted = scaled.transposed_product(by_gram(jnp.where(active, bound, 0.0)), n)
        # Squares of norms of 1e-20 are zero in float32: in units of a power of two of its data.
        root = jnp.sqrt(self.preconditioner)
        unit = _power_of_two(jnp.max(jnp.maximum(jnp.abs(root * rhs), jnp.abs(lifted / root))))
        rhs, lifted = rhs / unit, lifted / unit
        # The right-hand side and the lifted bound may cancel: rounding is relative to both.
        terms = _norm(rhs, self.preconditioner) + _norm(lifted, 1.0 / self.preconditioner)

        def improve(_: int, solution: tuple[Array, Array]) -> tuple[Array, Array]:
            w = solution[0]
            size = terms + _norm(w, 1.0 / self.preconditioner)
            z, is_small = iterate(
                lambda x: without_pressure(self.matrix @ x),
                self.preconditioner,
                without_pressure(rhs - self.matrix @ w),
                lambda change: self._wanted_residual(terms, size + change),
                self.max_iterations,
            )
            # Many iterations gather rounding errors in the directions that are projected out.
            return lifted + restrict(w + z, normals, scaled), is_small

        # Twice: the residual of the recurrence misses its own rounding errors, which the second
        # run removes where they matter; where not it takes no iteration.
        w, has_ended = jax.lax.fori_loop(0, 2, improve, (lifted, jnp.array(False)))
        force = rhs - self.matrix @ w
        p = by_gram(scaled @ force)
        error = _norm(without_pressure(force), self.preconditioner) / self.smallest_eigenvalue
        size = terms + _norm(w, 1.0 / self.preconditioner)
        is_accurate = error <= self.tolerance**LARGEST_ERROR * size
        poison = jnp.where(has_ended & is_accurate, unit, jnp.nan)
        return w * poison, p * poison

    def _wanted_residual(self, terms: Array, size: Array) -> Array:
        """Return the size of the residual at which the iteration stops, scalar.

        Args:
            terms: |r| + |lifted b_A|, scalar.
            size: |w| added to it, scalar.
        """
        allowed = self.tolerance**WANTED_ERROR * self.smallest_eigenvalue * size
        attainable = _rounding(size.dtype) * size
        return jnp.maximum(jnp.minimum(self.tolerance * terms, allowed), attainable)


def _rounding(dtype: jnp.dtype) -> float:
    """Return the relative residual that rounding leaves."""
    return ROUNDING * float(jnp.finfo(dtype).eps)


def _power_of_two(x: Array) -> Array:
    """Return a power of two as large as a scalar, within a factor of two; one for zero."""
    return jnp.where(x > 0.0, jnp.ldexp(jnp.ones_like(x), jnp.frexp(x)[1]), 1.0)


def _norm(x: Array, weights: Array) -> Array:
    """Return sqrt(sum of weights x^2), scalar."""
    return jnp.sqrt(jnp.sum(weights * x**2))


@jax.jit
def _find_smallest_eigenvalue(factor: IterativeFactor) -> Array:
    """Return the Rayleigh quotient of D^-1 M^(1/2) x for a random x, scalar.

    Every mode is in x, and the inverse makes the lowest ones large.
    """
    weights = factor.preconditioner
    x = jax.random.normal(jax.random.key(0), weights.shape, weights.dtype)
    w = factor.solve(x / jnp.sqrt(weights))
    return jnp.vdot(w, factor.matrix @ w) / jnp.sum(w**2 / weights)


@dataclass(frozen=True)
class ConjugateGradient:
    """Solve every step by preconditioned conjugate gradients; no factor is stored.

    Works with `SemismoothNewton`. Where contact pairs share unknowns, as between two bodies, one
    dense C x C matrix of all C pairs is kept and inverted for every active set. Equal pairs share
    their force; steps with pairs that are almost equal, as of two planes that differ by less than
    some 1e-3 in direction, may not converge: `NestedDissection` solves them.
    """

    tolerance: float = 1e-12
    """Residual at which the iteration stops, relative to the terms of the equation; float32 stops
    at a few rounding errors if that is larger. A solve whose error may exceed sqrt(tolerance)
    counts as failed."""

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
            ValueError: if the model is a reduced one, or the values are concrete and so
                ill-conditioned that no solve could succeed.
        """
        if normals.unknowns is None:
            raise ValueError("matrices of a reduced model are dense; use linear_solver=jc.Dense()")
        floor = 8.0 * float(jnp.finfo(matrix.values.dtype).eps)
        preconditioner = 1.0 / matrix.diagonal()
        tolerance = max(self.tolerance, floor)
        # An infinite eigenvalue asks for no more than the tolerance.
        dtype = preconditioner.dtype
        unknown = jnp.asarray(np.inf, dtype)
        gram = pair_gram(normals, preconditioner)
        factor = IterativeFactor(
            matrix, normals, preconditioner, gram, unknown, tolerance, self.max_iterations
        )
        smallest = _find_smallest_eigenvalue(factor)
        least = _rounding(dtype) / tolerance**LARGEST_ERROR
        if not isinstance(smallest, Tracer) and 0.0 < float(smallest) < least:
            raise ValueError(
                f"the matrix has a condition of about {1.0 / float(smallest):.0e} after scaling, "
                f"{1.0 / least:.0e} is the most that ConjugateGradient(tolerance={self.tolerance}) "
                f"solves in {dtype}; use linear_solver=jc.NestedDissection() or a "
                "smaller dt"
            )
        return replace(factor, smallest_eigenvalue=smallest)

    def bytes_needed(self, size: int, dimension: int, itemsize: int) -> float:
        """Return the memory of the vectors (n,) that an iteration keeps, [bytes]."""
        del dimension
        return float(N_VECTORS * itemsize * size)
