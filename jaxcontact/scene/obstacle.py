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

from jaxcontact.transforms.traced import Values, as_array, is_traced, poison_unless
from jaxcontact.transforms.trees import PyTree

#: How far the slope of a signed distance may be from 1: grids and blends need a little.
SLOPE_TOLERANCE = 1e-2


class Obstacle(Protocol):
    """A rigid obstacle."""

    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,) to the obstacle, a scalar [m]."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HalfSpace:
    """The obstacle {x: normal . (x - point) <= 0}, bounded by a plane (2D: line, 1D: point).

    Example:
        >>> floor = jc.HalfSpace(point=[0.0, -1.0], normal=[0.0, 1.0])
        >>> float(floor.signed_distance(jnp.array([5.0, 2.0])))
        3.0
    """

    point: Array | np.ndarray
    """A point of the bounding plane, (d,) [m]."""

    normal: Array | np.ndarray
    """Normal of the plane, (d,), of any positive length; points from the obstacle to the body."""

    @jax.jit
    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,), a scalar [m]."""
        normal = jnp.asarray(self.normal, x.dtype)
        offset = x - jnp.asarray(self.point, x.dtype)
        return jnp.dot(normal, offset) / jnp.linalg.norm(normal)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ball:
    """The ball (2D: disc) of the given centre and radius, or everything outside of it: a bowl."""

    center: Array | np.ndarray
    """Centre, (d,) [m]."""

    radius: float | Array
    """Radius, [m], positive."""

    inside: bool = field(default=False, metadata={"static": True})
    """Whether the body is inside and the obstacle outside of the ball."""

    @jax.jit
    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,), a scalar [m]."""
        distance = jnp.linalg.norm(x - jnp.asarray(self.center, x.dtype)) - self.radius
        return -distance if self.inside else distance


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SignedDistance:
    """An obstacle given by a user's function.

    The gap is the function's value at the contact nodes, the normal its normalised gradient, which
    must have length 1 (within 1 %): a level set such as x . x - r^2 is no distance.

    Data that the function captures is read by every `discretize`, but is constant in a program
    under jax.jit; what changes there, or is differentiated, goes into `parameters`.
    """

    function: Callable[..., Array] = field(metadata={"static": True})
    """Maps one point (d,) [m], and the parameters if there are any, to the signed distance of the
    point, a scalar [m]; written with jax.numpy."""

    parameters: PyTree = None
    """Second argument of the function, a pytree of arrays; None is none."""

    def signed_distance(self, x: Array) -> Array:
        """Return the signed distance of one point (d,), a scalar [m].

        Derivative: by the point and the parameters.
        """
        return self.function(x) if self.parameters is None else self.function(x, self.parameters)


def gap_and_normals(obstacle: Obstacle, points: Array) -> tuple[Array, Array]:
    """Return the initial gap (C,) [m] and the unit normals towards the obstacle (C, d).

    They are NaN if a wrong slope or radius is traced.

    Args:
        obstacle: the rigid obstacle.
        points: contact nodes in the reference configuration, (C, d) [m].

    Raises:
        ValueError: if the obstacle does not fit the dimension of the points, or has a normal or
            radius that defines no surface, or its signed distance has a slope other than 1.
    """
    check_obstacle(obstacle, points.shape[1])
    gap, gradient = jax.vmap(jax.value_and_grad(obstacle.signed_distance))(points)
    if not is_traced(gradient):
        _check_slope(obstacle, np.linalg.norm(np.asarray(gradient), axis=1))
    normals, factor = _normals(gradient, smallest_radius(obstacle))
    return gap * factor, normals


def simple_parts(obstacle: Obstacle) -> list[Obstacle]:
    """Return the obstacles that an obstacle is made of, itself if it is made of none."""
    parts = getattr(obstacle, "parts", ())
    return [simple for part in parts for simple in simple_parts(part)] if parts else [obstacle]


def smallest_radius(obstacle: Obstacle) -> Array | float:
    """Return the smallest radius in an obstacle, one if there is none."""
    radii = [getattr(part, "radius", 1.0) for part in simple_parts(obstacle)]
    return radii[0] if len(radii) == 1 else jnp.min(jnp.stack([jnp.asarray(r) for r in radii]))


