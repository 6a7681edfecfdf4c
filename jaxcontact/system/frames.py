"""Frames of bodies that turn: rotation and deformation of a body, and their change in a step.

With x - c = R (X + u), the mass centre c and R the rotation of the polar decomposition of
G = sum m (x - c) X^T, a body deforms by u in its frame R. From the velocity w of a step and
q = R (X + u) follow, without differences of large numbers,

    W skew of skew(S^T (dG - W Gb)) = 0,   S = (I - W/2)^-1 R,                                (1)
    e = S^T (w - wbar - W qb / tau) = du / tau,                                               (2)
    g = S a + M S [y] X,   J^T y = t,   free of torque about qb = q + tau (w - wbar) / 2,     (3)

and R' = (I - W/2)^-1 (I + W/2) R, u' = u + tau e. Nodes of a body without frame, a clamped one,
have R = S = I and wbar = W = y = 0. Source: MATH.md 12.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.obstacle import Obstacle
from jaxcontact.system.small_matrices import axial, cayley, half_cayley, product, skew, solve_small
from jaxcontact.system.sparse import ContactNormals

#: Sweeps over (1) for each sweep over the step: an error falls by the strain of a step in each.
INNER_SWEEPS = 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Meeting:
    """The pairs of bodies with frame, P of them, that may meet one obstacle."""

    obstacle: Obstacle
    """The obstacle."""

    pairs: np.ndarray
    """Numbers of the pairs, (P,) int32."""

    nodes: np.ndarray
    """Their nodes, (P,) int32."""

    is_concave: bool = field(metadata={"static": True})
    """Whether it is concave, a bowl: a node is kept out of it by the tangent at its new place."""

    def measure(self, places: Array) -> tuple[Array, Array]:
        """Return the distances (P,) [m] of the nodes at places (P, d), and the normals (P, d)."""
        distance, slope = jax.vmap(jax.value_and_grad(self.obstacle.signed_distance))(places)
        return distance, -slope / jnp.linalg.norm(slope, axis=1, keepdims=True)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frames:
    """One frame for each of F bodies without clamps; K unclamped nodes of the system."""

    reference: Array
    """X, node positions from the mass centre of the body, (K, d) [m]; zero without frame."""

    origin: Array
    """Mass centre of each body in the reference configuration, (F, d) [m]."""

    moments: Array
    """Shares of the nodes in the mass of their body and m X, (K, 1+d) [1], [kg m]; zero without
    frame."""

    members: np.ndarray | None
    """One for the nodes of each body, (F, K); None if there is one body and all nodes are its."""

    numbers: np.ndarray | None
    """Body of each node, (K,) int32, F for a node without frame; None if there is one body."""

    places: np.ndarray | None
    """Number of the node of each pair among the contact nodes, (C,) int32; None if each node has
    one pair, in the same order."""

    unknowns: np.ndarray
    """Unknowns of the contact nodes, (d c,) int32: the first components of all, then the next."""

    gap: Array
    """Gaps in the reference configuration, (C,) [m]: where those of the system are others (see
    `System.with_gap`), the obstacle is farther by the difference, at every place."""

    meetings: tuple[Meeting, ...]
    """Which pairs meet which obstacle; the gaps of bodies without frame stay linearised."""

    def nodal_rows(self, dtype: np.dtype) -> ContactNormals:
        """Return the components of the contact nodes as contact rows: normals of any direction."""
        return ContactNormals(jnp.ones((len(self.unknowns), 1), dtype), self.unknowns[:, None])

    @property
    def is_concave(self) -> bool:
        """Whether an obstacle is concave."""
        return any(meeting.is_concave for meeting in self.meetings)

    def sums(self, left: Array, right: Array) -> Array:
        """Return sum left right^T over the nodes of each body, (F, i, j), of (K, i) and (K, j)."""
        if self.members is None:
            return (left.T @ right)[None]
        return jnp.einsum("fk,ki,kj->fij", self.members, left, right)

    def spread(self, values: Array, rest: Array) -> Array:
        """Return the value of the body of each node, (K or 1, ...), of (F, ...); rest for none."""
        if self.numbers is None:
            return values
        return jnp.concatenate([values, rest[None]])[self.numbers]

    def apply(self, matrices: Array, x: Array, rest: float = 0.0) -> Array:
        """Return the products of x (K, d) with the matrix of each body (F, d, d)."""
        d = x.shape[1]
        turns = self.spread(matrices, rest * jnp.eye(d, dtype=x.dtype))
        # Column by column, twenty times as fast as a sum over an axis of two or three.
        return sum(turns[:, :, j] * x[:, j, None] for j in range(1, d)) + turns[:, :, 0] * x[:, :1]


class FrameState(NamedTuple):
    """What a step hands on of the frames."""

    rotation: Array
    """R of each body, (F, d, d)."""

    deformation: Array
    """u in the frame of the body, (n,) [m]; the displacement of a body without frame."""


class FrameStart(NamedTuple):
    """The frames at the start of a step."""

    rotation: Array
    """R, (F, d, d)."""

    places: Array
    """q = R (X + u), (K, d) [m]."""

    moment: Array
    """sum m q X^T, (F, d, d) [kg m^2]."""


class FrameStep(NamedTuple):
    """The frames in the course of one step."""

    middle: Array
    """S, (F, d, d): R' + R over two."""

    jacobian: Array
    """J of (1) and (3), (F, s, s), s = d (d - 1) / 2."""

    places: Array
    """qb, (K, d) [m]."""

    rate: Array
    """e of (2), (K, d) [m/s]."""


