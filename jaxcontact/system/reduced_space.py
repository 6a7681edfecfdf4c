"""Which vectors span the space of a reduced model, in NumPy on the host; see `reduce`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from scipy.sparse import csr_array

from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System

#: Up to so many unknowns all vibrations are computed at once.
DENSE_LIMIT = 400

#: Vibrations of the first try where their number follows from a frequency or a tolerance.
FIRST_TRY = 32

#: Vectors whose part outside of the others is smaller than the root of this are left out.
INDEPENDENT = 1e-14

#: D^-1 of a sparse matrix D, applied to columns (n, r).
Solve = Callable[[np.ndarray], np.ndarray]


class HostSystem(NamedTuple):
    """The matrices of the full system; n unknowns, without those that rollers hold, C pairs."""

    mass: csr_array
    """M, (n, n) [kg]."""

    stiffness: csr_array
    """A, (n, n) [N/m]."""

    viscosity: csr_array | None
    """B, (n, n) [N s/m]."""

    normals: csr_array
    """N, (C, n)."""

    contact_area: np.ndarray
    """Area of each pair, (C,) [m^(d-1)]."""

    allowed: csr_array
    """Z, orthonormal columns of all motions that rollers allow; the identity without rollers."""

    @classmethod
    def of(cls, system: System) -> HostSystem:
        """Return the matrices of a concrete system in double precision."""
        B, Z = system.viscosity, _allowed_motions(system)

        def project(matrix: ComponentwiseMatrix | SymmetricMatrix) -> csr_array:
            return csr_array(Z.T @ csr_array(matrix.to_scipy(), dtype=float) @ Z)

        return cls(
            project(system.mass),
            project(system.stiffness),
            None if B is None else project(B),
            csr_array(csr_array(system.normals.to_scipy(), dtype=float) @ Z),
            np.asarray(system.contact_area, float),
            Z,
        )

    @property
    def size(self) -> int:
        """Number of unknowns, n."""
        return self.mass.diagonal().size


def _allowed_motions(system: System) -> csr_array:
    """Return an orthonormal basis of what the rollers of a system allow."""
    if system.rollers is None:
        return csr_array(scipy.sparse.eye_array(system.size))
    d, rows = system.dimension, np.asarray(system.rollers.weights, float)
    node = np.asarray(system.rollers.unknowns)[:, 0] // d
    blocks = [np.eye(d)] * (system.size // d)
    for k in np.unique(node):
        blocks[k] = scipy.linalg.null_space(rows[node == k])
    return csr_array(scipy.sparse.block_diag(blocks))


class Target(NamedTuple):
    """How many vibrations are wanted: exactly one of the three."""

    modes: int | None
    """Their number."""

    frequency: float | None
    """The highest one, [Hz]."""

    tolerance: float | None
    """What they may leave of the responses to known loads, see `_left`."""

    @classmethod
    def of(cls, size: int, modes, frequency, tolerance) -> Target:
        """Return the target that the arguments of `reduce` state, or say what is wrong.

        Raises:
            ValueError: if not one of them is given, or it is out of its range.
        """
        if sum(x is not None for x in (modes, frequency, tolerance)) != 1:
            raise ValueError("give one of modes, frequency and tolerance")
        is_count = not isinstance(modes, bool) and isinstance(modes, int | np.integer)
        if modes is not None and not (is_count and 1 <= modes < size):
            raise ValueError(f"modes must lie between 1 and n - 1 = {size - 1}, got {modes}")
        if frequency is not None and not 0.0 < frequency < np.inf:
            raise ValueError(f"frequency must be positive and finite, [Hz], got {frequency}")
        if tolerance is not None and not 0.0 < tolerance < 1.0:
            raise ValueError(f"tolerance must lie between 0 and 1, got {tolerance}")
        return cls(None if modes is None else int(modes), frequency, tolerance)

    def count(self, values: np.ndarray, left: np.ndarray) -> int | None:
        """Return how many of the lowest vibrations are enough; None if these are too few.

        Args:
            values: squared angular frequencies, ascending, (m,).
            left: part of the responses that the first 0, 1, ..., m vibrations leave, (m+1,).
        """
        if self.modes is not None:
            return self.modes
        if self.frequency is not None:
            limit = (2.0 * np.pi * self.frequency) ** 2
            return None if values[-1] <= limit else int(np.sum(values <= limit))
        is_enough = left <= self.tolerance
        return int(np.argmax(is_enough)) if is_enough.any() else None


def space(
    system: HostSystem,
    loads: np.ndarray,
    snapshots: np.ndarray,
    target: Target,
    dt: float | None,
    others: np.ndarray | None = None,
) -> tuple[np.ndarray, int]:
    """Return M-orthonormal vectors, (n, r), and how many of them are vibrations or learned.

    Args:
        system: the matrices.
        loads: what is known to act, (n, p) [N].
        snapshots: displacements of similar motions, (n, S).
        target: how many vibrations.
        dt: time step of the step responses; None is without them.
        others: what else the space shall hold, (n, m).
    """
    mass, stiffness, Z = system.mass, system.stiffness, system.allowed
    loads, snapshots = Z.T @ loads, Z.T @ snapshots
    # A free body has rigid motions, on which the stiffness vanishes: shift by a small frequency.
    shift = 1e-3 * _lowest_scale(mass, stiffness)
    solve = scipy.sparse.linalg.splu((stiffness + shift * mass).tocsc()).solve
    pushes = system.normals.T.toarray()
    known = np.concatenate([loads, pushes @ system.contact_area[:, None]], axis=1)
    if target.modes is None and not np.any(known):
        raise ValueError("nothing is known to act on the body; give modes, or loads to respond to")
    lowest, vibrations = _vibrations(mass, stiffness, solve, shift, target, known)
    if lowest > shift:
        solve = scipy.sparse.linalg.splu(stiffness.tocsc()).solve
    learned = _principal(mass, snapshots, vibrations.shape[1] // 2)
    vectors = [vibrations[:, : vibrations.shape[1] - learned.shape[1]], learned]
    vectors += [solve(pushes), solve(loads)]
    if dt is not None:
        matrix = mass + 0.25 * dt**2 * stiffness
        if system.viscosity is not None:
            matrix = matrix + 0.5 * dt * system.viscosity
        vectors.append(scipy.sparse.linalg.splu(matrix.tocsc()).solve(pushes))
    if others is not None:
        vectors.append(Z.T @ others)
    return Z @ _orthonormal(mass, np.concatenate(vectors, axis=1)), vibrations.shape[1]


def _vibrations(
    mass: csr_array,
    stiffness: csr_array,
    solve: Solve,
    shift: float,
    target: Target,
    loads: np.ndarray,
) -> tuple[float, np.ndarray]:
    """Return the lowest squared frequency and as many vibrations as the target asks for, (n, m)."""
    n = len(loads)
    tried = FIRST_TRY if target.modes is None else target.modes
    while True:
        is_whole = n <= DENSE_LIMIT or 2 * tried > n
        values, vectors = (
            _eigh(stiffness.toarray(), mass.toarray())
            if is_whole
            else _lowest(mass, stiffness, solve, shift, tried)
        )
        count = target.count(
            values, _left(mass, solve, values + shift, values > shift, vectors, loads)
        )
        if count is not None or is_whole:
            return values[0], vectors[:, :count]
        tried *= 2


def _lowest(
    mass: csr_array, stiffness: csr_array, solve: Solve, shift: float, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return squared angular frequencies, ascending (m,), and vibrations (n, m)."""
    shifted = scipy.sparse.linalg.LinearOperator(
        mass.shape,
        matvec=solve,  # type: ignore[reportCallIssue]
        dtype=float,  # type: ignore[reportCallIssue]
    )
    start = np.random.default_rng(0).standard_normal(mass.diagonal().size)
    values, vectors = scipy.sparse.linalg.eigsh(
        stiffness, k=count, M=mass, sigma=-shift, OPinv=shifted, v0=start
    )
    order = np.argsort(values)
    return values[order], vectors[:, order]


