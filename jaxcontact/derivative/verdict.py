"""What Taylor remainders say of a gradient: the verdict is the advice."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

#: Orders that count as second order.
SECOND_ORDER = 1.8

#: A relative error of J' that rounding may hide before the check is undecided.
COARSEST = 1e-2


class Verdict(StrEnum):
    """What the remainders say of a gradient; the value is the advice."""

    RIGHT = "RIGHT: second order on both sides along every direction"
    CONSTANT = "CONSTANT: J does not change, and its gradient is zero"
    ONE_SIDED = (
        "ONE-SIDED: the objective has a kink here; the gradient is the exact derivative on one "
        "side of it"
    )
    KINK = (
        "KINK: the objective has different one-sided derivatives here, and along some direction "
        "the gradient is neither of them; give trajectory= to see whether a contact is weak"
    )
    KINK_OF_CONTACT = (
        "KINK: the objective has different one-sided derivatives here, and along some direction "
        "the gradient is neither of them; choose weak_contact=AlongDirection(...)"
    )
    KINK_OF_COST = (
        "KINK: the objective has different one-sided derivatives here, and along some direction "
        "the gradient is neither of them; no contact is weak, so the kink is in the cost, or a "
        "contact closer than the steps"
    )
    WRONG = (
        "WRONG: first order on both sides although the one-sided quotients agree; a gradient that "
        "misses a dependence looks like this"
    )
    JUMP = "JUMP: the objective does not tend to J(u) here: no derivative"
    UNDECIDED = (
        "UNDECIDED: J does not change beyond its rounding; take a larger step, float64, or J "
        "without its constant part"
    )
    VALUE_NOT_FINITE = "NOT FINITE: the objective is not finite at u; see Trajectory.status"
    GRADIENT_NOT_FINITE = "NOT FINITE: the objective is finite at u, its gradient is not"
    NEIGHBOUR_NOT_FINITE = "NOT FINITE: the objective is not finite near u; see Trajectory.status"


def verdict_of_orders(
    order: np.ndarray,
    resolution: np.ndarray,
    quotients: tuple[np.ndarray, np.ndarray],
    noise: float,
    weak: int | None,
) -> Verdict:
    """Return what orders (D, 2), resolution (D,) and one-sided quotients (D,) say."""
    if np.any(np.isnan(order)):
        return Verdict.NEIGHBOUR_NOT_FINITE
    is_second = order >= SECOND_ORDER
    if np.all(np.isinf(order)) and np.min(resolution) > COARSEST:
        return Verdict.UNDECIDED
    if np.all(is_second):
        return Verdict.RIGHT
    right, left = quotients
    is_kink = np.abs(right - left) > 1e-3 * np.maximum(np.abs(right), np.abs(left)) + 4.0 * noise
    wrong = ~is_second.any(axis=1)
    if np.any(wrong & ~is_kink):
        return Verdict.WRONG
    if not np.any(wrong):
        return Verdict.ONE_SIDED
    if weak is None:
        return Verdict.KINK
    return Verdict.KINK_OF_CONTACT if weak else Verdict.KINK_OF_COST
