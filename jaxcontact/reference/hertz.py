"""Hertz contact of an elastic cylinder pressed on a rigid frictionless plane, static, plane strain.

With the load P per axial length, radius R and E* = E/(1 - nu^2):

    a = sqrt(4 P R / (pi E*)),   p0 = 2 P / (pi a),   p(x) = p0 sqrt(1 - x^2/a^2) for |x| <= a.

Source: K. L. Johnson, Contact Mechanics, Cambridge University Press (1985), section 4.2(c).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

Number = float | Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Hertz:
    """Cylinder on a rigid plane; valid while the half width is small against the radius."""

    young: Number
    """Young's modulus E, () [Pa]."""
    poisson: Number
    """Poisson's ratio nu in (-1, 1/2), () [-]."""
    radius: Number
    """Radius R of the cylinder, () [m]."""
    load: Number
    """Normal load P > 0 per axial length, () [N/m]; positive presses the bodies together."""

    @classmethod
    def from_half_width(
        cls,
        half_width: Number,
        *,
        young: Number,
        poisson: Number,
        radius: Number,
    ) -> Hertz:
        """Return the contact of half width a, () [m]: P = pi E a^2 / (4 R (1 - nu^2))."""
        load = jnp.pi * young * half_width**2 / (4 * radius * (1 - poisson**2))
        return cls(young=young, poisson=poisson, radius=radius, load=load)

    def half_width(self) -> Array:
        """Return the half width a of the contact zone, () [m]."""
        compliance = 4 * self.radius * (1 - self.poisson**2) / (jnp.pi * self.young)
        return jnp.sqrt(self.load * compliance)

    def peak_pressure(self) -> Array:
        """Return the pressure p0 in the middle of the contact zone, () [Pa]."""
        return 2 * self.load / (jnp.pi * self.half_width())

    def mean_pressure(self) -> Array:
        """Return the mean pressure P/(2a) = pi p0/4 over the contact zone, () [Pa]."""
        return self.load / (2 * self.half_width())

    def pressure(self, x: ArrayLike) -> Array:
        """Return the contact pressure at distance x from the middle, shape of x [Pa].

        Derivative: zero for |x| >= a; at |x| = a only the outer one exists.
        """
        depth = 1 - (jnp.asarray(x) / self.half_width()) ** 2
        inside = depth > 0
        return self.peak_pressure() * jnp.where(inside, jnp.sqrt(jnp.where(inside, depth, 1)), 0)
