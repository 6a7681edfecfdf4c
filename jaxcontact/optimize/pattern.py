"""Which pairs are closed, open and weak in every step, how to find out, and how it changes.

Source: MATH.md 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jax import Array

from jaxcontact.contact import RelaxedContact
from jaxcontact.control.problem import Problem
from jaxcontact.motion.stepper import with_contact
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.optimize.certificate import run


class Pattern(NamedTuple):
    """The contact of a motion: T steps, P contact problems of a step, C pairs."""

    strong: np.ndarray
    """Closed pairs, (T, P, C) bool."""

    weak: np.ndarray
    """Pairs whose gap is held at zero without an impulse, (T, P, C) bool; none of them strong."""

    def key(self) -> bytes:
        """Return what tells one pattern from another."""
        return np.packbits(self.strong).tobytes() + np.packbits(self.weak).tobytes()


class Signs(NamedTuple):
    """By how much every pair has the wrong sign, (T, P, C), and what it becomes; 0 is right."""

    to_open: np.ndarray
    weak_to_strong: np.ndarray
    strong_to_weak: np.ndarray
    open_to_weak: np.ndarray

    @property
    def count(self) -> int:
        """Number of pairs with a wrong sign."""
        return int(sum(np.sum(part > 0.0) for part in self))


def pivoted(pattern: Pattern, signs: Signs) -> Pattern:
    """Return the pattern with every pair moved whose sign is wrong."""
    to_open, to_strong, strong_to_weak, open_to_weak = (part > 0.0 for part in signs)
    strong = (pattern.strong & ~strong_to_weak) | to_strong
    weak = (pattern.weak & ~to_open & ~to_strong) | strong_to_weak | open_to_weak
    return Pattern(strong, weak)


def worst_alone(signs: Signs) -> Signs:
    """Return the signs with the worst pair alone: each kind has its own unit, so of the first."""
    kind = int(np.argmax([np.sum(part > 0.0) > 0 for part in signs]))
    worst = np.unravel_index(np.argmax(signs[kind]), signs[kind].shape)
    alone = [np.zeros_like(part) for part in signs]
    alone[kind][worst] = signs[kind][worst]
    return Signs(*alone)


def identify(
    problem: Problem,
    motion: Callable[[Array], Trajectory],
    levels: tuple[tuple[float, Array], tuple[float, Array]],
    band: tuple[float, float] = (0.35, 0.65),
) -> Pattern:
    """Return the pattern that the gaps of two relaxed minimisers tend to.

    A gap tends to zero like kappa^e: e = 0 of an open pair, 1 of a strong one, 1/2 of a weak one,
    whose gap and impulse vanish alike.

    Args:
        problem: for its control map.
        motion: maps a control to its trajectory; a pytree that holds the stepper.
        levels: kappa and parameters of two minimisers in relaxed contact.
        band: exponents that count as weak.
    """
    gaps = []
    for kappa, parameters in levels:
        relaxed = with_contact(motion, RelaxedContact(kappa))
        gaps.append(np.asarray(run(relaxed, problem.controls, parameters).contact.gap))
        problem.counts.motions += 1
    first, second = (np.log(np.maximum(gap, np.finfo(gap.dtype).tiny)) for gap in gaps)
    exponent = (first - second) / math.log(levels[0][0] / levels[1][0])
    return Pattern(exponent >= band[1], (exponent > band[0]) & (exponent < band[1]))
