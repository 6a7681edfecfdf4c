"""Static equilibria of bodies that nothing but their obstacles and each other hold."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import bodies
from support.two_bodies import RUBBER, rotation, stacked, touching

import jaxcontact as jc
from jaxcontact.scene.mesh import cell_volumes

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


def test_block_on_a_plane_stays_where_it_may_slide():
    system = bodies.discretized(bodies.block_scene(bodies.ELASTIC))
    static = jc.solve_static(system)
    weight = np.sum(np.asarray(system.lift(system.load))[:, 1])
    np.testing.assert_allclose(np.sum(static.contact_force), -weight, rtol=1e-9)
    drift = np.sum(np.asarray(system.mass.scalar @ static.displacement)[:, 0])
    assert abs(drift) < 1e-9 * np.max(np.abs(static.displacement))


def test_bar_that_is_pulled_from_its_floor_is_refused():
    with pytest.raises(jc.SolveError, match=r"body around \(0.5\) moves on along \(1\)"):
        jc.solve_static(bar(weight=-GRAVITY))
    top = jax.jit(lambda weight: jc.solve_static(bar(weight=weight)).displacement[-1, 0])
    assert np.isnan(top(-GRAVITY))
    np.testing.assert_allclose(top(GRAVITY), compressed(1.0), rtol=1e-12)


@pytest.mark.parametrize("gap", [0.0, 1e-3, 1e5])
def test_bar_falls_to_its_floor_from_any_height(gap):
    static = jc.solve_static(bar(gap=gap))
    expected = compressed(np.asarray(bar().points), gap=gap)
    np.testing.assert_allclose(static.displacement, expected, atol=1e-12 * (1.0 + gap))


def test_bar_without_contact_needs_a_load_in_balance():
    mesh = jc.meshes.interval(1.0, h=0.2)
    material = jc.KelvinVoigt(young=50.0, poisson=0.0)

    def pulled(right):
        traction = {"left": np.array([-3.0]), "right": np.array([right])}
        return jc.solve_static(jc.discretize(jc.Scene(mesh, material, traction=traction)))

    stretched = 3.0 / 50.0 * (mesh.points - 0.5)
    np.testing.assert_allclose(pulled(3.0).displacement, stretched, atol=1e-12)
    with pytest.raises(jc.SolveError, match=r"moves on along \(-1\)"):
        pulled(2.0)


def test_body_that_slides_off_a_slope_is_refused():
    scene = bodies.block_scene(bodies.ELASTIC)
    force = np.array([0.2, -1.0])
    with pytest.raises(jc.SolveError, match=r"no equilibrium .*moves on along \(1, .*clamp"):
        jc.solve_static(bodies.discretized(replace(scene, body_force=force)))


def round_body(d):
    """A disc, or a half ball with its round side below, with the lowest part of its surface"""
    mesh = jc.meshes.disc(1.0, h=0.25) if d == 2 else jc.meshes.half_ball(1.0, h=0.5)
    lowest = mesh.points[:, -1].min()
    return mesh.with_set("low", lambda x, n: (n[:, -1] < -0.5) & (x[:, -1] < lowest + 0.5))


@pytest.mark.parametrize("d", [2, 3])
def test_round_body_on_a_plane_carries_its_weight(d):
    mesh, up = round_body(d), np.eye(d)[-1]
    plane = jc.HalfSpace(-1.01 * up, up)
    scene = jc.Scene(mesh, RUBBER, contact={"low": plane}, body_force=-1e-2 * up)
    system = jc.discretize(scene)
    static = jc.solve_static(system)
    volume = np.sum(cell_volumes(mesh.points, mesh.cells))
    np.testing.assert_allclose(np.sum(static.contact_force), 1e-2 * volume, rtol=1e-9)
    drift = np.asarray(system.mass.scalar @ static.displacement).sum(axis=0)
    np.testing.assert_allclose(drift[:-1], 0.0, atol=1e-9 * abs(drift[-1]))


@pytest.mark.parametrize(
    ("lower", "upper", "d", "angle"), [(1 / 3, 1 / 4, 2, 0.4), (1 / 2, 1 / 3, 3, 0.0)]
)
def test_free_blocks_under_equal_tractions_pass_the_patch_test(lower, upper, d, angle):
    pressure, up = 0.1, rotation(d, angle) @ np.eye(d)[-1]
    traction = {"upper/top": -pressure * up, "lower/bottom": pressure * up}
    scene = touching(stacked(lower, upper, d, angle=angle, jitter=0.1), traction=traction)
    static = jc.solve_static(jc.discretize(scene))
    np.testing.assert_allclose(static.contact_pressure, pressure, rtol=1e-9)
    # Uniform stress: the displacement is affine in each body.
    x, y = scene.mesh.points, np.asarray(static.displacement)
    for body in (0, 1):
        nodes = scene.mesh.components() == body
        basis = np.concatenate([x[nodes], np.ones((nodes.sum(), 1))], axis=1)
        fit = basis @ np.linalg.lstsq(basis, y[nodes], rcond=None)[0]
        np.testing.assert_allclose(fit, y[nodes], atol=1e-9 * np.max(np.abs(y)))


def test_each_body_is_asked_for_its_own_equilibrium():
    scene = touching(
        stacked(1 / 3, 1 / 4, gap=0.01),
        clamped=("lower/bottom",),
        body_force=np.array([0.0, -0.01]),
    )
    static = jc.solve_static(jc.discretize(scene))
    np.testing.assert_allclose(np.sum(static.contact_force), 0.01, rtol=1e-9)
    tilted = replace(scene, body_force=np.array([0.001, -0.01]))
    with pytest.raises(jc.SolveError, match=r"the body around \(0.5, 1.51\) moves on along \(1"):
        jc.solve_static(jc.discretize(tilted))


SQUARE = jc.meshes.rectangle((1.0, 1.0), h=1 / 3)


@jax.jit
def sag(values):
    """How a block stands on a plane, on which it may slide"""
    young, points, gap, weight = values
    contact = {"bottom": jc.HalfSpace(jnp.stack([0.0 * gap, -gap]), np.array([0.0, 1.0]))}
    material = jc.KelvinVoigt(young=young, poisson=0.3)
    force = jnp.stack([0.0 * weight, -weight])
    scene = jc.Scene(SQUARE.with_points(points), material, contact=contact, body_force=force)
    static = jc.solve_static(jc.discretize(scene))
    return jnp.sum(static.displacement**2) + jnp.sum(static.contact_pressure**2)


def test_derivatives_of_a_free_block_are_difference_quotients():
    rng = np.random.default_rng(0)
    values = tuple(jnp.asarray(x) for x in (1.0, SQUARE.points, 0.01, 1e-2))
    gradient = jax.jit(jax.grad(sag))(values)
    # Positions by less, so that all contact nodes stay closed.
    sizes = (1.0, 0.003, 0.01, 1e-2)
    direction = [
        s * jnp.asarray(rng.uniform(-1.0, 1.0, x.shape)) for s, x in zip(sizes, values, strict=True)
    ]
    slope = sum(jnp.vdot(g, v) for g, v in zip(gradient, direction, strict=True))
    errors = []
    for step in (0.2, 0.1, 0.05):
        ahead, behind = (
            sag(tuple(x + sign * step * v for x, v in zip(values, direction, strict=True)))
            for sign in (1.0, -1.0)
        )
        errors.append(abs((ahead - behind) / (2.0 * step) - slope))
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.2)
    assert errors[-1] < 1e-2 * abs(slope)


def test_static_of_a_free_body_works_in_float32():
    system = bodies.discretized(bodies.block_scene(bodies.ELASTIC))
    single = jc.discretize(bodies.block_scene(bodies.ELASTIC), dtype=jnp.float32)
    static, expected = jc.solve_static(single), jc.solve_static(system)
    size = np.max(np.abs(expected.displacement))
    np.testing.assert_allclose(static.displacement, expected.displacement, atol=1e-3 * size)


def test_static_of_a_free_body_needs_exact_contact():
    with pytest.raises(ValueError, match="exact contact only; clamp"):
        jc.solve_static(bar(), contact_solver=jc.RelaxedContact(1.0))


def test_static_of_a_free_body_says_when_its_contact_was_not_solved():
    system = bodies.discretized(bodies.block_scene(bodies.ELASTIC))
    with pytest.raises(jc.SolveError, match=r"static contact was not solved; .*SemismoothNewton"):
        jc.solve_static(system, contact_solver=jc.ProjectedGaussSeidel(max_sweeps=5))


@pytest.mark.parametrize("solver", [jc.NestedDissection(leaf_size=8), jc.ConjugateGradient()])
def test_linear_solvers_agree_on_the_static_of_a_free_body(solver):
    system = bodies.discretized(bodies.block_scene(bodies.ELASTIC))
    expected = jc.solve_static(system, linear_solver=jc.Dense()).displacement
    found = jc.solve_static(system, linear_solver=solver).displacement
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.max(np.abs(expected)))


def test_static_of_a_free_body_is_that_of_its_reduced_model():
    system = bodies.discretized(bodies.block_scene(bodies.ELASTIC))
    expected = jc.solve_static(system).displacement
    found = jc.solve_static(jc.reduce(system, modes=20)).displacement
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_ball_on_a_plane_carries_the_load_of_hertz():
    depths, loads = np.array([0.0025, 0.005, 0.01]), []
    system = jc.discretize(jc.scenes.ball_on_plane(h=1 / 12))
    modulus = 1.0 / (1.0 - 0.3**2)
    for depth in depths:
        static = jc.solve_static(system.with_gap(system.gap - depth))
        loads.append(float(np.sum(static.contact_force)))
        radius = (0.75 * loads[-1] / modulus) ** (1 / 3)
        peak = 1.5 * loads[-1] / (np.pi * radius**2)
        assert float(np.max(static.contact_pressure)) == pytest.approx(peak, rel=0.06)
    exponents = np.diff(np.log(loads)) / np.diff(np.log(depths))
    np.testing.assert_allclose(exponents, 1.5, atol=0.03)
    # The mesh and the clamp, one radius away, make it stiffer than half space and parabola.
    excess = np.array(loads) / (4 / 3 * modulus * depths**1.5) - 1.0
    assert np.all((excess > 0.04) & (excess < 0.10))
