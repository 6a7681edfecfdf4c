"""How the time loop passes a treatment of weak contact on to the contact problems of its steps.

For `AlongDirection` a step is made together with its one-sided derivative (dy, dv) along the given
direction. That derivative decides each weak pair and is a constant for the gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcontact.contact.vi import ContactProblem
from jaxcontact.contact.weak import AlongDirection, OnBranch, WeakContact


def with_weak_contact(operators: Any, choice: WeakContact | AlongDirection) -> Any:
    """Return the operators of a scheme with another treatment of weak contact."""
    if isinstance(choice, AlongDirection):
        choice = OnBranch()

    def is_problem(leaf: Any) -> bool:
        return isinstance(leaf, ContactProblem)

    return jax.tree.map(
        lambda leaf: replace(leaf, weak_contact=choice) if is_problem(leaf) else leaf,
        operators,
        is_leaf=is_problem,
    )


def check_weak_contact(choice: Any) -> None:
    """Raise a ValueError if the choice is a class or a string instead of an object."""
    if isinstance(choice, type | str):
        raise ValueError(f"weak_contact must be an object, such as jc.Strong(), got {choice!r}")


@contextmanager
def forward_mode_advice() -> Iterator[None]:
    """Say how forward mode is had where JAX only says that a custom_vjp has none."""
    try:
        yield
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
        raise TypeError(
            "simulate has reverse mode only, as jax.grad uses it, unless weak_contact names what "
            "forward mode means at weak contact: simulate(..., weak_contact=jc.Strong()), the "
            "derivative that jax.grad takes, or jc.CriticalCone(), the exact one-sided one; "
            "see also jc.directional_derivative"
        ) from error


def along_direction(advance: Callable[[Any, Any], tuple[Any, Any]]) -> Callable:
    """Return the step ((state, state_dot), (input, input_dot)) -> ((state, state_dot), record).

    Args:
        advance: one step, (state, input) -> (state, record).
    """

    def advance_both(states: tuple[Any, Any], inputs: tuple[Any, Any]) -> tuple[Any, Any]:
        (state, state_dot), (force, force_dot) = states, inputs
        tangents = tangent_of(state, state_dot), tangent_of(force, force_dot)
        (state, record), (state_dot, _) = jax.jvp(advance, (state, force), tangents)
        return (state, jax.lax.stop_gradient(float_leaves(state, state_dot))), record

    return advance_both


def float_leaves(primal: Any, tangent: Any) -> list:
    """Return the tangents of the floating point leaves: what a scan can carry."""
    pairs = zip(jax.tree.leaves(primal), jax.tree.leaves(tangent), strict=True)
    return [t for x, t in pairs if jnp.issubdtype(jnp.result_type(x), jnp.floating)]


def tangent_of(primal: Any, tangents: Any) -> Any:
    """Return the tangent of a pytree from those of its floating point leaves; None is zero."""
    leaves, structure = jax.tree.flatten(primal)
    given = iter([None] * len(leaves) if tangents is None else jax.tree.leaves(tangents))

    def tangent(x: Any) -> Any:
        if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
            return np.zeros(jnp.shape(x), jax.dtypes.float0)
        value = next(given, None)
        return jnp.zeros_like(x) if value is None else value

    return jax.tree.unflatten(structure, [tangent(x) for x in leaves])
