"""Inner products of controls, and gradients as Riesz representatives.

    L2(0,T; L2):  (u, w) = tau sum_k u_k . L w_k,      G_k = (1/tau) L^-1 dJ/du_k

with the scalar mass matrix L on all nodes, or with that on the unknowns for controls (T, n). In
general (p, q) = p . M q turns the derivative dJ (a covector) into the gradient M^-1 dJ (a vector).
Step lengths, norms and stopping criteria then depend neither on mesh nor on time step. Source:
MATH.md 3.

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

from jaxcontact.system.control_space import (
    as_columns,
    from_columns,
    solve_mass,
    solve_mass_product,
)
from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision


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
    """L2(0,T; L2) on controls (T, N, d), or in unknowns (T, n)."""

    system: System
    """The discretised scene, whose scalar mass is the inner product in space."""

    dt: float | Array
    """Length of a time step, [s]."""

    @in_full_precision
    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two controls of one shape, a scalar."""
        product = control_mass(self.system, second) @ as_columns(second)
        return self.dt * jnp.vdot(first, from_columns(product, second))

    def riesz(self, derivative: Array) -> Array:
        """Return the gradient of a derivative, of the same shape."""
        return solve_mass(control_mass(self.system, derivative), derivative) / self.dt


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Euclidean:
    """The inner product sum p q of parameters that are no control; all should be of one size.

    Example:
        >>> target = jnp.array([1.0, 2.0])
        >>> result = jc.optimize(
        ...     lambda p: jnp.sum((p - target) ** 2), jnp.zeros(2), inner_product=jc.Euclidean()
        ... )
        >>> result.parameters.round(6)
        Array([1., 2.], dtype=float64)
    """

    def dot(self, first: Array, second: Array) -> Array:
        """Return the inner product of two elements, a scalar."""
        return jnp.vdot(first, second)

    def riesz(self, derivative: Array) -> Array:
        """Return the derivative itself, which represents it."""
        return derivative


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
        product = from_columns(self._mass_product(as_columns(second)), second)
        return jnp.sum(self.durations * jnp.sum(_by_interval(first * product), axis=1))

    def riesz(self, derivative: Array) -> Array:
        """Return the element (K, R, ...) that represents a derivative."""
        diagonal = self.nodal_mass.diagonal()[self.nodes]
        solution = solve_mass_product(self._mass_product, diagonal, derivative)
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
        first: control (T, N, d) or (T, n).
        second: control of the same shape.

    Returns:
        tau sum_k first_k . L second_k, a scalar; its root with twice the same is the norm.
    """
    return L2(system, dt).dot(first, second)


def l2_value_and_grad(
    objective: Callable[[Array], Array], system: System, dt: float | Array
) -> Callable[[Array], tuple[Array, Array]]:
    """Return a function that evaluates an objective and its gradient in L2(0,T; L2).

    Args:
        objective: maps a control (T, N, d) or (T, n) to a scalar.
        system: the discretised scene; its mass defines the inner product.
        dt: length of a time step, [s].

    Returns:
        A function of a control with values (scalar, gradient of its shape). For the tracking cost,
        G_k = alpha u_k + scale tau/2 p_k with the adjoint p of (4.41).
    """
    value_and_derivative = jax.value_and_grad(objective)

    def value_and_grad(u: Array) -> tuple[Array, Array]:
        value, derivative = value_and_derivative(u)
        return value, L2(system, dt).riesz(derivative)

    return value_and_grad


def nodal_norms(nodal_mass: SymmetricMatrix, fields: Array) -> Array:
    """Return the squared L2 norms (S,) of S nodal fields (S, N, d)."""
    columns = as_columns(fields)
    return jnp.sum(columns * (nodal_mass @ columns), axis=0).reshape(fields.shape[0], -1).sum(1)


def control_mass(system: System, control: Array) -> SymmetricMatrix | ComponentwiseMatrix:
    """Return the mass L of controls of the shape of one: (T, N, d) on nodes, (T, n) on unknowns."""
    return system.l2_mass if control.ndim == 2 else system.nodal_mass


def lumped_mass(system: System) -> Array:
    """Return the integral of each hat function, (N,) [m^d]: the row sums of the scalar mass."""
    return system.nodal_mass @ jnp.ones(system.n_nodes, system.dtype)


def lumped_l2(system: System, dt: float | Array) -> Weighted:
    """Return the inner product of L2(0,T; L2) with lumped mass, on controls (T, N, d)."""
    return Weighted(dt * lumped_mass(system)[None, :, None])


def _by_interval(fields: Array) -> Array:
    """Return fields (K, R, ...) as rows (K, R ...)."""
    return fields.reshape(fields.shape[0], -1)
