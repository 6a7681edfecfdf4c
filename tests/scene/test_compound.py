"""Bowls, obstacles made of others, and obstacles that are met along given directions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, VISCOUS

import jaxcontact as jc

#: A few products and roots of numbers up to 5.
ROUNDING = 2e-14
NODES = np.unique(BLOCK.facets["bottom"])
BOTTOM = BLOCK.points[NODES]
UP = np.array([0.0, 1.0])
FLOOR = jc.HalfSpace(np.array([0.0, -0.1]), UP)
BALL = jc.Ball(np.array([0.7, -2.0]), 1.5)
GROOVE = tuple(jc.HalfSpace(np.array([1.0, -1.5]), np.array([side, 1.0])) for side in (1.0, -1.0))


def system(obstacle, name="bottom", **scene):
    return jc.discretize(jc.Scene(BLOCK, VISCOUS, contact={name: obstacle}, **scene))


def rows(system):
    return np.asarray(system.normals.weights)


def test_ball_can_be_a_bowl():
    centre = np.array([1.0, 1.2])
    bowl = system(jc.Ball(centre, 2.0, inside=True))
    away = BOTTOM - centre
    length = np.linalg.norm(away, axis=1)
    np.testing.assert_allclose(bowl.gap, 2.0 - length, atol=ROUNDING)
    np.testing.assert_allclose(rows(bowl), away / length[:, None], atol=ROUNDING)
    slope = jax.jacobian(lambda c: system(jc.Ball(c, 2.0, inside=True)).gap)(jnp.asarray(centre))
    np.testing.assert_allclose(slope, away / length[:, None], atol=ROUNDING)


def test_union_is_the_nearest_of_two():
    union = system(jc.Union(jc.Union(GROOVE[0], FLOOR), GROOVE[1]))
    single = [system(x) for x in (*GROOVE, FLOOR)]
    gaps = np.stack([x.gap for x in single])
    nearest = gaps.argmin(axis=0)
    np.testing.assert_allclose(union.gap, gaps.min(axis=0), atol=ROUNDING)
    expected = np.stack([rows(x) for x in single])[nearest, np.arange(len(NODES))]
    np.testing.assert_allclose(rows(union), expected, atol=ROUNDING)


def test_every_node_may_touch_all_obstacles_of_a_tuple():
    both = system(GROOVE)
    single = [system(x) for x in GROOVE]
    np.testing.assert_array_equal(both.contact_nodes, np.tile(NODES, 2))
    np.testing.assert_allclose(both.gap, np.concatenate([x.gap for x in single]), atol=ROUNDING)
    once = system((FLOOR, jc.HalfSpace(np.array([3.0, -0.1]), 2.0 * UP)))
    np.testing.assert_array_equal(once.contact_nodes, NODES)


def test_block_in_a_corner_is_carried_by_both_sides():
    floor, wall = jc.HalfSpace(np.zeros(2), UP), jc.HalfSpace(np.zeros(2), np.array([1.0, 0.0]))
    held = jc.solve_static(system((floor, wall), body_force=np.array([-0.03, -0.1])))
    force = np.asarray(held.contact_force)
    np.testing.assert_allclose(force[: len(NODES)].sum(), 0.2, rtol=1e-10)
    np.testing.assert_allclose(force[len(NODES) :].sum(), 0.06, rtol=1e-10)
    assert np.min(held.gap) > -1e-14


def test_gap_along_a_direction_is_the_way_to_the_obstacle():
    tilted = np.array([0.3, 1.0])
    plane = system(jc.Along(jc.HalfSpace(np.array([0.0, -0.8]), tilted), -2.0 * UP))
    np.testing.assert_allclose(rows(plane), np.tile(-UP, (len(NODES), 1)), atol=ROUNDING)
    np.testing.assert_allclose(plane.gap, BOTTOM[:, 1] + 0.8 + 0.3 * BOTTOM[:, 0], atol=ROUNDING)


def height_over(ball, x):
    """The way down from x to a disc"""
    aside = x[:, 0] - ball.center[0]
    return x[:, 1] - ball.center[1] - jnp.sqrt(ball.radius**2 - aside**2)


def test_ray_that_misses_gives_no_pair():
    along = system(jc.Along(BALL))  # None: the outward normal of the bottom is -UP
    aside = np.abs(BOTTOM[:, 0] - BALL.center[0])
    hits = aside < np.sqrt(1.0 - 0.1**2) * BALL.radius
    assert not np.all(hits) or np.max(aside) < BALL.radius
    np.testing.assert_array_equal(along.contact_nodes, NODES[hits])
    np.testing.assert_allclose(along.gap, height_over(BALL, BOTTOM[hits]), atol=ROUNDING)
    small = system(jc.Along(jc.Ball(BALL.center, 0.5)))
    np.testing.assert_array_equal(small.contact_nodes, NODES[np.abs(BOTTOM[:, 0] - 0.7) < 0.49])
    with pytest.raises(ValueError, match=r"none of the 5 nodes .* meets the obstacle of jc.Along"):
        system(jc.Along(BALL, UP))


def test_traced_ray_that_misses_never_touches():
    ball = jc.Ball(np.array([0.5, -0.9]), 0.6)
    gap = jax.jit(lambda c: system(jc.Along(jc.Ball(c, 0.6))).gap)(ball.center)
    met = np.abs(BOTTOM[:, 0] - 0.5) < 0.59
    assert gap.shape == NODES.shape
    np.testing.assert_allclose(gap[met], height_over(ball, BOTTOM[met]), atol=ROUNDING)
    assert np.all(gap[~met] > 1e3)


def test_gap_from_inside_an_obstacle_is_negative():
    deep = system(jc.Along(jc.HalfSpace(np.array([0.0, 0.2]), UP)))
    np.testing.assert_allclose(deep.gap, -0.2, atol=ROUNDING)


def test_gap_along_has_derivatives_by_obstacle_and_nodes():
    hit = np.abs(BOTTOM[:, 0] - 0.7) < 1.4

    def gaps(center, radius, x):
        mesh = BLOCK.with_points(x)
        scene = jc.Scene(mesh, VISCOUS, contact={"bottom": jc.Along(jc.Ball(center, radius), -UP)})
        return jnp.where(hit, jc.discretize(scene).gap, 0.0)

    def exact(center, radius, x):
        return jnp.where(hit, height_over(jc.Ball(center, radius), x[NODES]), 0.0)

    at = (jnp.array([0.7, -2.0]), jnp.asarray(1.5), jnp.asarray(BLOCK.points))

    def first(f):
        return jax.jit(jax.jacobian(f, (0, 1, 2)))(*at)

    def second(f):
        return jax.jit(jax.hessian(lambda *x: jnp.sum(f(*x)), (0, 1, 2)))(*at)

    for order in (first, second):
        found, wanted = order(gaps), order(exact)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-11)


def test_motion_along_normals_of_a_half_space_is_the_usual_one():
    fall = jc.State.of(jc.Scene(BLOCK, VISCOUS), velocity=[0.3, -1.0])
    motions = [
        jc.simulate(jc.prepare(system(x), 0.02), steps=20, initial=fall)
        for x in (FLOOR, jc.Along(FLOOR), jc.Along(FLOOR, -UP), jc.Union(FLOOR, BALL))
    ]
    assert np.any(motions[0].active)
    for motion in motions[1:]:
        np.testing.assert_allclose(motion.displacement, motions[0].displacement, atol=1e-13)


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        ((), r"contact\['bottom'\] is an empty tuple"),
        ((FLOOR, jc.Facets("top")), r"no obstacle: it needs a method signed_distance.*by itself"),
        (jc.Along(FLOOR, np.zeros(2)), r"Along.direction must not be the zero vector"),
        (jc.Along(FLOOR, np.zeros(3)), r"Along.direction must have shape \(2,\)"),
        (jc.Along(jc.Facets("top")), "no obstacle"),
        (jc.Along(jc.Ball(np.zeros(2), -1.0)), r"Ball.radius must be positive"),
        (jc.Union(FLOOR, jc.Ball(np.zeros(3), 1.0)), r"Ball.center must have shape \(2,\)"),
        (jc.Ball(np.array([0.0, 0.0]), 2.0, inside=True), "is a node at the centre"),
    ],
)
def test_wrong_obstacles_are_refused(obstacle, message):
    with pytest.raises(ValueError, match=message):
        system(obstacle)


def test_traced_radius_of_a_part_that_is_none_gives_nan():
    gap = jax.jit(lambda r: system(jc.Union(FLOOR, jc.Ball(BALL.center, r))).gap)(-1.0)
    assert np.all(np.isnan(gap))