def initial_frames(frames: Frames, displacement: Array) -> FrameState:
    """Return the frames of a displacement (n,) by polar decomposition.

    Derivative: of second order, by two steps of Newton's method at the solution.
    """
    d = frames.reference.shape[1]
    y = displacement.reshape(-1, d)
    mean = frames.sums(y, frames.moments[:, :1])[:, :, 0]
    moved = y - frames.spread(mean, jnp.zeros(d, y.dtype))
    G = frames.sums(frames.reference + moved, frames.moments[:, 1:])
    left, _, right = jnp.linalg.svd(jax.lax.stop_gradient(G))
    sign = jnp.sign(jnp.linalg.det(product(left, right)))
    left = left.at[:, :, -1].multiply(sign[:, None])
    R = jax.lax.stop_gradient(product(left, right))
    for _ in range(2):
        H = product(jnp.swapaxes(R, 1, 2), G)
        R = product(R, cayley(solve_small(_jacobian(jnp.eye(d, dtype=R.dtype)[None], H), axial(H))))
    back = jnp.swapaxes(R, 1, 2)
    turned_back = frames.apply(back - jnp.eye(d, dtype=R.dtype)[None], frames.reference)
    deformation = turned_back + frames.apply(back, moved, 1.0)
    return FrameState(R, deformation.reshape(-1))


def frame_start(frames: Frames, state: FrameState) -> FrameStart:
    """Return the frames at the start of a step."""
    u = state.deformation.reshape(frames.reference.shape)
    places = frames.apply(state.rotation, frames.reference + u, 1.0)
    return FrameStart(state.rotation, places, frames.sums(places, frames.moments[:, 1:]))


def turn(
    frames: Frames, start: FrameStart, dt: Array, velocity: Array, increment: Array
) -> tuple[FrameStep, Array]:
    """Return the frames in a step with the velocity w, and W.

    Args:
        frames: the frames.
        start: of the step.
        dt: tau.
        velocity: w, (K, d) [m/s].
        increment: an approximation of the axial vector of W, (F, s).
    """
    rotation, places, moment = start
    sums = frames.sums(velocity, frames.moments)
    mean, dG = sums[:, :, 0], dt * sums[:, :, 1:]
    Gb = moment + 0.5 * dG
    for _ in range(INNER_SWEEPS):
        S = product(half_cayley(increment), rotation)
        increment = solve_small(_jacobian(S, Gb), axial(product(jnp.swapaxes(S, 1, 2), dG)))
    S = product(half_cayley(increment), rotation)
    relative = velocity - frames.spread(mean, jnp.zeros_like(mean[0]))
    middle = places + 0.5 * dt * relative
    turning = frames.apply(skew(increment) / dt, middle)
    rate = frames.apply(jnp.swapaxes(S, 1, 2), relative - turning, 1.0)
    return FrameStep(S, _jacobian(S, Gb), middle, rate), increment


def turned_force(frames: Frames, step: FrameStep, force: Array) -> Array:
    """Return g (K, d) of a, the elastic and viscous force in the frame, (K, d)."""
    turned = frames.apply(step.middle, force, 1.0)
    t = axial(frames.sums(step.places, turned))
    y = solve_small(jnp.swapaxes(step.jacobian, 1, 2), t)
    return turned + frames.apply(product(step.middle, skew(y)), frames.moments[:, 1:])


def next_frames(
    frames: Frames, state: FrameState, dt: Array, step: FrameStep, increment: Array
) -> FrameState:
    """Return the frames after a step."""
    R = product(cayley(increment), state.rotation)
    # Of the rounding errors of many steps, those that R is no rotation by.
    identity = jnp.eye(R.shape[-1], dtype=R.dtype)[None]
    R = product(R, 1.5 * identity - 0.5 * product(jnp.swapaxes(R, 1, 2), R))
    return FrameState(R, state.deformation + dt * step.rate.reshape(-1))


def _jacobian(S: Array, G: Array) -> Array:
    """Return J_kl = <E_k, S^T E_l G>, (F, s, s)."""
    s = G.shape[-1] * (G.shape[-1] - 1) // 2
    units = skew(jnp.eye(s, dtype=G.dtype))
    columns = [axial(product(jnp.swapaxes(S, 1, 2), product(E[None], G))) for E in units]
    return jnp.stack(columns, axis=-1)