# Without the gap, which may be traced where the normals are not.
@jax.jit
def _normals(gradient: Array, radius: Array) -> tuple[Array, Array]:
    """Return the normals (C, d) of the gradients (C, d), and one, scalar; or all NaN."""
    slope = jnp.linalg.norm(gradient, axis=1, keepdims=True)
    is_distance = jnp.all(jnp.abs(slope - 1.0) <= SLOPE_TOLERANCE)
    values = (-gradient / slope, jnp.ones((), gradient.dtype))
    return poison_unless(is_distance & (radius > 0.0), values)


def position_sizes(obstacle: Obstacle, points: Array) -> Values:
    """Return the size of the positions that a signed distance is made of, (d,) [m].

    Its rounding error is relative to them, also at a node whose own position is zero.

    Args:
        obstacle: the rigid obstacle; of a user's own one, only the points are known.
        points: contact nodes, (C, d) [m].
    """
    # On the host where nothing is traced: it is a few numbers, and would be six programs.
    xp = jnp if is_traced((obstacle, points)) else np
    sizes = xp.max(xp.abs(xp.asarray(points)), axis=0)
    for part in simple_parts(obstacle):
        for name in ("point", "center", "radius"):
            sizes = xp.maximum(sizes, xp.abs(xp.asarray(getattr(part, name, 0.0))))
    return sizes


def _check_slope(obstacle: Obstacle, slope: np.ndarray) -> None:
    what = f"the signed distance of {type(obstacle).__name__}"
    if not np.all(slope > 0.0):
        raise ValueError(
            f"{what} has a zero or undefined gradient at a contact node, so no contact normal "
            "exists there; is a node at the centre?"
        )
    worst = slope.flat[np.argmax(np.abs(slope - 1.0))]
    if abs(worst - 1.0) > SLOPE_TOLERANCE:
        raise ValueError(
            f"{what} has a gradient of length {worst:.4g} at a contact node, that of a distance "
            f"has length 1 (within {SLOPE_TOLERANCE}); divide the function by the length of its "
            "gradient, or return the distance itself"
        )


def _advice(value: object) -> str:
    """Return what to write instead of something that is no obstacle."""
    if isinstance(value, str):
        return (
            f"a facet set of another body of the mesh is jc.Facets({value!r}), and a plane is "
            "jc.HalfSpace(point, normal)"
        )
    if callable(value):
        return "a function that returns the signed distance of a point is jc.SignedDistance(...)"
    return (
        "it needs a method signed_distance, as jc.HalfSpace has; contact with another body is "
        "jc.Facets(name), given to a contact set by itself"
    )


def check_obstacle(obstacle: Obstacle, dimension: int) -> None:
    """Check what is concrete in an obstacle and its parts.

    Raises:
        ValueError: if it has no signed distance, a vector has the wrong shape, a value is not
            finite, a normal is zero or a radius is not positive.
    """
    for part in getattr(obstacle, "parts", ()):
        check_obstacle(part, dimension)
    if not callable(getattr(obstacle, "signed_distance", None)):
        raise ValueError(f"{obstacle!r} is no obstacle: {_advice(obstacle)}")
    for name in ("point", "normal", "center", "direction"):
        field_value = getattr(obstacle, name, None)
        if field_value is None:
            continue
        where, value = f"{type(obstacle).__name__}.{name}", as_array(field_value)
        if value.shape != (dimension,):
            raise ValueError(f"{where} must have shape ({dimension},), got {value.shape}")
        if is_traced(value):
            continue
        if not np.all(np.isfinite(np.asarray(value, float))):
            raise ValueError(f"{where} must be finite, got {value}")
        # np.asarray first: under jit the methods of a concrete JAX array give tracers.
        if name in ("normal", "direction") and not np.any(np.asarray(value)):
            raise ValueError(f"{where} must not be the zero vector")
    radius = as_array(getattr(obstacle, "radius", 1.0))
    if radius.shape != ():
        raise ValueError(f"Ball.radius must be a scalar, got shape {radius.shape}")
    if not is_traced(radius) and not np.asarray(radius) > 0.0:
        raise ValueError(f"Ball.radius must be positive, got {radius}")
