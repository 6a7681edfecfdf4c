"""Exchange of the nodes of one kind in a pytree."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax

Tree = TypeVar("Tree")
Node = TypeVar("Node")


def exchange(tree: Tree, kind: type[Node], change: Callable[[Node], Node]) -> Tree:
    """Return a pytree in which every node of a kind is replaced by what `change` makes of it.

    Raises:
        ValueError: if there is none.
    """
    found = []

    def replace(node: object) -> object:
        if not isinstance(node, kind):
            return node
        found.append(node)
        return change(node)

    changed = jax.tree.map(replace, tree, is_leaf=lambda node: isinstance(node, kind))
    if not found:
        name = kind.__name__.lower()
        raise ValueError(
            f"there is no {name} in this pytree; hand over a bound method of a pytree that holds "
            f"the {name}, such as problem.objective, or jax.tree_util.Partial(function, {name})"
        )
    return changed
