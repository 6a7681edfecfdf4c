"""How the contact problems of a motion ended."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import Solution


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactRecord:
    """How every contact problem of every step ended; T steps, P problems of a step, C pairs.

    Problem 0 is the contact at the end of the step. `ContactStabilized` has two problems: its
    predictor may be in weak contact while the pair is open at the end of the step.
    """

    multiplier: Array
    """Multiplier p of the VI, (T, P, C) [N s]; lam / 2 in the contact-implicit scheme."""

    gap: Array
    """Gap that the problem leaves, (T, P, C) [m]."""

    active: Array
    """Pairs with a closed gap, (T, P, C) bool: strong and weak contact."""

    weak: Array
    """Pairs in weak contact, (T, P, C) bool: closed without a force.

    Gap and force count as zero below the rounding of the problem, `complementarity.tolerance` in
    the folder contact.
    """

    @property
    def strong(self) -> Array:
        """Pairs in strong contact, (T, P, C) bool: closed under a force."""
        return self.active & ~self.weak


def record_of(dt: Array, solutions: tuple[Solution, ...]) -> ContactRecord:
    """Return how the contact problems of one step ended, (P, C) each."""
    return ContactRecord(
        multiplier=jnp.stack([x.multiplier for x in solutions]),
        gap=dt * jnp.stack([x.separation for x in solutions]),
        active=jnp.stack([x.active for x in solutions]),
        weak=jnp.stack([x.weak for x in solutions]),
    )


def worst_of(solutions: tuple[Solution, ...]) -> tuple[Array, Array, Array]:
    """Return most iterations, worst status and largest residual of the problems of a step."""
    return (
        jnp.max(jnp.stack([x.iterations for x in solutions])),
        jnp.max(jnp.stack([x.status for x in solutions])),
        jnp.max(jnp.stack([x.residual for x in solutions])),
    )
