"""The check of every option: a choice is an object with the methods of its protocol."""

from __future__ import annotations

import sys
import textwrap

import numpy as np

#: Longest text of a wrong value that a message quotes.
MAX_QUOTE = 80


def is_positive_number(value: object) -> bool:
    """Return whether a concrete value is one positive, finite number."""
    number = np.asarray(value)
    return number.shape == () and number.dtype.kind in "iuf" and bool(0.0 < number < np.inf)


def check_kind(call: str, value: object, kind: type, made_by: str) -> None:
    """Raise a ValueError if the first argument of a call is not what an earlier call makes.

    Args:
        call: the name of the call, for instance "prepare".
        value: what the user handed over.
        kind: what it should be.
        made_by: the line that makes it, for instance "jc.discretize(scene)".
    """
    if not isinstance(value, kind):
        raise ValueError(
            f"{call} takes a {kind.__name__}, got a {type(value).__name__}; first write {made_by}"
        )


def check_option(name: str, value: object, protocol: type | tuple[type, ...], example: str) -> None:
    """Raise a ValueError if an option is not an object with what its protocol asks for.

    Args:
        name: name of the keyword that the user wrote.
        value: what the user handed over.
        protocol: a runtime-checkable protocol or a class, or several of which one must fit.
        example: an object that the user can write instead, without the prefix jc.; for instance
            "ContactImplicit()".

    Raises:
        ValueError: if the value is a class, a string, or lacks a member of the protocol.
    """
    if isinstance(value, type):
        example = f"jc.{example}"
        if isinstance(value, protocol):  # a class has the methods of its objects
            package = sys.modules[__name__.split(".")[0]]
            is_public = getattr(package, value.__name__, None) is value
            example = f"{'jc.' if is_public else ''}{value.__name__}()"
        raise ValueError(
            f"{name} must be an object, such as {example}, got the class {value.__name__}"
        )
    if isinstance(value, str) or not isinstance(value, protocol):
        quote = textwrap.shorten(repr(value), MAX_QUOTE, placeholder=" ...")
        raise ValueError(f"{name} must be an object, such as jc.{example}, got {quote}")
