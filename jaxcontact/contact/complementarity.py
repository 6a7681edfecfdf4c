"""The linear complementarity problem of one step, condensed to the contact pairs.

    0 <= p  _|_  g = W p + q >= 0,

with the contact compliance W = N D^-1 N^T (SPD), the multiplier p and the relative velocity g at
which a pair separates; -q is the velocity by which the free motion would violate the constraint.
Source: MATH.md 2.
"""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import jax.scipy.linalg
from jax import Array

from jaxcontact.transforms.trees import PyTree

#: A step counts as solved if its KKT residual is below this multiple of the largest violation
#: of the free motion, or below the rounding errors of the gap.
RELATIVE_TOLERANCE = {"float64": 1e-11, "float32": 1e-5}


class Status(IntEnum):
    """How the contact problem of a step ended."""

    CONVERGED = 0
    FALLBACK = 1
    """Converged, but by the safeguard of the chosen method."""
    NOT_CONVERGED = 2
    NON_FINITE = 3
    PENETRATES = 4
    """A pair that is taken to stay open (`System.with_pairs`) would penetrate."""


class Guess(NamedTuple):
    """What one step hands to the contact problem of the next."""

    active: Array
    """Active set to start from, (C,) bool."""

    workspace: PyTree = ()
    """What else the contact solver keeps, see `ContactSolver.first_workspace`."""


class Solution(NamedTuple):
    """The solution of the complementarity problem of C contact pairs."""

    multiplier: Array
    """p >= 0, (C,) [impulse]; exactly zero if W_ii p_i is within the tolerance of the residual."""

    active: Array
    """g = 0 up to rounding, (C,) bool: strong contact (p > 0) and weak contact (p = 0)."""

    iterations: Array
    """Number of active sets (Newton) or sweeps (Gauss-Seidel), int32."""

    status: Array
    """A `Status`, int32."""

    residual: Array
    """KKT residual relative to the largest violation of the free motion, scalar."""

    workspace: PyTree = ()
    """What the contact solver hands to the next step; never differentiated."""

    separation: PyTree = ()
    """b - N w, the velocity at which each pair separates, (C,); set by `ContactProblem.solve`."""

    frames: PyTree = ()
    """The frames of bodies that turn after the step, a `FrameState`; set by `TurningProblem`."""

    @property
    def weak(self) -> Array:
        """Pairs in weak contact, (C,) bool: active without a multiplier."""
        return self.active & ~(self.multiplier > 0.0)

    @property
    def guess(self) -> Guess:
        """Where the next step starts."""
        return Guess(self.active, self.workspace)


@runtime_checkable
class ContactSolver(Protocol):
    """An option object: a pytree; `jax.tree_util.register_static` if it holds no array."""

    is_exact: ClassVar[bool]
    """Whether contact is rigid, p g = 0; if not, `softness` enters the derivative."""

    uses_compliance: ClassVar[bool]
    """Whether the law of a pair is one of d p with d = W_ii, so that the derivative by a matrix
    enters the law through d too."""

    @property
    def max_active_sets(self) -> int | None:
        """Active sets to try where contact cannot be condensed; None if the solver needs W."""
        ...

    def check(self) -> None:
        """Raise a ValueError if a concrete number that a pytree may not check itself is wrong."""
        ...

    def first_workspace(self, compliance: Array) -> PyTree:
        """Return what the solver keeps between the steps of W, (C, C); () if nothing."""
        ...

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Guess) -> Solution:
        """Solve the complementarity problem.

        Args:
            compliance: W, (C, C) SPD.
            offset: q, (C,).
            resolution: rounding error of q, (C,); smaller values are zero.
            guess: where to start; its workspace may be missing.
        """
        ...

    def softness(self, compliance: Array | None, multiplier: Array) -> Array:
        """Return -dg/dp of the contact law, (C,): zero where it is rigid, infinite where open.

        Args:
            compliance: d = diag W, (C,); None unless the solver `uses_compliance`.
            multiplier: p, (C,).
        """
        ...


def rank_shift(compliance: Array) -> float:
    """Return what is added to the unit diagonal of the scaled compliance before it is factorised.

    Pairs that lean on each other (nearly equal planes at a corner, more planes at a node than it
    has components) make W singular. The shift e lets them share the force at the price of a
    relative error e / s in a direction of singular value s, which each refinement with W itself
    multiplies by e / s once more; its own rounding error is eps / e.
    """
    return float(jnp.finfo(compliance.dtype).eps) ** (5 / 8)


