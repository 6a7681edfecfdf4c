"""The error of the linearised gap, and obstacles that turn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, VISCOUS
from support.two_bodies import round_bodies, stacked, touching

import jaxcontact as jc

UP = np.array([0.0, 1.0])
NODES = np.unique(BLOCK.facets["bottom"])
STEPS, DT = 10, 0.02


def flight(scene, velocity, **options):
    stepper = jc.prepare(jc.discretize(scene), DT)
    initial = jc.State.of(scene, velocity=velocity)
    return jc.simulate(stepper, steps=STEPS, initial=initial, **options)


def test_gap_to_a_plane_is_exact():
    plane = jc.HalfSpace(np.array([0.0, -0.1]), np.array([0.2, 1.0]))
    scene = jc.Scene(BLOCK, VISCOUS, contact={"bottom": plane})
    motion = flight(scene, [1.0, -2.0])
    assert np.any(motion.active)
    assert np.max(jc.linearization_error(scene, motion)) < 1e-14


@pytest.mark.parametrize("save_every", [1, 5])
def test_error_over_a_ball_is_that_of_its_curvature(save_every):
    ball = jc.Ball(np.array([0.9, -3.0]), 2.5)
    scene = jc.Scene(BLOCK, VISCOUS, contact={"bottom": ball})
    motion = flight(scene, [1.5, 0.3], save_every=save_every)
    moved = BLOCK.points[NODES] + STEPS * DT * np.array([1.5, 0.3])
    exact = np.linalg.norm(moved - ball.center, axis=1) - ball.radius
    expected = np.abs(exact - np.asarray(motion.gap[-1]))
    np.testing.assert_allclose(jc.linearization_error(scene, motion), expected, atol=1e-13)
    assert np.max(expected) > 1e-3


def test_gap_of_an_obstacle_that_moves_is_that_to_its_place():
    ball = jc.Ball(np.array([0.9, -3.0]), 2.5)
    scene = jc.Scene(BLOCK, VISCOUS, contact={"bottom": ball})
    stepper = jc.prepare(jc.discretize(scene), DT)
    way = jc.sample(lambda t: jnp.stack([1.5 * t, 0.3 * t]), stepper, STEPS, levels=True)
    motion = jc.simulate(stepper, schedule=jc.Schedule(obstacle={"bottom": way}))
    moved = BLOCK.points[NODES] - np.asarray(way[-1])
    exact = np.linalg.norm(moved - ball.center, axis=1) - ball.radius
    expected = np.abs(exact - np.asarray(motion.gap[-1]))
    np.testing.assert_allclose(jc.linearization_error(scene, motion), expected, atol=1e-13)


def test_gap_between_flat_bodies_is_exact_and_between_round_ones_is_not():
    flat = touching(stacked(0.5, 0.25, gap=0.05), along=-UP)
    motion = flight(flat, {"upper": [0.2, -0.1]})
    assert np.max(jc.linearization_error(flat, motion)) < 1e-14
    mesh = round_bodies()
    scene = jc.Scene(mesh, VISCOUS, contact={"ball/contact": jc.Facets("floor/contact", -UP)})
    motion = flight(scene, {"ball": [0.5, 0.0]})
    error = jc.linearization_error(scene, motion)
    # The way down to a circle of radius 1.5 from a node that has moved aside by 0.1; the polygon of
    # its mesh is as far from it as h^2 / 8 R.
    x = mesh.points[jc.discretize(scene).contact_nodes, 0]
    near = np.abs(x) < 0.3
    expected = np.abs(np.sqrt(1.5**2 - (x + 0.1) ** 2) - np.sqrt(1.5**2 - x**2))
    np.testing.assert_allclose(error[near], expected[near], atol=0.02)
    assert np.max(error[near]) > 0.02


def test_turned_plane_is_where_it_has_turned_to():
    plane = jc.HalfSpace(np.array([0.0, -0.1]), UP)
    wall = jc.HalfSpace(np.array([-0.2, 0.0]), np.array([1.0, 0.0]))
    scene = jc.Scene(BLOCK, VISCOUS, contact={"bottom": plane, "left": wall})
    angles = jnp.linspace(0.0, -0.1, STEPS + 1)
    about, shift = np.array([2.0, -0.1]), np.array([0.0, 0.03])

    def gaps(angles):
        c, s = jnp.cos(angles), jnp.sin(angles)
        turn = jnp.stack([jnp.stack([c, -s], axis=1), jnp.stack([s, c], axis=1)], axis=1)
        return jc.turned_gap(scene, "bottom", turn, np.tile(shift, (STEPS + 1, 1)), about)

    change = gaps(angles)
    system = jc.discretize(scene)
    x = BLOCK.points[system.contact_nodes]
    normal = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    exact = np.einsum("ti,cti->tc", normal, x[:, None] - (about + shift)[None, None])
    is_bottom = np.asarray(system.directions)[:, 1] < -0.5
    gap = np.asarray(system.gap)[None] + np.asarray(change)
    np.testing.assert_allclose(gap[:, is_bottom], exact[:, is_bottom], atol=1e-14)
    assert not np.any(change[:, ~is_bottom])
    slope = jax.jacobian(lambda a: gaps(a * angles)[-1])(1.0)
    step = 1e-6
    central = (gaps((1 + step) * angles)[-1] - gaps((1 - step) * angles)[-1]) / (2 * step)
    np.testing.assert_allclose(slope, central, atol=1e-9)

    stepper = jc.prepare(system, DT)
    motion = jc.simulate(stepper, schedule=jc.Schedule(gap=change))
    ledger = jc.energy(stepper, motion)
    assert np.any(motion.active)
    assert np.min(motion.gap) > -1e-14
    assert np.max(np.abs(ledger.residual)) < 1e-12 * np.max(ledger.total)


def test_what_cannot_be_told_is_refused():
    scene = touching(stacked(0.5, 0.5))
    motion = flight(scene, None)
    with pytest.raises(ValueError, match="no contact set with a rigid obstacle"):
        jc.turned_gap(scene, "upper/bottom", np.zeros((3, 2, 2)))
    floor = jc.Scene(BLOCK, VISCOUS, contact={"bottom": jc.HalfSpace(-UP, UP)})
    with pytest.raises(ValueError, match=r"rotation must have shape \(T\+1, 2, 2\)"):
        jc.turned_gap(floor, "bottom", np.zeros((3, 2)))
    with pytest.raises(ValueError, match="needs concrete values"):
        jax.jit(lambda t: jc.linearization_error(scene, t))(motion)
