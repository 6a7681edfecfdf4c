"""Bound methods as pytrees, and the nodes of one kind in a pytree: found and exchanged."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import jax
from jax.tree_util import Partial

#: Any nesting of arrays that JAX takes apart.
PyTree: TypeAlias = Any

Tree = TypeVar("Tree")
Node = TypeVar("Node")


def as_partial(tree: Tree) -> Tree | Partial:
    """Return a bound method of a pytree as `Partial`, which has its leaves; else the tree."""
    if inspect.ismethod(tree) and not jax.tree_util.all_leaves([tree.__self__]):
        return Partial(tree.__func__, tree.__self__)
    return tree


def exchange(tree: Tree, kind: type[Node], change: Callable[[Node], Node]) -> Tree:
    """Return a pytree in which every node of a kind is replaced by what `change` makes of it.

    A bound method of a pytree counts as one, see `as_partial`.

    Raises:
        ValueError: if there is none.
    """
    found = []

    def replace(node: object) -> object:
        if not isinstance(node, kind):
            return node
        found.append(node)
        return change(node)

    changed = jax.tree.map(replace, as_partial(tree), is_leaf=lambda node: isinstance(node, kind))
    if not found:
        name = kind.__name__.lower()
        raise ValueError(
            f"there is no {name} in this pytree; hand over a bound method of a pytree that holds "
            f"the {name}, such as problem.objective, or jax.tree_util.Partial(function, {name})"
        )
    return changed


def nodes(tree: object, kind: type[Node]) -> list[Node]:
    """Return every node of a kind in a pytree or a bound method of one."""
    leaves = jax.tree.leaves(as_partial(tree), is_leaf=lambda node: isinstance(node, kind))
    return [leaf for leaf in leaves if isinstance(leaf, kind)]
