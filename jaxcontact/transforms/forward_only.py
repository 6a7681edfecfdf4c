"""An identity that refuses to be transposed: reverse mode ends with an explanation."""

from __future__ import annotations

from jax import Array
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_forward_only = Primitive("forward_only")


def forward_only(x: Array, advice: str) -> Array:
    """Return x.

    Derivative: forward mode; reverse mode raises a TypeError with the advice.
    """
    return _forward_only.bind(x, advice=advice)


def _transpose(cotangent, x, *, advice):
    del cotangent, x
    raise TypeError(advice)


_forward_only.def_impl(lambda x, *, advice: x)
_forward_only.def_abstract_eval(lambda x, *, advice: x)
ad.deflinear2(_forward_only, _transpose)
batching.defvectorized(_forward_only)
mlir.register_lowering(_forward_only, lambda context, x, *, advice: [x])
