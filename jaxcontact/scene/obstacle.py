"""Rigid obstacles, each given by its signed distance (positive outside, in the free space).

Non-penetration is linearised at the reference configuration (2.3): with phi the signed distance,
(y . nu)(x) <= psi(x) with the unit vector nu = -grad phi(x) towards the obstacle and the initial
gap psi(x) = phi(x). Unlike (Phi(x) - x) / |Phi(x) - x| this needs no special case at psi = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer


class Obstacle(Protocol):
    """A rigid obstacle."""

    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,) to the obstacle, a scalar [m]."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HalfSpace:
    """The obstacle {x: normal . (x - point) <= 0}, bounded by a plane (2D: line, 1D: point)."""

    point: Array | np.ndarray
    """A point of the bounding plane, (d,) [m]."""

    normal: Array | np.ndarray
    """Normal of the plane, (d,), of any positive length; points from the obstacle to the body."""

    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,), a scalar [m]."""
        normal = jnp.asarray(self.normal, x.dtype)
        offset = x - jnp.asarray(self.point, x.dtype)
        return jnp.dot(normal, offset) / jnp.linalg.norm(normal)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ball:
    """The ball (2D: disc) of the given centre and radius."""

    center: Array | np.ndarray
    """Centre, (d,) [m]."""

    radius: float | Array
    """Radius, [m], positive."""

    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,), a scalar [m]."""
        return jnp.linalg.norm(x - jnp.asarray(self.center, x.dtype)) - self.radius


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SignedDistance:
    """An obstacle given by a user's function.

    The gap is the function's value at the contact nodes, the normal its normalised gradient.
    """

    function: Callable[[Array], Array] = field(metadata={"static": True})
    """Maps one point (d,) [m] to its signed distance, a scalar [m]; written with jax.numpy."""

    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,), a scalar [m]."""
        return self.function(x)


def gap_and_normals(obstacle: Obstacle, points: Array) -> tuple[Array, Array]:
    """Return the initial gap (C,) [m] and the unit normals towards the obstacle (C, d).

    Args:
        obstacle: the rigid obstacle.
        points: contact nodes in the reference configuration, (C, d) [m].

    Raises:
        ValueError: if the obstacle does not fit the dimension of the points, or has a normal or
            radius that defines no surface.
    """
    check_obstacle(obstacle, points.shape[1])
    gap, gradient = jax.vmap(jax.value_and_grad(obstacle.signed_distance))(points)
    length = jnp.linalg.norm(gradient, axis=1, keepdims=True)
    if not isinstance(length, Tracer) and not np.all(np.asarray(length) > 0.0):
        raise ValueError(
            f"the signed distance of {type(obstacle).__name__} has a zero or undefined gradient "
            "at a contact node, so no contact normal exists there; is a node at the centre?"
        )
    return gap, -gradient / length


def check_obstacle(obstacle: Obstacle, dimension: int) -> None:
    """Check what is concrete in an obstacle.

    Raises:
        ValueError: if a vector has the wrong shape, a value is not finite, a normal is zero or a
            radius is not positive.
    """
    for name in ("point", "normal", "center"):
        value = getattr(obstacle, name, None)
        if value is None:
            continue
        where = f"{type(obstacle).__name__}.{name}"
        if np.shape(value) != (dimension,):
            raise ValueError(f"{where} must have shape ({dimension},), got {np.shape(value)}")
        if isinstance(value, Tracer):
            continue
        if not np.all(np.isfinite(np.asarray(value, float))):
            raise ValueError(f"{where} must be finite, got {value}")
        # np.asarray first: under jit the methods of a concrete JAX array give tracers.
        if name == "normal" and not np.any(np.asarray(value)):
            raise ValueError(f"{where} must not be the zero vector")
    radius = getattr(obstacle, "radius", None)
    if radius is not None and not isinstance(radius, Tracer) and not np.asarray(radius) > 0.0:
        raise ValueError(f"Ball.radius must be positive, got {radius}")
