"""P1: a prestrained bar, clamped at its far end, released against a wall.

Wall at x = 0, clamp at x = L, u measured from the unstrained bar, which just touches the wall:
rho u_tt = E u_xx,  u(0) >= 0,  p = -E u_x(0) >= 0,  p u(0) = 0,  u(L) = 0,  u(x, 0) = a (1 - x/L).
With T0 = L/c the bar is released during [0, T0), presses on the wall during [T0, 2 T0), flies
during [2 T0, 3 T0) and repeats. By d'Alembert u = F(ct - x) - F(ct + x - 2L) with F' = (a/2L) times
-1, 1, 1 in the three phases.

Source: the bar of Chouly, Hild, Renard, ESAIM M2AN 49 (2015) and of Dabaghi, Petrov, Pousin,
Renard (2014), rewritten in characteristics.
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
class ClampedBar:
    """Prestrained bar with a clamped far end; valid for all times, period 3 L/c.

    x is in [0, L], t any time; both broadcast. Velocity and strain jump across the characteristics
    and take the mean of both sides there, so that velocity(x, 0) is zero everywhere.
    """

    young: Number = 1.0
    """Young's modulus E, () [Pa]."""
    density: Number = 1.0
    """Mass density rho, () [kg/m^3]."""
    length: Number = 1.0
    """Length L, () [m]."""
    amplitude: Number = 0.5
    """Initial displacement a of the contact end, () [m]; positive away from the wall."""

    def wave_speed(self) -> Array:
        """Return c = sqrt(E/rho), () [m/s]."""
        return jnp.sqrt(self.young / self.density)

    def period(self) -> Array:
        """Return the period 3 L/c of the motion, () [s]."""
        return 3 * self.length / self.wave_speed()

    def contact_interval(self) -> tuple[Array, Array]:
        """Return the first contact (L/c, 2 L/c), () and () [s]; it repeats with the period."""
        return self.period() / 3, 2 * self.period() / 3

    def displacement(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the displacement from the unstrained bar, shape of x and t [m]; gap at x = 0."""
        left, right = self._characteristics(x, t)
        return self.amplitude / 2 * (_wave(left) - _wave(right))

    def velocity(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the velocity u_t, shape of x and t [m/s]."""
        left, right = self._characteristics(x, t)
        speed = self.amplitude * self.wave_speed() / self.length
        return speed / 2 * (_slope(left) - _slope(right))

    def strain(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the strain u_x, shape of x and t [-]."""
        left, right = self._characteristics(x, t)
        return -self.amplitude / (2 * self.length) * (_slope(left) + _slope(right))

    def stress(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the stress E u_x, shape of x and t [Pa]; minus the contact pressure at x = 0."""
        return self.young * self.strain(x, t)

    def contact_force(self, t: ArrayLike) -> Array:
        """Return the contact pressure p = E a/L during contact, else 0, shape of t [Pa]."""
        phase = jnp.mod(self._phase(t), 3)
        return jnp.where((phase >= 1) & (phase < 2), self.young * self.amplitude / self.length, 0)

    def contact_force_mean(self, t0: ArrayLike, t1: ArrayLike) -> Array:
        """Return the exact mean of the contact pressure over [t0, t1], shape of t0 < t1 [Pa]."""
        gained = self.accumulated_impulse(t1) - self.accumulated_impulse(t0)
        return gained / jnp.subtract(t1, t0)

    def accumulated_impulse(self, t: ArrayLike) -> Array:
        """Return the integral of the contact pressure over [0, t], shape of t [Pa s]."""
        phase = self._phase(t)
        contacts = jnp.floor(phase / 3) + jnp.clip(jnp.mod(phase, 3) - 1, 0, 1)
        return self.impulse() * contacts

    def impulse(self) -> Array:
        """Return the impulse a sqrt(E rho) of one contact, () [Pa s]."""
        return self.amplitude * jnp.sqrt(self.young * self.density)

    def kinetic_energy(self, t: ArrayLike) -> Array:
        """Return the kinetic energy, shape of t [J/m^2]: energy() times the moving fraction."""
        phase = jnp.mod(self._phase(t), 3)
        s = jnp.mod(phase, 1)
        moving = jnp.where(phase < 1, s, jnp.where(phase < 2, jnp.abs(1 - 2 * s), 1 - s))
        return self.energy() * moving

    def elastic_energy(self, t: ArrayLike) -> Array:
        """Return the elastic energy, shape of t [J/m^2]."""
        return self.energy() - self.kinetic_energy(t)

    def energy(self) -> Array:
        """Return the total energy E a^2/(2L), conserved, () [J/m^2]."""
        return jnp.asarray(self.young * self.amplitude**2 / (2 * self.length))

    def _phase(self, t):
        return jnp.asarray(t) * self.wave_speed() / self.length

    def _characteristics(self, x, t):
        x, t = jnp.broadcast_arrays(x, t)
        return self._phase(t) - x / self.length, self._phase(t) + x / self.length - 2


def _wave(r):
    """Primitive of `_slope` that vanishes at 0; it gains 1 per period of 3."""
    return jnp.abs(jnp.mod(r, 3) - 1) - 1 + jnp.floor(r / 3)


def _slope(r):
    """3-periodic: -1 on (0, 1), 1 on (1, 3), 0 on the jumps."""
    phase = jnp.mod(r, 3)
    return jnp.where(phase == 0, 0, jnp.sign(phase - 1))
