"""What an obstacle says is what its contact pairs hold: its data of now, in any kind of array."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, VISCOUS

import jaxcontact as jc

#: A few products and roots.
ROUNDING = 1e-14
BOTTOM = BLOCK.points[np.unique(BLOCK.facets["bottom"])]


def system(obstacle, **scene):
    return jc.discretize(jc.Scene(BLOCK, VISCOUS, contact={"bottom": obstacle}, **scene))


def test_signed_distance_reads_what_its_closure_holds_now():
    height = {"value": 0.1}
    obstacle = jc.SignedDistance(lambda x: x[1] + height["value"])
    assert system(obstacle).gap[0] == pytest.approx(0.1)
    height["value"] = 0.2
    assert system(obstacle).gap[0] == pytest.approx(0.2)


def test_signed_distance_reads_what_its_object_holds_now():
    class Floor:
        height = 0.1

        def distance(self, x):
            return x[1] + self.height

    floor = Floor()
    obstacle = jc.SignedDistance(floor.distance)
    assert system(obstacle).gap[0] == pytest.approx(0.1)
    floor.height = 0.2
    assert system(obstacle).gap[0] == pytest.approx(0.2)


def disc(x, parameters):
    return jnp.linalg.norm(x - parameters["center"]) - parameters["radius"]


DISC = {"center": jnp.array([0.7, -2.0]), "radius": jnp.asarray(1.5)}


def test_signed_distance_with_parameters_is_the_obstacle_that_it_describes():
    ours, ball = system(jc.SignedDistance(disc, DISC)), system(jc.Ball(**DISC))
    np.testing.assert_allclose(ours.gap, ball.gap, rtol=ROUNDING)
    np.testing.assert_allclose(ours.normals.weights, ball.normals.weights, rtol=ROUNDING)


def test_signed_distance_has_a_derivative_by_its_parameters():
    def total(make, parameters):
        found = system(make(parameters))
        return jnp.sum(found.gap**2) + jnp.sum(found.normals.weights[:, 0])

    ours = jax.jit(jax.grad(lambda p: total(lambda p: jc.SignedDistance(disc, p), p)))(DISC)
    ball = jax.jit(jax.grad(lambda p: total(lambda p: jc.Ball(**p), p)))(DISC)
    for name in DISC:
        assert np.any(ball[name])
        np.testing.assert_allclose(ours[name], ball[name], rtol=1e-12)


@pytest.mark.parametrize("factor", [7.0, 1.02, 0.98])
def test_signed_distance_with_another_slope_than_one_is_refused(factor):
    obstacle = jc.SignedDistance(lambda x: factor * (x[1] + 0.1))
    with pytest.raises(ValueError, match=rf"length {factor:.4g} .*divide the function by"):
        system(obstacle)


def test_signed_distance_of_a_level_set_is_refused():
    def level_set(x):
        return jnp.dot(x, x + 4.0) - 1.0

    with pytest.raises(ValueError, match="divide the function by the length of its gradient"):
        system(jc.SignedDistance(level_set))


@pytest.mark.parametrize("factor", [1.009, 0.991])
def test_signed_distance_of_an_interpolated_grid_may_be_a_little_off(factor):
    found = system(jc.SignedDistance(lambda x: factor * (x[1] + 0.1)))
    np.testing.assert_allclose(found.gap, factor * 0.1)


LISTS = {
    "plane": (lambda s: jc.HalfSpace([0.0, -s], [0.0, 1.0]), lambda s: BOTTOM[:, 1] + s),
    "ball": (
        lambda s: jc.Ball([1, -2 * s], 1),
        lambda s: np.linalg.norm(BOTTOM - [1.0, -2.0 * s], axis=1) - 1.0,
    ),
    "fixed ball": (
        lambda s: jc.Ball(center=[0, -2], radius=1),
        lambda s: np.linalg.norm(BOTTOM - [0.0, -2.0], axis=1) - 1.0,
    ),
}


@pytest.mark.parametrize("name", LISTS)
def test_obstacle_of_lists_is_read_under_jit(name):
    make, expected = LISTS[name]
    for run in (lambda s: system(make(s)).gap, jax.jit(lambda s: system(make(s)).gap)):
        np.testing.assert_allclose(run(1.5), expected(1.5), rtol=ROUNDING)


def test_loads_of_lists_are_read_under_jit():
    def load(force):
        loads = {"traction": {"top": [force, 0.0]}, "body_force": [0.0, -force]}
        return system(jc.HalfSpace([0, -1], [0, 1]), **loads).load

    np.testing.assert_allclose(jax.jit(load)(2.0), load(2.0), atol=ROUNDING)


def test_obstacle_of_lists_can_be_the_argument_of_a_jitted_function():
    gap = jax.jit(lambda ball: system(ball).gap)(jc.Ball([0.0, -2.0], 1.0))
    np.testing.assert_allclose(gap, system(jc.Ball([0, -2], 1)).gap, rtol=ROUNDING)


def test_obstacle_whose_lists_have_the_wrong_length_is_named_under_jit():
    with pytest.raises(ValueError, match=r"Ball.center must have shape \(2,\), got \(3,\)"):
        jax.jit(lambda s: system(jc.Ball([0.0, s, 0.0], 1.0)).gap)(-2.0)
