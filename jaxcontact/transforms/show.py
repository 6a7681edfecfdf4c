"""How the objects of the package show themselves: in one line, and as a table in a notebook."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np
from jax import Array

Node = TypeVar("Node")


def shown_by(
    facts: Callable[[Node], Mapping[str, object]],
) -> tuple[Any, Any]:
    """Return `__repr__` and `_repr_html_` of a class, made of what is worth to know by name.

    Args:
        facts: maps an object to its facts; "", None and an empty mapping are left out.
    """

    def one_line(node: Node) -> str:
        inside = ", ".join(f"{name}={_text(value)}" for name, value in _facts_of(node, facts))
        return f"{type(node).__name__}({inside})"

    def table(node: Node) -> str:
        rows = "".join(
            f"<tr><td>{html.escape(name.replace('_', ' '))}</td>"
            f"<td>{html.escape(_text(value))}</td></tr>"
            for name, value in _facts_of(node, facts)
        )
        return f"<table><caption>{type(node).__name__}</caption>{rows}</table>"

    return one_line, table


def _facts_of(node: Node, facts: Callable[[Node], Mapping[str, object]]) -> list:
    # JAX puts markers in the place of arrays where it handles trees without values.
    arrays = (Array, np.ndarray, np.generic, bool, int, float, jax.ShapeDtypeStruct)
    if not all(leaf is node or isinstance(leaf, arrays) for leaf in jax.tree.leaves(node)):
        return [("leaves", "no arrays")]
    return [(name, value) for name, value in facts(node).items() if value not in ("", {}, None)]


def _text(value: object) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {_text(x)}" for name, x in value.items()) + "}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
