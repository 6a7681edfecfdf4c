"""Controls on all nodes, u (T, N, d), and in unknowns, c (T, n): their loads and the way back.

    load of u: V^T (L u),    load of c: L_n c,    L_n = V^T L V,

with V the columns of the free components in a full model. Source: MATH.md 10.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import jax.scipy.sparse.linalg
from jax import Array

from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.transforms.precision import in_full_precision

if TYPE_CHECKING:
    from jaxcontact.system.system import System

#: Relative residual of the mass solve; about thirty iterations, since L is well conditioned.
MASS_TOLERANCE = {"float64": 1e-14, "float32": 1e-6}


@in_full_precision
@jax.jit
def control_loads(system: System, control: Array) -> Array:
    """Return the loads (T, n) [N] of a control (T, N, d) or (T, n) [N/m^d]."""
    if control.ndim == 2:
        return jax.vmap(system.l2_mass.__matmul__)(control)
    if system.basis is None:
        columns = jnp.moveaxis(control, 0, -1)  # (N, d, T)
        force = system.nodal_mass @ columns.reshape(system.n_nodes, -1)
        return system.free_components(jnp.moveaxis(force.reshape(columns.shape), -1, 0))
    # L V first: then all steps are one product with it, and no copy of the control is made.
    nodal = jnp.moveaxis(system.lift(jnp.eye(system.size, dtype=control.dtype)), 0, -1)
    weighted = system.nodal_mass @ nodal.reshape(system.n_nodes, -1)  # (N, d n)
    return control.reshape(len(control), -1) @ weighted.reshape(-1, system.size)


@in_full_precision
@jax.jit
def solve_mass(mass: SymmetricMatrix | ComponentwiseMatrix, fields: Array) -> Array:
    """Return L^-1 of fields, (S, n, ...)."""
    return solve_mass_product(lambda x: mass @ x, mass.diagonal(), fields)


def solve_mass_product(product: Callable[[Array], Array], diagonal: Array, fields: Array) -> Array:
    """Return the fields (S, R, ...) that the product with a mass turns into those given."""
    columns, _ = jax.scipy.sparse.linalg.cg(
        product,
        as_columns(fields),
        tol=MASS_TOLERANCE[str(fields.dtype)],
        maxiter=200,
        M=lambda x: x / diagonal[:, None],
    )
    return from_columns(columns, fields)


def as_columns(fields: Array) -> Array:
    """Return fields (S, R, ...) as the columns (R, S ...) of a matrix."""
    return jnp.swapaxes(fields, 0, 1).reshape(fields.shape[1], -1)


def from_columns(columns: Array, like: Array) -> Array:
    """Undo `as_columns` for fields of the shape of `like`."""
    return jnp.swapaxes(columns.reshape(like.shape[1], like.shape[0], *like.shape[2:]), 0, 1)
