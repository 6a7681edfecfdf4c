"""The gaps of weak pairs as functions of a control: derivatives, projections, multipliers.

Row j is the derivative of the gap of weak pair j by the parameters, and its response to an impulse
that pushes weak pair i apart. With Q the M-orthonormal basis of the gradients of the rows,

    project: c -> (I - Q Q^T M) M^-1 c,    correct: the shortest step that adds g to the gaps,

and the multipliers nu of a derivative are those of its part in the rows. All rows come from one
batched adjoint sweep after the other; the Gram matrix R M^-1 R^T says what they are worth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.control.bounds import mask
from jaxcontact.control.problem import Problem
from jaxcontact.linear.memory import available_memory
from jaxcontact.motion.stepper import StepPerturbation, with_perturbation
from jaxcontact.motion.trajectory import Trajectory

#: Rows of one batched sweep: as many as share a pass over the factor without filling the memory.
BATCH = 16

#: Directions of the rows below this times the strongest one count as dependent, squared.
INDEPENDENT = 1e-14

#: Multipliers above minus this times the largest one count as not negative.
SIGN_TOLERANCE = 1e-6


@dataclass(frozen=True)
class WeakRows:
    """The linearised gaps of m weak pairs at one control."""

    problem: Problem
    """The inner product of the parameters."""

    rows: Array
    """Derivatives of the gaps by the parameters, (m, ...)."""

    compliance: np.ndarray
    """Derivative of gap j by an impulse that pushes weak pair i apart, (m, m)."""

    free: Array | None = None
    """The parameters that no bound holds, or None for all: the others do not move."""

    @cached_property
    def gradients(self) -> Array:
        """Riesz representatives of the rows on what may move, (m, ...)."""
        return jnp.stack([self._riesz(row) for row in self.rows]) if len(self.rows) else self.rows

    @cached_property
    def gram(self) -> np.ndarray:
        """R M^-1 R^T, (m, m)."""
        return np.asarray(jnp.einsum("ik,jk->ij", _flat(self.rows), _flat(self.gradients)))

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues and eigenvectors of the independent directions of the scaled rows."""
        scale = self.sizes
        values, vectors = np.linalg.eigh(self.gram / np.outer(scale, scale))
        keep = values > INDEPENDENT * values[-1]
        return values[keep], vectors[:, keep]

    @property
    def sizes(self) -> np.ndarray:
        """Norms of the gradients of the gaps, (m,)."""
        return np.sqrt(np.diagonal(self.gram))

    @property
    def rank(self) -> int:
        """Number of independent rows, at most m."""
        return len(self._spectrum[0]) if len(self.rows) else 0

    @property
    def condition(self) -> float:
        """Condition of the independent rows, each of length one; 1 if there is none."""
        if not len(self.rows):
            return 1.0
        values, _ = self._spectrum
        return float(np.sqrt(values[-1] / values[0]))

    @cached_property
    def _combinations(self) -> np.ndarray:
        """B with B^T (R M^-1 R^T) B = 1, (m, rank)."""
        values, vectors = self._spectrum
        return vectors / np.sqrt(values) / self.sizes[:, None]

    @cached_property
    def _basis(self) -> Array:
        """Q, an M-orthonormal basis of the gradients, (rank, ...)."""
        return jnp.tensordot(jnp.asarray(self._combinations.T), self.gradients, axes=1)

    def project(self, covector: Array) -> Array:
        """Return the gradient of a covector without what would change a weak gap."""
        gradient = self._riesz(covector)
        return gradient if not len(self.rows) else _without(self._basis, gradient, covector)

    def _riesz(self, covector: Array) -> Array:
        return mask(self.free, self.problem.riesz(mask(self.free, covector)))

    def correct(self, gaps: np.ndarray) -> Array:
        """Return the shortest step that adds these gaps, (m,) [m], to those of the weak pairs."""
        if not len(self.rows):
            return jnp.zeros(self.rows.shape[1:], self.rows.dtype)
        inner = self._combinations.T @ gaps
        return jnp.tensordot(jnp.asarray(inner), self._basis, axes=1)

    def multipliers(self, derivative: Array) -> tuple[np.ndarray, Array]:
        """Return nu, (m,), and the derivative without nu times the rows."""
        nu = np.zeros(len(self.rows))
        if not len(self.rows):
            return nu, derivative
        # Once more for the remainder: products of the rows lose half of the digits.
        for _ in range(2):
            inner = np.asarray(_flat(self._basis) @ jnp.ravel(derivative))
            part = self._combinations @ inner
            nu = nu + part
            derivative = derivative - jnp.tensordot(jnp.asarray(part), self.rows, axes=1)
        return nu, derivative

    def in_units_of_the_gradient(self, nu: np.ndarray, pi: np.ndarray) -> np.ndarray:
        """Return both multipliers of the pairs as norms, (2, m): comparable on every mesh."""
        return np.stack([self.sizes * nu, self.sizes * pi / np.diagonal(self.compliance)])


