"""P3: a free bar falls on a floor under gravity and rebounds.

The unstrained bar starts at rest with its contact end x = 0 at the height h0:
rho u_tt = E u_xx - rho g,  u_x(L) = 0,  h0 + u(0) >= 0,  p = -E u_x(0) >= 0,  p (h0 + u(0)) = 0.
With v0 = sqrt(2 g h0):

- fall, 0 <= t < v0/g: rigid, u = -g t^2/2;
- contact, s = t - v0/g in [0, 2L/c), q = c s, r = min(q, 2L - q): a shock at x = r as in `FreeBar`,
  p = v0 sqrt(E rho) + rho g c s;
- flight, s = t - v0/g - 2L/c >= 0: u = -h0 + v0 s - g s^2/2 + [phi(x + cs) + phi(x - cs)]/2 with
  phi(x) = -(2g/c^2)(L x - x^2/2), even and 2L-periodic: every point leaves with v0 and then
  oscillates. It separates iff v0 >= 2 g L/c, and the next impact is a root of a quadratic.

If 2 v0/g is a multiple of 2L/c, the next impact is the time reverse of the first one and the
motion is periodic.

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
class FallingBar:
    """Free bar falling on a floor, valid for 0 <= t <= next_impact(); all times if is_periodic().

    Elsewhere every function of the time is NaN. If v0 < 2 g L/c, the bar does not separate at the
    end of the first contact and the solution ends there.

    x in [0, L] is the material coordinate with the contact end at 0; x and t broadcast. The
    displacement is measured from the initial configuration: the gap at time t is
    gap + displacement(0, t). On a wave front x = r velocity and strain take their values for x > r.

    Derivative: with respect to the fields up to next_impact(); beyond it NaN, because a change of
    a field destroys the periodicity. One such time in an array makes the reverse-mode derivative
    NaN as a whole: differentiate at valid times only.

    The defaults are periodic with p from 300 to 500 Pa and back.
    """

    young: Number = 900.0
    """Young's modulus E, () [Pa]."""
    density: Number = 1.0
    """Mass density rho, () [kg/m^3]."""
    length: Number = 10.0
    """Length L, () [m]."""
    gap: Number = 5.0
    """Height h0 > 0 of the contact end above the floor at t = 0, () [m]."""
    gravity: Number = 10.0
    """Gravity g > 0, () [m/s^2]; acts downwards."""

    def wave_speed(self) -> Array:
        """Return c = sqrt(E/rho), () [m/s]."""
        return jnp.sqrt(self.young / self.density)

    def contact_interval(self) -> tuple[Array, Array]:
        """Return start v0/g and end v0/g + 2L/c of the first contact, () and () [s]."""
        start = self.rebound_velocity() / self.gravity
        return start, start + self._crossing()

    def next_impact(self) -> Array:
        """Return the time at which the bar touches the floor again, () [s].

        The end of the first contact if the bar does not separate there. Derivative: one-sided
        where is_periodic(), because a wave front arrives together with the floor.
        """
        return self.contact_interval()[1] + self._flight_time()

    def is_periodic(self) -> Array:
        """Return whether it separates and 2 v0/g is a multiple of 2L/c up to rounding, () bool."""
        hops = 2 * self.rebound_velocity() / (self.gravity * self._crossing())
        is_whole = jnp.abs(hops - jnp.round(hops)) <= 16 * jnp.finfo(hops.dtype).eps * hops
        return is_whole & (jnp.round(hops) >= 2)

    def period(self) -> Array:
        """Return the period 4 v0/g + 4L/c of the motion, () [s]; NaN if it is not periodic."""
        return self._cycle() * jnp.where(self.is_periodic(), 1, jnp.nan)

    def displacement(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the displacement u from the initial configuration, shape of x and t [m]."""
        x, t = jnp.broadcast_arrays(x, t)
        t, sign = self._fold(t)
        L, c, g, v0 = self.length, self.wave_speed(), self.gravity, self.rebound_velocity()
        s, q, r = self._contact_wave(t)
        m, M = jnp.minimum(x, r), jnp.maximum(x, r)
        returning = jnp.where(q > L, (M - L) ** 2 - (r - L) ** 2, 0)
        contact = -v0 * m / c + (m**2 / 2 - q * m + returning) * g / c**2
        fall = -g * jnp.clip(t, None, self.contact_interval()[0]) ** 2 / 2
        s, _, r = self._flight_wave(t)
        M = jnp.maximum(x, r)
        flight = v0 * s - g * s**2 / 2 - (2 * L * M - x**2 - r**2) * g / c**2
        return sign**2 * (fall + jnp.where(s < 0, contact, flight))

    def velocity(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the velocity u_t, shape of x and t [m/s]."""
        x, t = jnp.broadcast_arrays(x, t)
        t, sign = self._fold(t)
        L, c, g, v0 = self.length, self.wave_speed(), self.gravity, self.rebound_velocity()
        _, q, r = self._contact_wave(t)
        contact = jnp.where(x < r, 0, jnp.where(q < L, -v0, v0)) - g / c * jnp.minimum(x, r)
        s, direction, r = self._flight_wave(t)
        flight = v0 - g * s - 2 * g / c * direction * (jnp.where(x < r, L, 0) - r)
        later = jnp.where(s < 0, contact, flight)
        return sign * jnp.where(t < self.contact_interval()[0], -g * t, later)

    def strain(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the strain u_x, shape of x and t [-]."""
        x, t = jnp.broadcast_arrays(x, t)
        t, sign = self._fold(t)
        L, c, g, v0 = self.length, self.wave_speed(), self.gravity, self.rebound_velocity()
        _, q, r = self._contact_wave(t)
        returning = jnp.where(q > L, 2 * (x - L) * g / c**2, 0)
        contact = jnp.where(x < r, -v0 / c + (x - q) * g / c**2, returning)
        s, _, r = self._flight_wave(t)
        flight = 2 * (x - jnp.where(x < r, 0, L)) * g / c**2
        return sign**2 * jnp.where(s < 0, contact, flight)

    def mean_displacement(self, t: ArrayLike) -> Array:
        """Return the displacement of the centre of mass, shape of t [m]."""
        t, sign = self._fold(jnp.asarray(t))
        L, c, g, v0 = self.length, self.wave_speed(), self.gravity, self.rebound_velocity()
        fall = -g * jnp.clip(t, None, self.contact_interval()[0]) ** 2 / 2
        s, _, _ = self._contact_wave(t)
        contact = -v0 * s - g * s**2 / 2 + (v0 * s**2 / 2 + g * s**3 / 6) * c / L
        s, _, _ = self._flight_wave(t)
        flight = v0 * s - g * s**2 / 2 - 2 * g * L**2 / (3 * c**2)
        return sign**2 * (fall + jnp.where(s < 0, contact, flight))

    def stress(self, x: ArrayLike, t: ArrayLike) -> Array:
        """Return the stress E u_x, shape of x and t [Pa]; minus the contact pressure at x = 0."""
        return self.young * self.strain(x, t)

    def contact_force(self, t: ArrayLike) -> Array:
        """Return the contact pressure on [start, end), else 0, shape of t [Pa]."""
        t, sign = self._fold(jnp.asarray(t))
        start, end = self.contact_interval()
        first, slope = self._pressure()
        return sign**2 * jnp.where((t >= start) & (t < end), first + slope * (t - start), 0)

    def contact_force_mean(self, t0: ArrayLike, t1: ArrayLike) -> Array:
        """Return the exact mean of the contact pressure over [t0, t1], shape of t0 < t1 [Pa]."""
        gained = self.accumulated_impulse(t1) - self.accumulated_impulse(t0)
        return gained / jnp.subtract(t1, t0)

    def accumulated_impulse(self, t: ArrayLike) -> Array:
        """Return the integral of the contact pressure over [0, t], shape of t [Pa s]."""
        t = jnp.asarray(t)
        folded, sign = self._fold(t)
        s, _, _ = self._contact_wave(folded)
        first, slope = self._pressure()
        cycles = jnp.round((t - sign * folded) / self._cycle())
        return 2 * cycles * self.impulse() + sign * (first * s + slope * s**2 / 2)

    def impulse(self) -> Array:
        """Return the impulse 2 rho L (v0 + g L/c) of one contact, () [Pa s]."""
        speed = self.rebound_velocity() + self.gravity * self.length / self.wave_speed()
        return 2 * self.density * self.length * speed

    def rebound_velocity(self) -> Array:
        """Return v0 = sqrt(2 g h0), with which every point leaves the floor, () [m/s]."""
        return jnp.sqrt(2 * self.gravity * self.gap)

    def kinetic_energy(self, t: ArrayLike) -> Array:
        """Return the kinetic energy, shape of t [J/m^2]."""
        t, sign = self._fold(jnp.asarray(t))
        L, c, g, v0 = self.length, self.wave_speed(), self.gravity, self.rebound_velocity()
        _, q, r = self._contact_wave(t)
        ahead = jnp.where(q < L, -v0, v0) - g * r / c
        contact = (g / c) ** 2 * r**3 / 3 + (L - r) * ahead**2
        s, direction, r = self._flight_wave(t)
        ahead = v0 - g * s + 2 * g / c * direction * r
        flight = r * (ahead - 2 * g / c * direction * L) ** 2 + (L - r) * ahead**2
        later = jnp.where(s < 0, contact, flight)
        squared = jnp.where(t < self.contact_interval()[0], L * (g * t) ** 2, later)
        return sign**2 * self.density / 2 * squared

    def elastic_energy(self, t: ArrayLike) -> Array:
        """Return the elastic energy, shape of t [J/m^2]."""
        t, sign = self._fold(jnp.asarray(t))
        L, c, v0 = self.length, self.wave_speed(), self.rebound_velocity()
        k = self.gravity / c**2
        _, q, r = self._contact_wave(t)
        wall = v0 / c + k * q
        behind = wall**2 * r - wall * k * r**2 + k**2 * r**3 / 3
        contact = behind + jnp.where(q > L, 4 * k**2 * (L - r) ** 3 / 3, 0)
        s, _, r = self._flight_wave(t)
        flight = 4 * k**2 * (r**3 + (L - r) ** 3) / 3
        return sign**2 * self.young / 2 * jnp.where(s < 0, contact, flight)

    def potential_energy(self, t: ArrayLike) -> Array:
        """Return the energy of gravity, shape of t [J/m^2]; 0 if the unstrained bar stands."""
        return self.density * self.length * self.gravity * (self.gap + self.mean_displacement(t))

    def energy(self) -> Array:
        """Return the total energy rho g L h0, conserved, () [J/m^2]."""
        return jnp.asarray(self.density * self.gravity * self.length * self.gap)

    def _crossing(self):
        """Time 2L/c that a wave needs to and fro, () [s]."""
        return 2 * self.length / self.wave_speed()

    def _pressure(self):
        """Contact pressure at first touch, () [Pa], and its slope, () [Pa/s]."""
        first = self.rebound_velocity() * jnp.sqrt(self.young * self.density)
        return first, self.density * self.gravity * self.wave_speed()

    def _flight_time(self):
        """First root s > 0 of v0 s - g s^2/2 + phi(c s), () [s]."""
        g, v0, T = self.gravity, self.rebound_velocity(), self._crossing()
        # A convex quadratic between n T and (n + 1) T; the root lies where its sign changes.
        n = jnp.floor(2 * v0 / (g * T))
        height = n * T * (v0 - g * n * T / 2)
        fall = g * (n + 1) * T - v0
        root = 2 * height / (fall + jnp.sqrt(fall**2 - 2 * g * height))
        return jnp.where(v0 >= g * T, n * T + root, 0)

    def _cycle(self):
        """Period if the motion is periodic, () [s]."""
        return 4 * self.rebound_velocity() / self.gravity + 2 * self._crossing()

    def _contact_wave(self, t):
        """Time s in [0, 2L/c] since first touch, way q and place r of the shock, shape of t."""
        start, end = self.contact_interval()
        s = jnp.clip(t, start, end) - start
        q = self.wave_speed() * s
        return s, q, jnp.minimum(q, 2 * self.length - q)

    def _flight_wave(self, t):
        """Time s since the rebound, direction and place r of the wave front, shape of t."""
        s = t - self.contact_interval()[1]
        way = jnp.mod(self.wave_speed() * s, 2 * self.length)
        return s, jnp.where(way < self.length, 1, -1), jnp.minimum(way, 2 * self.length - way)

    def _fold(self, t):
        """Reduce t to [0, next_impact()]: the time and the velocity's sign (NaN if invalid)."""
        is_beyond = (t < 0) | (t > self.next_impact())
        cycle = _block_derivative(jnp.broadcast_to(self._cycle(), t.shape), is_beyond)
        offset = t - jnp.where(is_beyond, jnp.round(t / cycle), 0) * cycle
        sign = jnp.where(is_beyond & (offset < 0), -1, 1)
        return jnp.abs(offset), sign * jnp.where(is_beyond & ~self.is_periodic(), jnp.nan, 1)


@jax.custom_jvp
def _block_derivative(value, is_blocked):
    """Return value; its derivative is NaN where blocked, so that no wrong gradient goes unseen."""
    return value


@_block_derivative.defjvp
def _block_derivative_jvp(primals, tangents):
    value, is_blocked = primals
    return value, tangents[0] * jnp.where(is_blocked, jnp.nan, 1)
