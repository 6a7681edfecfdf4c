"""Products of matrices in the precision of their entries, on every device.

JAX multiplies float32 matrices on recent GPUs in TF32, with 10 bits of mantissa instead of 23,
unless it is told otherwise. float64, and every type on a CPU, is not affected.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def in_full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function, traced so that none of its matrix products is rounded further.

    What the function calls is covered, and what JAX derives from its trace. The rules of a custom
    derivative, of a custom vmap and of a primitive are traced later and need a mark of their own.
    """

    @functools.wraps(function)
    def with_full_precision(*arguments: P.args, **keywords: P.kwargs) -> R:
        with jax.default_matmul_precision("highest"):
            return function(*arguments, **keywords)

    return with_full_precision