def wrong_signs(sizes: np.ndarray) -> np.ndarray:
    """Return which multipliers (2, m) are negative beyond rounding, (2, m) bool."""
    return sizes < -SIGN_TOLERANCE * np.max(np.abs(sizes), initial=0.0)


def weak_rows(
    problem: Problem,
    motion: Callable[[Array], Trajectory],
    parameters: Array,
    probe: StepPerturbation,
    is_weak: np.ndarray,
    free: Array | None = None,
) -> WeakRows:
    """Return the rows of all weak pairs.

    Args:
        problem: objective, control map and inner product.
        motion: maps a control to its trajectory; a pytree that holds the stepper.
        parameters: where the gaps are linearised.
        probe: what the motion is perturbed by, with a push (T, P, C).
        is_weak: the weak pairs, (T, P, C) bool.
        free: the parameters that no bound holds, or None for all.

    Raises:
        ValueError: if the rows have no room in the memory.
    """
    places = np.argwhere(is_weak)
    _check_room(len(places), parameters)
    rows, responses = [], []
    for start in range(0, len(places), BATCH):
        batch = places[start : start + BATCH]
        # Always the same number: one program for all.
        padded = np.concatenate([batch, np.repeat(batch[:1], BATCH - len(batch), axis=0)])
        row, response = _gap_sensitivities(motion, problem.controls, parameters, probe, padded)
        rows.append(row[: len(batch)])
        responses.append(np.asarray(response)[: len(batch), is_weak])
    problem.counts.rows += len(places)
    if not rows:
        return WeakRows(
            problem, jnp.zeros((0, *parameters.shape), parameters.dtype), np.zeros((0, 0)), free
        )
    return WeakRows(problem, jnp.concatenate(rows), np.concatenate(responses), free)


def _check_room(count: int, parameters: Array) -> None:
    """Raise a ValueError if rows, gradients and basis would not fit in memory."""
    needed, available = 3 * count * parameters.nbytes, available_memory()
    if available is not None and needed > 0.5 * available:
        raise ValueError(
            f"{count} node-steps are in weak contact, whose gaps need {needed / 1e9:.2g} GB of "
            "memory, more than half of what there is; does the body rest on the obstacle without "
            "a force? Start it at a distance, lower the tolerance, or optimise fewer parameters"
        )


def _flat(fields: Array) -> Array:
    return fields.reshape(len(fields), math.prod(fields.shape[1:]))


@jax.jit
def _without(basis: Array, gradient: Array, covector: Array) -> Array:
    inner = _flat(basis) @ jnp.ravel(covector)
    return gradient - jnp.tensordot(inner, basis, axes=1)


@jax.jit
def _gap_sensitivities(motion, controls, parameters, probe, places):
    def gap(p, z, place):
        perturbed = with_perturbation(motion, probe._replace(push=z))
        return perturbed(controls(p)).contact.gap[tuple(place)]

    by = jax.grad(gap, argnums=(0, 1))
    return jax.vmap(by, in_axes=(None, None, 0))(parameters, probe.push, places)
