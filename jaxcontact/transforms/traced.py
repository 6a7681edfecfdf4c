"""What may be traced: how to see it, and how a wrong value shows although nothing can be raised.

Under jit, grad and vmap a check cannot look at a value. The results are multiplied by NaN
then: multiplication carries the NaN into the derivatives too, where `jnp.where` would leave zeros.
"""

from __future__ import annotations

from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from numpy.typing import ArrayLike

Tree = TypeVar("Tree")

#: A NumPy or a JAX array, for functions that keep the kind they get.
Values: TypeAlias = Any


def is_traced(tree: object) -> bool:
    """Return True if JAX traces a leaf of the pytree."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def as_array(value: ArrayLike | list[Array]) -> Array | np.ndarray:
    """Return a number, an array or a list of numbers as an array, on the host if it is concrete."""
    return jnp.asarray(value) if is_traced(value) else np.asarray(value)


def take_rows(values: Values, numbers: np.ndarray) -> Values:
    """Return values[numbers], concrete if the values are, also under jit."""
    if is_traced(values):
        return values[numbers]
    with jax.ensure_compile_time_eval():
        return values[numbers]


def join_rows(first: Values, second: Values) -> Values:
    """Return both arrays one after the other, concrete if both are, also under jit."""
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return np.concatenate([first, second])
    if is_traced((first, second)):
        return jnp.concatenate([first, second])
    with jax.ensure_compile_time_eval():
        return jnp.concatenate([first, second])


def poison_unless(condition: Array | bool, values: Tree) -> Tree:
    """Return the values, or NaN in every floating point entry where the condition is false.

    Args:
        condition: a scalar; may be traced.
        values: pytree of arrays; those of other types are left alone.

    Derivative: by the values, one where the condition holds, else NaN.
    """
    factor = jnp.where(condition, 1.0, jnp.nan)

    def poison(value: Array) -> Array:
        is_float = jnp.issubdtype(jnp.result_type(value), jnp.floating)
        return value * factor.astype(value.dtype) if is_float else value

    return jax.tree.map(poison, values)
