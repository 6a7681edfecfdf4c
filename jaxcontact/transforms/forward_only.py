"""An identity that refuses to be transposed: reverse mode ends with an explanation."""

from __future__ import annotations

from jax import Array
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_forward_only = Primitive("forward_only")


def forward_only(x: Array) -> Array:
    """Return x.

    Derivative: forward mode; reverse mode raises a TypeError.
    """
    return _forward_only.bind(x)


def _transpose(cotangent, x):
    del cotangent, x
    raise TypeError(
        "weak_contact=CriticalCone() is the one-sided derivative, which is not linear in the "
        "direction: it has no gradient. Use jax.jvp or directional_derivative with it, and for "
        "jax.grad choose a linear branch: Strong(), Inactive() or AlongDirection(direction)"
    )


_forward_only.def_impl(lambda x: x)
_forward_only.def_abstract_eval(lambda x: x)
ad.deflinear2(_forward_only, _transpose)
batching.defvectorized(_forward_only)
mlir.register_lowering(_forward_only, lambda context, x: [x])