def _left(
    mass: csr_array,
    solve: Solve,
    values: np.ndarray,
    is_elastic: np.ndarray,
    vectors: np.ndarray,
    loads: np.ndarray,
) -> np.ndarray:
    """Return what the first 0, 1, ..., m vibrations leave of A^-1 M z, z = A^-1 f, (m+1,).

    A is the shifted stiffness that is solved with, and the squared frequencies are shifted alike.

    This is the first correction of a static response z by inertia; in the norm of the elastic
    energy, relative to the whole; the largest one of all loads f. Rigid motions are apart.
    """
    rigid = vectors[:, ~is_elastic]

    def elastic(x: np.ndarray) -> np.ndarray:
        return x - rigid @ (rigid.T @ (mass @ x))

    pulled = mass @ elastic(solve(loads))
    shares = (vectors.T @ pulled) ** 2 / np.where(is_elastic, values, np.inf)[:, None]
    before = np.concatenate([np.zeros((1, shares.shape[1])), np.cumsum(shares, axis=0)])
    whole = np.sum(pulled * elastic(solve(pulled)), axis=0)
    is_there = whole > 0.0
    left = 1.0 - before[:, is_there] / whole[is_there]
    return np.sqrt(np.max(np.maximum(left, 0.0), axis=1, initial=0.0))


def _principal(mass: csr_array, snapshots: np.ndarray, count: int) -> np.ndarray:
    """Return the principal components of the snapshots in the M norm, (n, count or less)."""
    if snapshots.shape[1] == 0:
        return snapshots
    values, rotation = _eigh(snapshots.T @ (mass @ snapshots))
    keep = np.flatnonzero(values > INDEPENDENT * values[-1])[::-1][:count]
    return snapshots @ (rotation[:, keep] / np.sqrt(values[keep]))


def _orthonormal(mass: csr_array, vectors: np.ndarray) -> np.ndarray:
    """Return an M-orthonormal basis of what the vectors span, (n, r)."""
    vectors = vectors / np.sqrt(np.sum(vectors * (mass @ vectors), axis=0))
    # The square roots of the Gram matrix's eigenvalues are singular values in the M norm.
    values, rotation = _eigh(vectors.T @ (mass @ vectors))
    keep = values > INDEPENDENT * values[-1]
    vectors = vectors @ (rotation[:, keep] / np.sqrt(values[keep]))
    # Once more: the first pass leaves errors of the size eps / smallest kept value.
    factor = scipy.linalg.cholesky(vectors.T @ (mass @ vectors), lower=True)
    return scipy.linalg.solve_triangular(factor, vectors.T, lower=True).T


def _eigh(matrix: np.ndarray, mass: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues, ascending (n,), and eigenvectors (n, n) of a symmetric pencil."""
    return scipy.linalg.eigh(matrix, mass)  # type: ignore[reportReturnType]


def _lowest_scale(mass: csr_array, stiffness: csr_array) -> float:
    """Return a lower estimate of the squared elastic frequencies, by the largest one and n."""
    largest = scipy.sparse.linalg.norm(stiffness, 1) / scipy.sparse.linalg.norm(mass, 1)
    return float(largest) / mass.diagonal().size
