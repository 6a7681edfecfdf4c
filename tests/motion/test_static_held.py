"""Static equilibria of bodies that nothing but their obstacles hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import bodies

import jaxcontact as jc

GRAVITY = 3.0


def bar(young=50.0, weight=GRAVITY, gap=0.1):
    mesh = jc.meshes.interval(1.0, h=0.2)
    floor = jc.HalfSpace(jnp.stack([-gap]), np.array([1.0]))
    material = jc.KelvinVoigt(young=young, poisson=0.0)
    body_force = jnp.stack([-weight])
    return jc.discretize(jc.Scene(mesh, material, contact={"left": floor}, body_force=body_force))


def compressed(x, young=50.0, weight=GRAVITY, gap=0.1):
    """A bar stands on the floor: E u'' = w, u(0) = -gap, u'(1) = 0."""
    return -gap - weight / young * (x - 0.5 * x**2)


def test_bar_on_its_floor_carries_its_weight():
    system = bar()
    static = jc.solve_static(system)
    np.testing.assert_allclose(static.contact_force, GRAVITY, rtol=1e-12)
    expected = compressed(np.asarray(system.points))
    np.testing.assert_allclose(static.displacement, expected, atol=1e-13)


def test_bar_on_its_floor_has_the_derivatives_of_the_formula():
    x = np.asarray(bar().points)

    def top(young, weight, gap):
        return jc.solve_static(bar(young, weight, gap)).displacement[-1, 0]

    at = (50.0, GRAVITY, 0.1)
    expected = jax.grad(lambda *values: compressed(x[-1, 0], *values), (0, 1, 2))(*at)
    np.testing.assert_allclose(jax.jit(jax.grad(top, (0, 1, 2)))(*at), expected, rtol=1e-9)


def test_block_in_a_corner_rests_on_both_planes():
    mesh = bodies.BLOCK
    planes = {
        "bottom": jc.HalfSpace(np.array([0.0, -0.1]), np.array([0.0, 1.0])),
        "left": jc.HalfSpace(np.array([-0.1, 0.0]), np.array([1.0, 0.0])),
    }
    force = np.array([-1.0, -2.0])
    static = jc.solve_static(
        bodies.discretized(jc.Scene(mesh, bodies.ELASTIC, contact=planes, body_force=force))
    )
    normals = np.repeat([[0.0, 1.0], [1.0, 0.0]], [5, 3], axis=0)
    np.testing.assert_allclose(static.contact_force @ normals, -2.0 * force, rtol=1e-10)
    assert np.min(static.gap) > -1e-12
    assert np.max(np.abs(static.gap * static.contact_force)) < 1e-12


def test_block_on_a_plane_may_slide_and_is_refused():
    scene = bodies.block_scene(bodies.ELASTIC)
    with pytest.raises(ValueError, match=r"holds 2 of 3 rigid motions.*clamp"):
        jc.solve_static(bodies.discretized(scene))


def test_bar_that_is_pulled_from_its_floor_is_refused():
    with pytest.raises(ValueError, match="holds 0 of 1"):
        jc.solve_static(bar(weight=-GRAVITY))
    top = jax.jit(lambda weight: jc.solve_static(bar(weight=weight)).displacement[-1, 0])
    assert np.isnan(top(-GRAVITY))
    np.testing.assert_allclose(top(GRAVITY), compressed(1.0), rtol=1e-12)
