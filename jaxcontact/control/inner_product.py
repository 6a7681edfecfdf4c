"""The inner product of controls, L2(0,T; L2), and gradients as its Riesz representatives.

    (u, w) = tau sum_k u_k . L w_k,      G_k = (1/tau) L^-1 dJ/du_k

with the scalar mass matrix L on all nodes. In this inner product gradients, step lengths and
stopping criteria do not depend on the mesh or on the time step. Source: MATH.md 3.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.system.sparse import SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision

#: Relative residual of the mass solve; about thirty iterations, since L is well conditioned.
MASS_TOLERANCE = {"float64": 1e-14, "float32": 1e-6}


def nodal_norms(nodal_mass: SymmetricMatrix, fields: Array) -> Array:
    """Return the squared L2 norms (S,) of S nodal fields (S, N, d)."""
    columns = _as_columns(fields)
    return jnp.sum(columns * (nodal_mass @ columns), axis=0).reshape(fields.shape[0], -1).sum(1)


@in_full_precision
def control_dot(system: System, dt: float | Array, first: Array, second: Array) -> Array:
    """Return the L2(0,T; L2) inner product of two controls (T, N, d), a scalar."""
    return dt * jnp.vdot(first, _from_columns(system.nodal_mass @ _as_columns(second), second))


def riesz_representative(system: System, dt: float | Array, derivative: Array) -> Array:
    """Return the gradient (T, N, d) that represents a derivative dJ/du (T, N, d)."""
    return _riesz_representative(system.nodal_mass, dt, derivative)


@jax.jit
def _riesz_representative(nodal_mass: SymmetricMatrix, dt: Array, derivative: Array) -> Array:
    diagonal = nodal_mass.diagonal()
    columns = _as_columns(derivative)
    solution, _ = jax.scipy.sparse.linalg.cg(
        lambda x: nodal_mass @ x,
        columns,
        tol=MASS_TOLERANCE[str(derivative.dtype)],
        maxiter=200,
        M=lambda x: x / diagonal[:, None],
    )
    return _from_columns(solution, derivative) / dt


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
        return value, riesz_representative(system, dt, derivative)

    return value_and_grad


def _as_columns(fields: Array) -> Array:
    """Return nodal fields (S, N, d) as the columns (N, S d) of a matrix."""
    return jnp.swapaxes(fields, 0, 1).reshape(fields.shape[1], -1)


def _from_columns(columns: Array, like: Array) -> Array:
    """Undo `_as_columns` for fields of the shape of `like`."""
    return jnp.swapaxes(columns.reshape(like.shape[1], like.shape[0], -1), 0, 1)
