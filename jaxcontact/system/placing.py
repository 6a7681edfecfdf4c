"""The frames of a scene, and its contact where the bodies are now.

A body that turns meets its obstacles with the gap phi(x) and the normal nu = -grad phi(x) of its
place x, not of the reference configuration. Source: MATH.md 12.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.facets import Facets
from jaxcontact.scene.obstacle import Ball
from jaxcontact.scene.scene import Scene
from jaxcontact.system.bodies import body_numbers
from jaxcontact.system.contact_pairs import merged_obstacles
from jaxcontact.system.frames import Frames, Meeting, initial_frames
from jaxcontact.system.pairs import ContactPairs
from jaxcontact.system.sparse import ComponentwiseMatrix
from jaxcontact.system.system import System


def frames_of(scene: Scene, system: System, pairs: ContactPairs) -> Frames | None:
    """Return one frame for every body without clamped nodes; None if there is none.

    Args:
        scene: the scene.
        system: its system, without frames.
        pairs: its contact pairs.
    """
    d, free = system.dimension, np.asarray(system.free_nodes)
    of_node = body_numbers(system)
    clamped = np.setdiff1d(np.arange(system.n_nodes), free)
    turning = np.setdiff1d(of_node, of_node[clamped])
    if not turning.size:
        return None
    numbers = np.full(of_node.max() + 1, turning.size, np.int32)
    numbers[turning] = np.arange(turning.size)
    numbers = numbers[of_node]
    members = (numbers[free] == np.arange(turning.size)[:, None]).astype(system.dtype)
    assert isinstance(system.mass, ComponentwiseMatrix)
    mass = system.mass.scalar @ jnp.ones(free.size, system.dtype)
    shares = mass * (members.T @ (1.0 / (members @ mass)))
    points = system.points[free]
    origin = members @ (shares[:, None] * points)
    inside = jnp.asarray(np.any(members > 0.0, axis=0))[:, None]
    reference = jnp.where(inside, points - members.T @ origin, 0.0)
    moments = jnp.concatenate([shares[:, None], system.mass.scalar @ reference], axis=1)
    is_whole = len(turning) == 1 and free.size == np.count_nonzero(members)
    contact_nodes = np.unique(pairs.nodes)
    positions = np.asarray(system.node_numbers)[contact_nodes].astype(np.int32)
    places = np.searchsorted(contact_nodes, pairs.nodes)
    return Frames(
        reference=reference,
        origin=origin,
        moments=moments,
        members=None if is_whole else members,
        numbers=None if is_whole else numbers[free].astype(np.int32),
        places=None if np.array_equal(contact_nodes, pairs.nodes) else places.astype(np.int32),
        unknowns=(positions * d + np.arange(d, dtype=np.int32)[:, None]).reshape(-1),
        gap=system.gap,
        meetings=tuple(_meetings(scene, pairs, numbers[pairs.nodes] < turning.size)),
    )


def _meetings(scene: Scene, pairs: ContactPairs, has_frame: np.ndarray) -> Iterator[Meeting]:
    """Yield the pairs of bodies with frame, (C,) bool, that may meet each obstacle."""
    for number, (_, obstacle, _) in enumerate(merged_obstacles(scene)):
        rows = np.flatnonzero(has_frame & (pairs.owner == number)).astype(np.int32)
        if rows.size and not isinstance(obstacle, Facets):
            is_concave = isinstance(obstacle, Ball) and obstacle.inside
            yield Meeting(obstacle, rows, pairs.nodes[rows], is_concave)


def deformation(system: System, displacement: Array) -> Array:
    """Return the deformation (..., N, d) [m] of a displacement, in axes that turn with a body."""
    frames = system.frames
    if frames is None:
        return displacement
    flat = displacement.reshape(-1, *displacement.shape[-2:])
    turned = jax.vmap(lambda y: initial_frames(frames, system.restrict(y)).deformation)(flat)
    return system.lift(turned).reshape(displacement.shape)


def gap_and_rows(system: System, displacement: Array) -> tuple[Array, Array]:
    """Return the gaps (C,) [m] and the rows of N, (C, d), of a displacement (n,)."""
    gap = system.gap - system.normals @ displacement
    rows = system.normals.weights
    if system.frames is None:
        return gap, rows
    for meeting in system.frames.meetings:
        places = system.points[meeting.nodes] + system.normals.touched(displacement)[meeting.pairs]
        distance, normals = meeting.measure(places)
        more = (system.gap - system.frames.gap)[meeting.pairs]
        gap = gap.at[meeting.pairs].set(distance + more)
        rows = rows.at[meeting.pairs].set(normals)
    return gap, rows


def rows_of_step(system: System, old: Array, new: Array) -> Array:
    """Return the rows of N, (C, d), with which a step from y to y' (n,) was solved."""
    rows = gap_and_rows(system, old)[1]
    if system.frames is None or not system.frames.is_concave:
        return rows
    later = gap_and_rows(system, new)[1]
    for meeting in system.frames.meetings:
        if meeting.is_concave:
            rows = rows.at[meeting.pairs].set(later[meeting.pairs])
    return rows


def placed(system: System, displacement: Array) -> System:
    """Return the system with the contact of the place of its bodies, of a displacement y (n,).

    Its gap psi - N y is the signed distance there. Without frames it is the system itself.
    """
    if system.frames is None:
        return system
    gap, rows = gap_and_rows(system, displacement)
    normals = replace(system.normals, weights=rows)
    return replace(system, normals=normals, gap=gap + normals @ displacement, directions=rows)
