"""A rigid point mass under gravity bounces on a rigid floor with a restitution coefficient.

y'' = -g between impacts, y >= 0, and v+ = -e v- at an impact. With w = sqrt(v0^2 + 2 g h0) the
impacts k = 0, 1, 2, ... happen at

    t_k = (v0 + w)/g + (2 w/g) (e + e^2 + ... + e^k),   with the speed e^k w before impact k;

for e < 1 they accumulate at t_0 + (2 w/g) e/(1 - e), after which the mass rests.

Source: B. Brogliato, Nonsmooth Mechanics, Springer (1999).
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
class BouncingMass:
    """Point mass over a floor at height 0; valid for t >= 0, NaN before.

    At an impact the velocity is the one after it. Derivative: of position and velocity with respect
    to all fields at times that are not impacts (the number of past impacts is locally constant).
    """

    height: Number = 5.0
    """Height h0 >= 0 at t = 0, () [m]."""
    initial_velocity: Number = 0.0
    """Velocity v0 at t = 0, () [m/s]; positive upwards."""
    gravity: Number = 10.0
    """Gravity g > 0, () [m/s^2]; acts downwards."""
    restitution: Number = 1.0
    """Restitution coefficient e in [0, 1], () [-]; 1 is elastic."""
    mass: Number = 1.0
    """Mass m, () [kg]."""

    def impact_speed(self, k: ArrayLike = 0) -> Array:
        """Return the speed e^k w before the impact k = 0, 1, 2, ..., shape of k [m/s]."""
        first = jnp.sqrt(self.initial_velocity**2 + 2 * self.gravity * self.height)
        return first * self.restitution ** jnp.asarray(k)

    def impact_time(self, k: ArrayLike = 0) -> Array:
        """Return the time t_k of the impact k = 0, 1, 2, ..., shape of k [s]."""
        w = self.impact_speed()
        flights = _geometric_sum(self.restitution, jnp.asarray(k))
        return (self.initial_velocity + w + 2 * w * flights) / self.gravity

    def rest_time(self) -> Array:
        """Return the time from which on the mass rests, () [s]; infinite for e = 1."""
        e = jnp.asarray(self.restitution)
        flights = jnp.where(e < 1, e / jnp.where(e < 1, 1 - e, 1), jnp.inf)
        w = self.impact_speed()
        return (self.initial_velocity + w + 2 * w * flights) / self.gravity

    def impulse(self, k: ArrayLike = 0) -> Array:
        """Return the impulse m (1 + e) e^k w of the impact k, shape of k [N s]."""
        return self.mass * (1 + self.restitution) * self.impact_speed(k)

    def position(self, t: ArrayLike) -> Array:
        """Return the height above the floor, shape of t [m]."""
        launch_height, launch_velocity, elapsed = self._last_launch(t)
        return launch_height + elapsed * (launch_velocity - self.gravity * elapsed / 2)

    def velocity(self, t: ArrayLike) -> Array:
        """Return the velocity, positive upwards, shape of t [m/s]."""
        _, launch_velocity, elapsed = self._last_launch(t)
        return launch_velocity - self.gravity * elapsed

    def energy(self, t: ArrayLike) -> Array:
        """Return the kinetic and potential energy, zero at rest on the floor, shape of t [J]."""
        return self.mass * (self.velocity(t) ** 2 / 2 + self.gravity * self.position(t))

    def contact_force_mean(self, t0: ArrayLike, t1: ArrayLike) -> Array:
        """Return the exact mean of the floor's force over (t0, t1], t0 < t1, their shape [N]."""
        gained = self.velocity(t1) - self.velocity(t0)
        return self.mass * (gained / jnp.subtract(t1, t0) + self.gravity)

    def _last_launch(self, t):
        """Height and velocity after the last impact (or the start) and the time since then."""
        t = jnp.asarray(t) * jnp.where(jnp.asarray(t) >= 0, 1, jnp.nan)
        is_first, is_resting = t < self.impact_time(), t >= self.rest_time()
        k = self._last_impact(t, is_first | is_resting)
        height = jnp.where(is_first, self.height, 0)
        velocity = jnp.where(is_first, self.initial_velocity, self.impact_speed(k + 1))
        elapsed = jnp.where(is_first, t, t - self.impact_time(k))
        return height, jnp.where(is_resting, 0, velocity), jnp.where(is_resting, 0, elapsed)

    def _last_impact(self, t, is_excluded):
        """Largest k with t_k <= t, shape of t; 0 where excluded (before the impacts, at rest)."""
        w, e = self.impact_speed(), jnp.asarray(self.restitution)
        flights = jnp.where(is_excluded, 0, (t - self.impact_time()) * self.gravity / (2 * w))
        is_inelastic = (e > 0) & (e < 1)
        e = jnp.where(is_inelastic, e, 0.5)
        used = jnp.clip(flights * (1 - e) / e, 0, 1 - jnp.finfo(flights.dtype).eps)
        k = jnp.floor(jnp.where(is_inelastic, jnp.log1p(-used) / jnp.log(e), flights))
        # The logarithm may be off by one impact next to t_k; impact_time decides.
        k = jnp.maximum(k - (t < self.impact_time(k)), 0)
        return jax.lax.stop_gradient(k + ((t >= self.impact_time(k + 1)) & ~is_excluded))


def _geometric_sum(e, k):
    """Sum e + e^2 + ... + e^k, shape of k; its series near e = 1 keeps the derivative exact."""
    delta = e - 1
    is_near = jnp.abs(delta) * k < 1e-2
    series = 1 + delta * (k - 2) / 4 * (1 + delta * (k - 3) / 5)
    series = k * (1 + delta * (k + 1) / 2 * (1 + delta * (k - 1) / 3 * series))
    safe = jnp.where(is_near, 0.5, e)
    return jnp.where(is_near, series, safe * (1 - safe**k) / (1 - safe))