def separation(compliance: Array, offset: Array, multiplier: Array) -> Array:
    """Return g = W p + q, (C,)."""
    return compliance @ multiplier + offset


def residual(compliance: Array, offset: Array, multiplier: Array) -> Array:
    """Return the natural residual |min(W_ii p_i, g_i)|, (C,), in units of velocity."""
    g = separation(compliance, offset, multiplier)
    return jnp.abs(jnp.minimum(jnp.diagonal(compliance) * multiplier, g))


def tolerance(offset: Array, resolution: Array) -> Array:
    """Return the residual (C,) below which a step counts as solved."""
    violation = jnp.max(jnp.maximum(-offset, 0.0))
    return RELATIVE_TOLERANCE[str(offset.dtype)] * violation + 4.0 * resolution


def solve_compliance(compliance: Array, active: Array, softness: Array | None, rhs: Array) -> Array:
    """Return p with (W p + softness p)_i = rhs_i on the active set and p_i = rhs_i elsewhere.

    Args:
        compliance: W, (C, C) SPD.
        active: the active set, (C,) bool.
        softness: added to the diagonal on the active set, (C,), or None for zero.
        rhs: right-hand side, (C,).
    """
    inside = active[:, None] & active[None, :]
    diagonal = jnp.where(active, 0.0 if softness is None else softness, 1.0)
    diagonal = diagonal.astype(compliance.dtype)
    # Scaling by the diagonal keeps pairs of very different stiffness apart.
    scale = jax.lax.rsqrt(jnp.where(active, jnp.diagonal(compliance), 0.0) + diagonal)
    matrix = jnp.where(inside, compliance, 0.0) * scale[:, None] * scale[None, :]
    matrix = matrix + jnp.diag(diagonal * scale**2)
    return scale * solve_unit_diagonal(matrix, scale * rhs)


def solve_unit_diagonal(matrix: Array, rhs: Array) -> Array:
    """Return x with `matrix` x = rhs, (C,), for a positive semidefinite matrix of diagonal one."""
    shift = rank_shift(matrix) * jnp.eye(rhs.size, dtype=rhs.dtype)
    factor = jax.scipy.linalg.cho_factor(matrix + shift, lower=True)
    first = jax.scipy.linalg.cho_solve(factor, rhs)
    # Once more for the remainder, which takes the shift out again.
    return first + jax.scipy.linalg.cho_solve(factor, rhs - matrix @ first)


def last_of(pairs: Array) -> Array:
    """Return the last one of a set of pairs, (C,) bool: Murty's rule moves it alone.

    From any set of an SPD problem, moving the last pair with a wrong sign ends at the solution
    after finitely many sets. Source: Murty, Opsearch 11 (1974) 3-21.
    """
    numbers = jnp.arange(pairs.shape[0])
    return numbers == jnp.max(jnp.where(pairs, numbers, -1), initial=-1)


def finish(
    compliance: Array,
    offset: Array,
    resolution: Array,
    multiplier: Array,
    iterations: Array,
    is_fallback: Array,
) -> Solution:
    """Return the solution with its active set and a status that is earned by the residual."""
    g = separation(compliance, offset, multiplier)
    error = residual(compliance, offset, multiplier)
    goal = tolerance(offset, resolution)
    is_solved = jnp.all(error <= goal)
    is_finite = jnp.all(jnp.isfinite(error)) & jnp.all(jnp.isfinite(offset))
    status = jnp.where(is_fallback, Status.FALLBACK, Status.CONVERGED)
    status = jnp.where(is_solved, status, Status.NOT_CONVERGED)
    status = jnp.where(is_finite, status, Status.NON_FINITE)
    # Below the tolerance a multiplier is rounding: exactly zero marks weak contact.
    is_pressed = jnp.diagonal(compliance) * multiplier > goal
    multiplier = jnp.where(is_pressed | ~is_finite, multiplier, 0.0)
    active = is_pressed | (g <= goal)
    relative_tolerance = RELATIVE_TOLERANCE[str(offset.dtype)]
    tiny = jnp.finfo(offset.dtype).tiny
    relative = relative_tolerance * jnp.max(error / jnp.maximum(goal, tiny))
    return Solution(multiplier, active, iterations, status.astype(jnp.int32), relative)
