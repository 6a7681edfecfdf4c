"""The trust-region subproblem by truncated conjugate gradients (Steihaug, Toint).

    minimise  m(s) = dJ.s + 1/2 s.Hs   over |s|_M <= radius

CG in the inner product M, i.e. preconditioned by M^-1, starting at zero. Its iterates grow in the
M-norm and lower the model, so the path that they form is cut where it leaves the trust region, or
followed to the boundary along a direction of negative curvature. The path for a smaller radius is
the beginning of the same path: `cut` costs no product with the Hessian.
Source: Nocedal, Wright, Numerical Optimization (2006), Algorithm 7.2; Conn, Gould, Toint,
Trust-Region Methods (2000), 7.5.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array


class Segment(NamedTuple):
    """One CG step s + a p, 0 <= a <= length."""

    direction: Array
    """p."""

    length: float
    """Largest a; infinite along a direction of negative curvature."""

    slope: float
    """m'(0) along p, negative."""

    curvature: float
    """p.Hp."""

    start_square: float
    """|s|_M^2."""

    start_dot: float
    """(s, p)_M."""

    direction_square: float
    """|p|_M^2."""

    def length_within(self, radius: float) -> float:
        """Return the largest a <= length with |s + a p|_M <= radius."""
        a, b, c = self.direction_square, self.start_dot, self.start_square - radius**2
        if c >= 0.0:
            return 0.0
        # The positive root of a x^2 + 2 b x + c, without cancellation.
        root = math.sqrt(b * b - a * c)
        return min(self.length, -c / (b + root) if b > 0.0 else (root - b) / a)


class Path(NamedTuple):
    """The piecewise linear path of the CG iterates."""

    segments: list[Segment]
    """In the order of the path."""

    @property
    def least_curvature(self) -> float:
        """The least p.Hp / |p|_M^2 of the path."""
        return min(x.curvature / x.direction_square for x in self.segments)

    def cut(self, radius: float) -> tuple[Array, float, bool]:
        """Return the end of the path in the ball, the model decrease, and if the ball cut it."""
        step, decrease = jnp.zeros_like(self.segments[0].direction), 0.0
        for segment in self.segments:
            length = segment.length_within(radius)
            step = step + length * segment.direction
            decrease -= length * segment.slope + 0.5 * length**2 * segment.curvature
            if length < segment.length:
                return step, decrease, True
        return step, decrease, False


def conjugate_gradient_path(
    derivative: Array,
    hessian_product: Callable[[Array], Array],
    riesz: Callable[[Array], Array],
    *,
    radius: float,
    tolerance: float,
    max_products: int,
) -> Path:
    """Run CG until it leaves the ball, meets negative curvature or is accurate.

    Args:
        derivative: dJ, a covector; not zero.
        hessian_product: maps a vector to the covector H p; symmetric, perhaps indefinite.
        riesz: maps a covector to the vector that represents it, M^-1. A restriction to a
            subspace belongs here and nowhere else.
        radius: radius of the trust region in the M-norm.
        tolerance: stop when the residual in the dual norm is below this times the first one.
        max_products: most products with the Hessian.

    Returns:
        The path, with at least one segment.
    """
    residual = derivative
    representative = riesz(residual)
    direction = -representative
    square = first_square = float(jnp.vdot(residual, representative))
    start_square, start_dot, direction_square = 0.0, 0.0, square
    segments = []
    for _ in range(max_products):
        product = hessian_product(direction)
        curvature = float(jnp.vdot(direction, product))
        # A product that is not finite counts as negative curvature: the step is then judged by
        # the value of the objective alone.
        curvature = curvature if math.isfinite(curvature) else 0.0
        length = square / curvature if curvature > 0.0 else math.inf
        segment = Segment(
            direction, length, -square, curvature, start_square, start_dot, direction_square
        )
        segments.append(segment)
        if segment.length_within(radius) < length:
            break
        residual = residual + length * product
        representative = riesz(residual)
        new_square = float(jnp.vdot(residual, representative))
        if new_square <= tolerance**2 * first_square:
            break
        ratio = new_square / square
        # Recurrences of the M-norms, which need no product with M.
        start_square += 2.0 * length * start_dot + length**2 * direction_square
        start_dot = ratio * (start_dot + length * direction_square)
        direction_square = new_square + ratio**2 * direction_square
        direction = ratio * direction - representative
        square = new_square
    return Path(segments)
