"""How wrong the linearised gap has become, and gaps of obstacles that turn.

The gap psi - N y is linear in the displacement, with the normals of the reference configuration.
Against the gap phi(x + y) of the deformed body it is wrong by about u^2 / (2 R) where a node has
moved by u along a surface of radius R. The error is reported and never corrected.
Source: MATH.md 11.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.scene.cells import end_signs
from jaxcontact.scene.compound import gap_to
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.scene import Scene, clamped_numbers
from jaxcontact.system.contact_pairs import contact_pairs, merged_obstacles
from jaxcontact.system.mortar import directions, meet
from jaxcontact.system.pairing import direction_of, find_meeting
from jaxcontact.system.pairs import ContactPairs
from jaxcontact.transforms.traced import as_array, is_traced


def linearization_error(scene: Scene, trajectory: Trajectory) -> np.ndarray:
    """Return the largest error of the linearised gap over all recorded states, (C,) [m].

    Of a rigid obstacle it is |phi(x + y) - gap|, of another body |g - gap| with the way g to the
    facet that the node meets in the deformed configuration; a state in which it meets none does
    not count. Far from contact a large error does no harm.

    Args:
        scene: the scene of the trajectory.
        trajectory: a motion; each recorded state is compared, so thin them out by save_every.

    Raises:
        ValueError: if something is traced, the trajectory was made with `Schedule.gap`, or bodies
            turn.
    """
    if is_traced((scene, trajectory)):
        raise ValueError("linearization_error needs concrete values; call it outside of jax.jit")
    _refuse_frames(scene)
    schedule, mesh = trajectory.schedule, scene.mesh
    if schedule is not None and schedule.gap is not None:
        raise ValueError("with Schedule.gap the place of the obstacle is not known")
    pairs, obstacles = _pairs(scene), merged_obstacles(scene)
    positions = np.asarray(mesh.points)[None] + np.asarray(trajectory.displacement)
    stride = max(1, trajectory.contact_impulse.shape[0] // max(1, len(positions) - 1))
    errors = np.zeros(len(pairs.nodes))
    for number, (names, obstacle, facets) in enumerate(obstacles):
        rows = np.flatnonzero(pairs.owner == number)
        nodes, normals = pairs.nodes[rows], jnp.asarray(pairs.normals)[rows]
        if isinstance(obstacle, Facets):
            gaps = np.stack([_met(scene, names, facets, obstacle, x, nodes) for x in positions])
        else:
            places = positions[:, nodes]
            moved = {} if schedule is None else schedule.obstacle
            for name in set(names) & set(moved):
                places = places - np.asarray(moved[name])[::stride, None]
            gaps = jax.vmap(lambda x, o=obstacle, nu=normals: gap_to(o, x, nu))(places)
        difference = np.abs(np.asarray(gaps) - np.asarray(trajectory.gap)[:, rows])
        errors[rows] = np.nanmax(difference, axis=0, initial=0.0)
    return errors


def turned_gap(
    scene: Scene,
    name: str,
    rotation: ArrayLike,
    translation: ArrayLike | None = None,
    about: ArrayLike | None = None,
) -> Array:
    """Return the change of all gaps when the obstacle of a contact set turns, for `Schedule.gap`.

    The obstacle moves by x -> rotation (x - about) + about + translation. The contact normals stay
    those of the scene, so the angles have to be small.

    Args:
        scene: the scene.
        name: of the contact set.
        rotation: rotation matrices at the time levels, (T+1, d, d).
        translation: (T+1, d) [m]; None is none.
        about: a point that the rotation leaves in its place, (d,) [m]; None is the origin.

    Returns:
        (T+1, C) [m], zero for the pairs of other contact sets.

    Raises:
        ValueError: if the contact set is unknown, meets another body or shares pairs with another
            set, a shape does not fit, or bodies turn.

    Derivative: by rotation, translation, the point and the obstacle.
    """
    _refuse_frames(scene)
    obstacles = scene.contact.get(name)
    if obstacles is None or isinstance(obstacles, Facets):
        raise ValueError(f"{name!r} is no contact set with a rigid obstacle")
    turn, d = jnp.asarray(rotation), scene.mesh.dimension
    shift = jnp.zeros((len(turn), d)) if translation is None else jnp.asarray(translation)
    centre = jnp.zeros(d) if about is None else jnp.asarray(about)
    if turn.shape != (len(turn), d, d) or shift.shape != (len(turn), d) or centre.shape != (d,):
        raise ValueError(
            f"rotation must have shape (T+1, {d}, {d}), translation (T+1, {d}) and about ({d},), "
            f"got {turn.shape}, {shift.shape} and {centre.shape}"
        )
    pairs = _pairs(scene)
    is_member = pairs.members[:, sorted(scene.contact).index(name)]
    if np.any(np.count_nonzero(pairs.members[is_member], axis=1) > 1):
        raise ValueError(f"some pairs of contact set {name!r} stand for another contact set too")
    change = jnp.zeros((len(turn), len(pairs.nodes)))
    for number, (_, obstacle, _) in enumerate(merged_obstacles(scene)):
        rows = np.flatnonzero(is_member & (pairs.owner == number))
        if isinstance(obstacle, Facets) or not rows.size:
            continue
        x = jnp.asarray(scene.mesh.points)[pairs.nodes[rows]]
        nu = jnp.asarray(pairs.normals)[rows]

        def gap(turn: Array, shift: Array, obstacle=obstacle, x=x, nu=nu) -> Array:
            # The obstacle in its place, seen from where the node is against it.
            places = (x - (centre + shift)[None]) @ turn + centre[None]
            return gap_to(obstacle, places, nu @ turn)

        still = gap_to(obstacle, x, nu)
        change = change.at[:, rows].set(jax.vmap(gap)(turn, shift) - still[None])
    return change


def _refuse_frames(scene: Scene) -> None:
    if scene.large_rotation:
        raise ValueError("with large_rotation=True gaps are those of the place, not linearised")


def _pairs(scene: Scene) -> ContactPairs:
    points = as_array(scene.mesh.points)
    return contact_pairs(scene, points, clamped_numbers(scene), np.dtype(points.dtype))


def _met(
    scene: Scene,
    names: list[str],
    slave: np.ndarray,
    facets: Facets,
    x: np.ndarray,
    nodes: np.ndarray,
) -> np.ndarray:
    """Return the gaps (C,) of nodes in the configuration x (N, d); NaN where nothing is met."""
    gaps, ends = np.full(nodes.size, np.nan), end_signs(scene.mesh.cells)
    mesh = dataclasses.replace(scene.mesh, points=x, layout=x)
    try:
        meeting = find_meeting(names, slave, facets, mesh, clamped_numbers(scene))
    except ValueError:  # nothing is met
        return gaps
    normals = directions(x, slave, ends, direction_of(facets), meeting.nodes)
    ways = meet(x[meeting.hit], x[meeting.nodes], normals)[1]
    place = np.searchsorted(nodes, meeting.nodes).clip(max=nodes.size - 1)
    known = nodes[place] == meeting.nodes
    gaps[place[known]] = ways[known]
    return gaps
