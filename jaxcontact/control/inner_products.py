"""Inner products of a control space, as objects that an optimiser needs nothing else of.

An inner product (p, q) = p . M q turns the derivative dJ (a covector) into the gradient
M^-1 dJ (a vector). Step lengths, norms and curvature then do not depend on mesh or time step.

With box bounds the nodewise projection is the metric projection only if M is diagonal, and only
then does u = P(u - G) state the first-order conditions of the bounded problem: for a consistent
mass, dJ = 0 off the bounds does not imply M^-1 dJ = 0 there. Bounded problems therefore use the
lumped mass, which is equivalent to the consistent one with constants that no mesh changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.control.inner_product import MASS_TOLERANCE, control_dot, riesz_representative
from jaxcontact.system.sparse import SymmetricMatrix
from jaxcontact.system.system import System


class InnerProduct(Protocol):
    """Inner product of a space of arrays; a pytree, so that it can be an argument of jit."""

    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two elements, a scalar."""
        ...

    def riesz(self, derivative: Array) -> Array:
        """Return the element that represents a derivative."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class L2:
    """L2(0,T; L2) on controls (T, N, d)."""

    system: System
    """The discretised scene, whose scalar mass is the inner product in space."""

    dt: float | Array
    """Length of a time step, [s]."""

    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two controls (T, N, d), a scalar."""
        return control_dot(self.system, self.dt, first, second)

    def riesz(self, derivative: Array) -> Array:
        """Return the gradient (T, N, d) of a derivative (T, N, d)."""
        return riesz_representative(self.system, self.dt, derivative)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Weighted:
    """A diagonal inner product (p, q) = sum w p q."""

    weights: Array
    """Positive weights, of the shape of an element or with axes of length one."""

    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two elements, a scalar."""
        return jnp.vdot(first, self.weights * second)

    def riesz(self, derivative: Array) -> Array:
        """Return the element that represents a derivative."""
        return derivative / self.weights


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RegionL2:
    """L2 of fields (K, R, ...) on R nodes of the mesh, constant on K time intervals."""

    nodal_mass: SymmetricMatrix
    """Scalar mass on all nodes, (N, N) [m^d]."""

    nodes: np.ndarray
    """Nodes of the region, (R,) int32."""

    durations: Array
    """Weight of each interval, (K,) [s]."""

    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two elements (K, R, ...), a scalar."""
        product = _from_columns(self._mass_product(_as_columns(second)), second)
        return jnp.sum(self.durations * jnp.sum(_by_interval(first * product), axis=1))

    def riesz(self, derivative: Array) -> Array:
        """Return the element (K, R, ...) that represents a derivative."""
        diagonal = self.nodal_mass.diagonal()[self.nodes]
        columns, _ = jax.scipy.sparse.linalg.cg(
            self._mass_product,
            _as_columns(derivative),
            tol=MASS_TOLERANCE[str(derivative.dtype)],
            maxiter=200,
            M=lambda x: x / diagonal[:, None],
        )
        solution = _by_interval(_from_columns(columns, derivative)) / self.durations[:, None]
        return solution.reshape(derivative.shape)

    def _mass_product(self, columns: Array) -> Array:
        shape = (self.nodal_mass.size, columns.shape[1])
        everywhere = jnp.zeros(shape, columns.dtype).at[self.nodes].set(columns)
        return (self.nodal_mass @ everywhere)[self.nodes]


def _by_interval(fields: Array) -> Array:
    """Return fields (K, R, ...) as rows (K, R ...)."""
    return fields.reshape(fields.shape[0], -1)


def _as_columns(fields: Array) -> Array:
    """Return fields (K, R, ...) as the columns (R, K ...) of a matrix."""
    return jnp.swapaxes(fields, 0, 1).reshape(fields.shape[1], -1)


def _from_columns(columns: Array, like: Array) -> Array:
    """Undo `_as_columns` for fields of the shape of `like`."""
    return jnp.swapaxes(columns.reshape(like.shape[1], like.shape[0], *like.shape[2:]), 0, 1)


def lumped_mass(system: System) -> Array:
    """Return the integral of each hat function, (N,) [m^d]: the row sums of the scalar mass."""
    return system.nodal_mass @ jnp.ones(system.n_nodes, system.dtype)


def lumped_l2(system: System, dt: float | Array) -> Weighted:
    """Return the inner product of L2(0,T; L2) with lumped mass, on controls (T, N, d)."""
    return Weighted(dt * lumped_mass(system)[None, :, None])
