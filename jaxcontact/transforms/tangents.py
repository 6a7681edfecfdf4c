"""Tangents of pytrees: from symbolic zeros to arrays, and from float leaves to a whole tree."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from jaxcontact.transforms.trees import PyTree


def instantiate(tangent: Array | SymbolicZero) -> Array:
    """Return a tangent or cotangent as an array, also if it is a symbolic zero."""
    if isinstance(tangent, SymbolicZero):
        aval: Any = tangent.aval
        return jnp.zeros(aval.shape, aval.dtype)
    return tangent


def tangent_of(primal: PyTree, tangents: PyTree) -> PyTree:
    """Return the tangent of a pytree from those of its floating point leaves; None is zero."""
    leaves, structure = jax.tree.flatten(primal)
    given = iter([None] * len(leaves) if tangents is None else jax.tree.leaves(tangents))

    def tangent(x: Any) -> Any:
        if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
            return np.zeros(jnp.shape(x), jax.dtypes.float0)
        value = next(given, None)
        return jnp.zeros_like(x) if value is None else value

    return jax.tree.unflatten(structure, [tangent(x) for x in leaves])
