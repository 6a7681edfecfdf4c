"""A `jax.custom_jvp` that lasts: a primitive whose derivative rule no transformation drops.

`jax.grad` of a `lax.scan` moves what does not change between steps out of the loop, and on the way
replaces every `custom_jvp` call by its plain function (JAX takes it that derivatives have been
taken). A second derivative then differentiates the iteration of the contact solver, without the
derivative by the matrix that only the rule knows: the result is finite and wrong. A primitive
stays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import ShapedArray
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxcontact.transforms.precision import in_full_precision

_lasting = Primitive("lasting_jvp")
_lasting.multiple_results = True


def lasting_jvp(function: Callable, rule: Callable) -> Callable:
    """Return the function with a rule for its derivative.

    Args:
        function: maps pytrees of arrays to a pytree of arrays; a module-level function without
            closure over arrays. Static pytrees are allowed.
        rule: maps (primals, tangents) to (result, tangent of the result), like the rule of a
            `jax.custom_jvp` with symbolic zeros.

    Returns:
        A function with the same result. Derivative: by the rule, in any order of transformations.
    """
    # Marked, since both are traced outside of `call` when the primitive is lowered or
    # differentiated; under jit the function is not traced anew each time.
    function, rule = jax.jit(in_full_precision(function)), in_full_precision(rule)

    def call(*arguments: object) -> object:
        leaves, tree = jax.tree.flatten(arguments)
        result_tree = jax.tree.structure(jax.eval_shape(function, *arguments))
        results = _lasting.bind(*leaves, function=function, rule=rule, tree=tree, axes=())
        return jax.tree.unflatten(result_tree, results)

    return call


def _flat(leaves: tuple, function: Callable, tree) -> list:
    return jax.tree.leaves(function(*jax.tree.unflatten(tree, leaves)))


def _mapped(function: Callable, axes: tuple) -> Callable:
    """Return a function of leaves under one vmap for each entry of axes, the innermost first."""
    for in_axes in axes:
        function = jax.vmap(function, in_axes=in_axes)
    return function


def _evaluate(
    *leaves: Array, function: Callable, rule: Callable, tree: object, axes: tuple
) -> list:
    del rule
    return _mapped(lambda *x: _flat(x, function, tree), axes)(*leaves)


def _abstract(*leaves: ShapedArray, **options: object) -> list:
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
    results = jax.eval_shape(partial(_evaluate, **options), *shapes)
    return [ShapedArray(x.shape, x.dtype) for x in results]


def _jvp(primals, tangents, *, function, rule, tree, axes):
    n = len(primals)
    moving = [i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero)]

    def one(*leaves):
        given = dict(zip(moving, leaves[n:], strict=True))
        dots = [
            given.get(i, SymbolicZero(jax.typeof(x).to_tangent_aval()))
            for i, x in enumerate(leaves[:n])
        ]
        unflatten = partial(jax.tree.unflatten, tree)
        result, result_dot = rule(unflatten(leaves[:n]), unflatten(dots))
        results = jax.tree.leaves(result)
        pairs = zip(results, jax.tree.leaves(result_dot), strict=True)
        return results, [dot for x, dot in pairs if _is_float(x)]

    with_tangents = tuple((*a, *(a[i] for i in moving)) for a in axes)
    arguments = (*primals, *(tangents[i] for i in moving))
    results, floats = _mapped(one, with_tangents)(*arguments)
    floats = iter(floats)
    dots = [next(floats) if _is_float(x) else _zero(x) for x in results]
    return results, dots


def _batch(leaves, axes_of_leaves, *, axes, **options):
    results = _lasting.bind(*leaves, axes=(*axes, tuple(axes_of_leaves)), **options)
    return results, [0] * len(results)


def _zero(x: Array) -> ad.Zero:
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _is_float(x: Array) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


_lasting.def_impl(
    jax.jit(_evaluate, static_argnames=("function", "rule", "tree", "axes")),
)
_lasting.def_abstract_eval(_abstract)
ad.primitive_jvps[_lasting] = _jvp
batching.primitive_batchers[_lasting] = _batch
mlir.register_lowering(_lasting, mlir.lower_fun(_evaluate, multiple_results=True))
