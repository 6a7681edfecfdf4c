"""Control flow that stays on the host where values are concrete, and is JAX's own under a trace.

An algorithm that is written with these three exists once. On concrete values it is plain Python:
it can be interrupted, what it calls may raise and may count, and a branch that is not taken costs
nothing. Under jit, vmap and scan the same lines become `lax.while_loop`, `lax.cond` and `where`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

T = TypeVar("T")


def while_loop(condition: Callable[[T], Array], body: Callable[[T], T], carry: T) -> T:
    """Repeat `carry = body(carry)` while the condition holds.

    Args:
        condition: maps the carry to a bool scalar.
        body: maps a carry to one of the same structure, shapes and types.
        carry: pytree of arrays; one tracer among its leaves makes this a `lax.while_loop`.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(carry)):
        return jax.lax.while_loop(condition, body, carry)
    while condition(carry):
        carry = body(carry)
    return carry


def cond(condition: Array, first: Callable[..., T], second: Callable[..., T], *operands) -> T:
    """Return what one of two functions makes of the operands; the second if not condition."""
    if isinstance(condition, Tracer):
        return jax.lax.cond(condition, first, second, *operands)
    return first(*operands) if condition else second(*operands)


def select(condition: Array, first: T, second: T) -> T:
    """Return one of two pytrees of arrays; the second if not condition."""
    if isinstance(condition, Tracer):
        return jax.tree.map(lambda a, b: jnp.where(condition, a, b), first, second)
    return first if condition else second
