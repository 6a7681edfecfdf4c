"""The compliance of each pair, d = diag(N D^-1 N^T), with its derivative by D and N.

A factor is never differentiated; with z_i = D^-1 n_i the derivative is

    dd_i = 2 dn_i . z_i - z_i . dD z_i,

one solve for each pair, made only if a matrix or the normals are differentiated.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero

from jaxcontact.linear import CondensingFactor, Factor, can_condense
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix
from jaxcontact.transforms.lasting_jvp import lasting_jvp


def pair_compliance(matrix: SymmetricMatrix, normals: ContactNormals, factor: Factor) -> Array:
    """Return d, (C,) [1/kg].

    Args:
        matrix: D, (n, n).
        normals: N, (C, n).
        factor: of D, with the contact rows condensed.

    Derivative: of every order, by the values of matrix and normals.
    """
    assert can_condense(factor)
    return _diagonal(matrix, normals, jax.lax.stop_gradient(factor))


def _compliance(
    matrix: SymmetricMatrix, normals: ContactNormals, factor: CondensingFactor
) -> Array:
    del matrix, normals
    return jnp.diagonal(factor.compliance)


def _compliance_jvp(arguments, tangents):
    matrix, normals, factor = arguments
    values_dot, weights_dot = tangents[0].values, tangents[1].weights

    def one(row: tuple[ContactNormals, Array | None]) -> Array:
        pair, change = jax.tree.map(lambda x: x[None], row)
        normal = pair.transposed_product(jnp.ones(1, pair.weights.dtype), matrix.size)
        z = jax.lax.custom_linear_solve(
            lambda x: matrix @ x, normal, lambda _, r: factor.solve(r), symmetric=True
        )
        rate = jnp.zeros((), z.dtype)
        if change is not None:
            rate = 2.0 * jnp.sum(change * pair.touched(z))
        if not isinstance(values_dot, SymbolicZero):
            rate = rate - jnp.dot(z, SymmetricMatrix(values_dot, matrix.columns) @ z)
        return rate

    changes = None if isinstance(weights_dot, SymbolicZero) else weights_dot
    return _diagonal(*arguments), jax.lax.map(one, (normals, changes))


_diagonal = lasting_jvp(_compliance, _compliance_jvp)
