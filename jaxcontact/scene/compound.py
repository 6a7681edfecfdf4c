"""Obstacles made of others: the nearest of two, and one that is looked at along given directions.

Along a unit direction nu the gap of a point x is the way t to the obstacle, phi(x + t nu) = 0 with
the signed distance phi. It is found by steps of the length phi, which cannot pass the surface, and
then by Newton's method; its derivative is that of the equation,

    dt = -(dphi + grad phi . (dx + t dnu)) / (grad phi . nu).

Source: MATH.md 11.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.obstacle import Obstacle, check_obstacle

#: Steps of the length of the signed distance, and steps of Newton's method after them.
DISTANCE_STEPS, NEWTON_STEPS = 40, 12
#: Least cosine between the direction and the normal of a surface that is met.
STEEPEST = 0.1
#: A way is found if the distance that is left is so many rounding errors of the positions.
ROUNDING = 1e3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Union:
    """Two obstacles as one: each contact node meets the nearest, in the reference configuration.

    For two obstacles that each node may both touch, as in a groove, give a contact set a tuple of
    them instead. Unions can be nested.
    """

    first: Obstacle
    """An obstacle; it is the one where both are equally near."""

    second: Obstacle
    """Another obstacle."""

    @property
    def parts(self) -> tuple[Obstacle, Obstacle]:
        """The obstacles it is made of."""
        return self.first, self.second

    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,) to the nearer obstacle, a scalar [m].

        Inside of one of them, where they overlap, it is a bound.
        """
        distances = self.first.signed_distance(x), self.second.signed_distance(x)
        return jnp.where(distances[0] <= distances[1], *distances)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Along:
    """An obstacle that is met along the normals of the body, or along one direction.

    The contact normals of a scene are those of the obstacle, towards its nearest point. Here the
    gap is the way to the obstacle along the direction instead. A node whose ray misses the
    obstacle, or meets it at a grazing angle, has no constraint; where values are traced, it has
    one with a gap too large to matter.
    """

    obstacle: Obstacle
    """A rigid obstacle."""

    direction: Array | np.ndarray | None = None
    """Direction from the body to the obstacle, (d,), of any positive length; None is the outward
    normal of the contact set at each node."""

    @property
    def parts(self) -> tuple[Obstacle]:
        """The obstacle it is made of."""
        return (self.obstacle,)

    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,) to the obstacle, a scalar [m]."""
        return self.obstacle.signed_distance(x)


def gap_to(obstacle: Obstacle, points: Array, normals: Array) -> Array:
    """Return the gaps (C,) [m] of points (C, d) with the given unit normals (C, d).

    That is the signed distance, which needs no normal, or the way along it of `Along`.
    """
    if isinstance(obstacle, Along):
        return gap_along(obstacle, points, normals)[0]
    return jax.vmap(obstacle.signed_distance)(points)


def gap_along(along: Along, points: Array, normals: Array) -> tuple[Array, Array]:
    """Return the ways (C,) [m] from points along unit normals (C, d), and which meet, (C,) bool.

    Where nothing is met, the way is a million times the size of the positions.

    Raises:
        ValueError: as `check_obstacle`.

    Derivative: by obstacle, points and normals, of up to third order.
    """
    check_obstacle(along, points.shape[1])
    way, is_met = _gap_along(along.obstacle, points, normals)
    return way, is_met


@jax.jit
def _gap_along(obstacle: Obstacle, points: Array, normals: Array) -> tuple[Array, Array]:
    def one(x: Array, nu: Array) -> tuple[Array, Array]:
        def distance(obstacle: Obstacle, x: Array, nu: Array, t: Array) -> Array:
            return obstacle.signed_distance(x + t * nu)

        def newton(of: tuple, t: Array) -> Array:
            value, slope = jax.value_and_grad(distance, 3)(*of, t)
            return t - value / jnp.where(jnp.abs(slope) < 1e-3, 1.0, slope)

        fixed = jax.lax.stop_gradient((obstacle, x, nu))
        t = jnp.zeros((), x.dtype)
        t = jax.lax.fori_loop(0, DISTANCE_STEPS, lambda _, t: t + distance(*fixed, t), t)
        t = jax.lax.fori_loop(0, NEWTON_STEPS, lambda _, t: newton(fixed, t), t)
        left, slope = jax.value_and_grad(distance, 3)(*fixed, t)
        size = jnp.max(jnp.abs(fixed[1])) + jnp.abs(distance(*fixed, jnp.zeros_like(t)))
        resolution = ROUNDING * jnp.finfo(x.dtype).eps * size
        is_met = (jnp.abs(left) <= resolution) & (slope <= -STEEPEST)
        # Two steps that are differentiated: each doubles the order up to which they are right.
        t = jax.lax.stop_gradient(jnp.where(is_met, t, 0.0))
        for _ in range(2):
            t = newton((obstacle, x, nu), t)
        return jnp.where(is_met, t, 1e6 * size), is_met

    return jax.vmap(one)(points, normals)
