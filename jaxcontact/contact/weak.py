"""Weak contact, the gap and the impulse of a pair both zero: which derivative is meant there.

A motion with weak contact W is not differentiable. Its directional derivative solves a variational
inequality on the critical cone,

    (N dw - db)_i = 0 on the strong pairs S,    0 <= dp_i  _|_  (N dw - db)_i <= 0 on W,

and every linear derivative keeps equality on a set between S and S + W. The objects below choose
it. They differ at weak contact only. Source: paper, Theorem 4.20 and section 4.5; MATH.md 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import jax
from jax import Array

from jaxcontact.contact.complementarity import Solution


@runtime_checkable
class WeakContact(Protocol):
    """What the derivative of a step means at weak contact: static, hashable, without arrays."""

    is_linear: ClassVar[bool]
    """Whether the derivative is linear in the direction, so that it has a transpose."""

    def equality_set(self, solution: Solution) -> Array:
        """Return the pairs on which a linear derivative keeps contact, (C,) bool."""
        ...


@jax.tree_util.register_static
@dataclass(frozen=True)
class ClosedBranch:
    """Weak contact counts as closed: Algorithm 1 of the paper, and the default.

    Exact along directions that press weak pairs together.
    """

    is_linear: ClassVar[bool] = True

    def equality_set(self, solution: Solution) -> Array:
        """Return all pairs with a closed gap, (C,) bool."""
        return solution.active


@jax.tree_util.register_static
@dataclass(frozen=True)
class OpenBranch:
    """Weak contact counts as open.

    Exact along directions that take weak pairs apart.
    """

    is_linear: ClassVar[bool] = True

    def equality_set(self, solution: Solution) -> Array:
        """Return the pairs that are pressed, (C,) bool."""
        return solution.active & (solution.multiplier > 0.0)


@jax.tree_util.register_static
@dataclass(frozen=True)
class CriticalCone:
    """The exact one-sided derivative, along every direction: not linear, so forward mode only.

    `jax.jvp` and `jax.jacfwd` work; `jax.grad` raises a TypeError.
    """

    is_linear: ClassVar[bool] = False

    def equality_set(self, solution: Solution) -> Array:
        """Return the pairs with a closed gap, (C,) bool: where the cone has constraints."""
        return solution.active


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AlongDirection:
    """The gradient of the branch that the motion takes along a given direction.

    Weak pairs that the direction keeps in contact (dp > 0) count as closed, the others as open.
    The gradient g is linear, and g . direction is the exact one-sided derivative.
    """

    control: Array | None = None
    """Direction of the control, (T, N, d) [N/m^d]; None is zero."""

    initial: object = None
    """Direction of the initial state, a `State`; None is zero."""
