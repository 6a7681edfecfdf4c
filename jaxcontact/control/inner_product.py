"""Inner products of controls, and gradients as Riesz representatives.

    L2(0,T; L2):  (u, w) = tau sum_k u_k . L w_k,      G_k = (1/tau) L^-1 dJ/du_k

with the scalar mass matrix L on all nodes. In general (p, q) = p . M q turns the derivative dJ (a
covector) into the gradient M^-1 dJ (a vector). Step lengths, norms and stopping criteria then do
not depend on mesh or time step. Source: MATH.md 3.

With box bounds the nodewise projection is the metric projection only if M is diagonal, and only
then does u = P(u - G) state the first-order conditions of the bounded problem: for a consistent
mass, dJ = 0 off the bounds does not imply M^-1 dJ = 0 there. Bounded problems therefore use the
lumped mass, which is equivalent to the consistent one with constants that no mesh changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.system.sparse import SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision

#: Relative residual of the mass solve; about thirty iterations, since L is well conditioned.
MASS_TOLERANCE = {"float64": 1e-14, "float32": 1e-6}


@runtime_checkable
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

    @in_full_precision
    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two controls (T, N, d), a scalar."""
        product = self.system.nodal_mass @ _as_columns(second)
        return self.dt * jnp.vdot(first, _from_columns(product, second))

    def riesz(self, derivative: Array) -> Array:
        """Return the gradient (T, N, d) of a derivative (T, N, d)."""
        return _inverse_mass_product(self.system.nodal_mass, derivative) / self.dt


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
        solution = _solve_mass(self._mass_product, diagonal, derivative)
        return (_by_interval(solution) / self.durations[:, None]).reshape(derivative.shape)

    def _mass_product(self, columns: Array) -> Array:
        shape = (self.nodal_mass.size, columns.shape[1])
        everywhere = jnp.zeros(shape, columns.dtype).at[self.nodes].set(columns)
        return (self.nodal_mass @ everywhere)[self.nodes]


def control_dot(system: System, dt: float | Array, first: Array, second: Array) -> Array:
    """Return the L2(0,T; L2) inner product of two controls.

    Args:
        system: the discretised scene; its nodal mass defines the inner product in space.
        dt: length of a time step, [s].
        first: control (T, N, d).
        second: control (T, N, d).

    Returns:
        tau sum_k first_k . L second_k, a scalar; its root with twice the same is the norm.
    """
    return L2(system, dt).dot(first, second)


def l2_value_and_grad(
    objective: Callable[[Array], Array], system: System, dt: float | Array
) -> Callable[[Array], tuple[Array, Array]]:
    """Return a function that evaluates an objective and its gradient in L2(0,T; L2).

    Args:
        objective: maps a control (T, N, d) to a scalar.
        system: the discretised scene; its nodal mass defines the inner product.
        dt: length of a time step, [s].

    Returns:
        A function of a control (T, N, d) with values (scalar, gradient (T, N, d)). For the
        tracking cost, G_k = alpha u_k + scale tau/2 p_k with the adjoint p of (4.41).
    """
    value_and_derivative = jax.value_and_grad(objective)

    def value_and_grad(u: Array) -> tuple[Array, Array]:
        value, derivative = value_and_derivative(u)
        return value, L2(system, dt).riesz(derivative)

    return value_and_grad


def nodal_norms(nodal_mass: SymmetricMatrix, fields: Array) -> Array:
    """Return the squared L2 norms (S,) of S nodal fields (S, N, d)."""
    columns = _as_columns(fields)
    return jnp.sum(columns * (nodal_mass @ columns), axis=0).reshape(fields.shape[0], -1).sum(1)


def lumped_mass(system: System) -> Array:
    """Return the integral of each hat function, (N,) [m^d]: the row sums of the scalar mass."""
    return system.nodal_mass @ jnp.ones(system.n_nodes, system.dtype)


def lumped_l2(system: System, dt: float | Array) -> Weighted:
    """Return the inner product of L2(0,T; L2) with lumped mass, on controls (T, N, d)."""
    return Weighted(dt * lumped_mass(system)[None, :, None])


@jax.jit
def _inverse_mass_product(nodal_mass: SymmetricMatrix, fields: Array) -> Array:
    """Return L^-1 of fields (S, N, d)."""
    return _solve_mass(lambda x: nodal_mass @ x, nodal_mass.diagonal(), fields)


def _solve_mass(product: Callable[[Array], Array], diagonal: Array, fields: Array) -> Array:
    """Return the fields (S, R, ...) that the product with a mass turns into those given."""
    columns, _ = jax.scipy.sparse.linalg.cg(
        product,
        _as_columns(fields),
        tol=MASS_TOLERANCE[str(fields.dtype)],
        maxiter=200,
        M=lambda x: x / diagonal[:, None],
    )
    return _from_columns(columns, fields)


def _by_interval(fields: Array) -> Array:
    """Return fields (K, R, ...) as rows (K, R ...)."""
    return fields.reshape(fields.shape[0], -1)


def _as_columns(fields: Array) -> Array:
    """Return fields (S, R, ...) as the columns (R, S ...) of a matrix."""
    return jnp.swapaxes(fields, 0, 1).reshape(fields.shape[1], -1)


def _from_columns(columns: Array, like: Array) -> Array:
    """Undo `_as_columns` for fields of the shape of `like`."""
    return jnp.swapaxes(columns.reshape(like.shape[1], like.shape[0], *like.shape[2:]), 0, 1)
