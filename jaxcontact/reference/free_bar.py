"""P2: a free bar flies against a rigid wall and rebounds, no gravity.

The unstrained bar starts with its contact end x = 0 at the distance h0 from the wall and with the
velocity -v0: rho u_tt = E u_xx, u_x(L) = 0, h0 + u(0) >= 0, p = -E u_x(0) >= 0, p (h0 + u(0)) = 0.
From the impact at h0/v0 on, let q = c (t - h0/v0) in [0, 2L] be the way of the shock and
r = min(q, 2L - q) its place:

    u = -h0 - (v0/c) min(x, r),   u_t = 0 for x < r, -v0 (q < L) or v0 (q > L) for x > r,
    u_x = -v0/c for x < r,        p = v0 sqrt(E rho).

At q = 2L the bar leaves without strain at exactly +v0.

Source: Doyen, Ern, Piperno, SIAM J. Sci. Comput. 33 (2011), with d'Alembert's formula.
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
class FreeBar:
    """Free bar flying against a wall; valid for all times, one impact.

    x in [0, L] is the material coordinate with the contact end at 0, t any time; both broadcast.
    The displacement is measured from the initial configuration, so that the gap at the time t is
    gap + displacement(0, t). On the shock x = r velocity and strain take their values for x > r.
    """

    young: Number = 900.0
    """Young's modulus E, () [Pa]."""
    density: Number = 1.0
    """Mass density rho, () [kg/m^3]."""
    length: Number = 10.0
    """Length L, () [m]."""
    gap: Number = 5.0
    """Distance h0 >= 0 of the contact end from the wall at t = 0, () [m]."""
    impact_speed: Number = 10.0
    """Speed v0 > 0 towards the wall before the impact, () [m/s]; the velocity is -v0."""

    def wave_speed(self) -> Array:
        """Return c = sqrt(E/rho), () [m/s]."""
        return jnp.sqrt(self.young / self.density)

    def contact_interval(self) -> tuple[Array, Array]:
        """Return the contact from h0/v0 to h0/v0 + 2L/c, () and () [s]."""
        start = jnp.asarray(self.gap / self.impact_speed)
        return start, start + 2 * self.length / self.wave_speed()

    def displacement(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the displacement u from the initial configuration, shape of x and t [m]."""
        x, t = jnp.broadcast_arrays(x, t)
        start, end = self.contact_interval()
        flight = jnp.maximum(t - end, 0) - jnp.minimum(t, start)
        squeeze = jnp.minimum(x, self._shock(t)[1]) / self.wave_speed()
        return self.impact_speed * (flight - squeeze)

    def velocity(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the velocity u_t, shape of x and t [m/s]."""
        x, t = jnp.broadcast_arrays(x, t)
        way, place = self._shock(t)
        return self.impact_speed * jnp.where(x < place, 0, jnp.where(way < self.length, -1, 1))

    def strain(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the strain u_x, shape of x and t [-]."""
        x, t = jnp.broadcast_arrays(x, t)
        return jnp.where(x < self._shock(t)[1], -self.impact_speed / self.wave_speed(), 0)

    def stress(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the stress E u_x, shape of x and t [Pa]; minus the contact pressure at x = 0."""
        return self.young * self.strain(x, t)

    def contact_force(self, t: ArrayLike) -> Array:
        """Return the contact pressure v0 sqrt(E rho) on [start, end), else 0, shape of t [Pa]."""
        t = jnp.asarray(t)
        start, end = self.contact_interval()
        pressure = self.impact_speed * jnp.sqrt(self.young * self.density)
        return jnp.where((t >= start) & (t < end), pressure, 0)

    def contact_force_mean(self, t0: ArrayLike, t1: ArrayLike) -> Array:
        """Return the exact mean of the contact pressure over [t0, t1], shape of t0 < t1 [Pa]."""
        gained = self.accumulated_impulse(t1) - self.accumulated_impulse(t0)
        return gained / jnp.subtract(t1, t0)

    def accumulated_impulse(self, t: ArrayLike) -> Array:
        """Return the integral of the contact pressure over (-inf, t], shape of t [Pa s]."""
        return self.density * self.impact_speed * self._shock(jnp.asarray(t))[0]

    def impulse(self) -> Array:
        """Return the impulse 2 rho L v0 of the contact, () [Pa s]."""
        return jnp.asarray(2 * self.density * self.length * self.impact_speed)

    def rebound_velocity(self) -> Array:
        """Return the velocity +v0 with which every point leaves the wall, () [m/s]."""
        return jnp.asarray(self.impact_speed)

    def kinetic_energy(self, t: ArrayLike) -> Array:
        """Return the kinetic energy, shape of t [J/m^2]: rho v0^2/2 times the moving length."""
        moving = jnp.abs(self.length - self._shock(jnp.asarray(t))[0])
        return self.density * self.impact_speed**2 / 2 * moving

    def elastic_energy(self, t: ArrayLike) -> Array:
        """Return the elastic energy, shape of t [J/m^2]."""
        return self.energy() - self.kinetic_energy(t)

    def energy(self) -> Array:
        """Return the total energy rho L v0^2/2, conserved, () [J/m^2]."""
        return jnp.asarray(self.density * self.length * self.impact_speed**2 / 2)

    def _shock(self, t):
        """Way q in [0, 2L] and place r in [0, L] of the shock, shape of t [m]."""
        way = jnp.clip(self.wave_speed() * (t - self.contact_interval()[0]), 0, 2 * self.length)
        return way, jnp.minimum(way, 2 * self.length - way)
