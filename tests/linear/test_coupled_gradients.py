"""Conjugate gradients where contact rows share unknowns: two bodies, and two sets at a corner."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.two_bodies import RUBBER, stacked, thrown, touching

import jaxcontact as jc
from jaxcontact.linear.pair_gram import pair_gram
from jaxcontact.system.sparse import ContactNormals

#: Both solvers are exact up to a relative residual of 1e-12 per step.
AGREEMENT = 1e-9
SINGLE_AGREEMENT = 1e-3
STEPS, DT = 30, 0.1
DENSE, CG = jc.Dense(), jc.ConjugateGradient()


def corner(dtype=jnp.float64):
    """A block that is thrown into a corner, whose node has a pair with the floor and the wall"""
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / 3)
    floor = jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.0, 1.0]))
    wall = jc.HalfSpace(np.array([-0.01, 0.0]), np.array([1.0, 0.0]))
    scene = jc.Scene(mesh, RUBBER, contact={"bottom": floor, "left": wall})
    speed = jnp.broadcast_to(jnp.array([-0.1, -0.2]), mesh.points.shape)
    return jc.discretize(scene, dtype), jc.State(jnp.zeros_like(speed), speed)


@cache
def problem(name, dtype=jnp.float64):
    if name == "corner":
        system, initial = corner(dtype)
    else:
        d = int(name[0])
        meshes = {1: (1 / 5, 1 / 4), 2: (1 / 3, 1 / 4), 3: (1 / 2, 1 / 3)}
        scene = touching(stacked(*meshes[d], d, gap=0.01))
        system = jc.discretize(scene, dtype)
        initial = thrown(scene, "upper", [*[0.05] * (d - 1), -0.2])
    shape = (STEPS, system.n_nodes, system.dimension)
    control = 0.05 * jnp.sin(jnp.arange(np.prod(shape), dtype=dtype)).reshape(shape)
    cast = jax.tree.map(lambda x: x.astype(dtype), initial)
    return system, cast, control


@jax.jit
def run(stepper, initial, control):
    def final(u):
        trajectory = jc.simulate(stepper, u, initial=initial)
        return jnp.sum(trajectory.displacement**2), trajectory

    return jax.value_and_grad(final, has_aux=True)(control)


def assert_close(actual, expected, tolerance=AGREEMENT):
    actual, expected = np.asarray(actual), np.asarray(expected)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("name", ["1D", "2D", pytest.param("3D", marks=pytest.mark.slow), "corner"])
def test_conjugate_gradient_gives_motion_and_gradient_of_dense_on_coupled_rows(name):
    system, initial, control = problem(name)
    (_, dense), dense_slope = run(jc.prepare(system, DT, linear_solver=DENSE), initial, control)
    (_, cg), slope = run(jc.prepare(system, DT, linear_solver=CG), initial, control)
    n_active = np.count_nonzero(np.any(dense.active, axis=1))
    assert 5 < n_active < STEPS
    np.testing.assert_array_equal(cg.status, jc.Status.CONVERGED)
    np.testing.assert_array_equal(cg.active, dense.active)
    for field in ("displacement", "velocity", "gap", "contact_impulse"):
        assert_close(getattr(cg, field), getattr(dense, field))
    assert_close(slope, dense_slope)


def test_conjugate_gradient_meets_two_bodies_in_float32():
    system, *data = problem("2D")
    (_, double), slope = run(jc.prepare(system, DT, linear_solver=DENSE), *data)
    system, initial, control = problem("2D", jnp.float32)
    single, single_slope = run(jc.prepare(system, DT, linear_solver=CG), initial, control)
    assert single[1].displacement.dtype == jnp.float32
    np.testing.assert_array_equal(single[1].status, jc.Status.CONVERGED)
    assert_close(single[1].displacement, double.displacement, SINGLE_AGREEMENT)
    assert_close(single_slope, slope, SINGLE_AGREEMENT)


@pytest.mark.slow
def test_conjugate_gradient_differentiates_by_material_and_positions_of_two_bodies():
    mesh = stacked(1 / 2, 1 / 3, gap=0.01)

    def misfit(young, points, solver):
        material = jc.KelvinVoigt(young=young, poisson=0.3)
        scene = touching(mesh.with_points(points), material=material)
        stepper = jc.prepare(jc.discretize(scene), DT, linear_solver=solver)
        motion = jc.simulate(stepper, steps=10, initial=thrown(scene, "upper", [0.0, -0.2]))
        return jnp.sum(motion.displacement**2)

    values = (1.0, jnp.asarray(mesh.points))
    slope = jax.jit(jax.grad(misfit, (0, 1)), static_argnums=2)
    for cg, dense in zip(slope(*values, CG), slope(*values, DENSE), strict=True):
        assert_close(cg, dense)


def test_gram_of_equal_rows_shares_the_multiplier():
    # The same row three times and another one: the sum of the three is determined.
    weights = jnp.asarray([[1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [2.0, -1.0]])
    unknowns = np.array([[0, 1], [0, 1], [0, 1], [1, 2]], np.int32)
    preconditioner = jnp.asarray([1.0, 2.0, 3.0])
    gram = pair_gram(ContactNormals(weights, unknowns), preconditioner)
    rhs = gram.matrix @ jnp.asarray([1.0, 2.0, 3.0, 4.0])
    found = gram.inverse_on(jnp.ones(4, bool))(rhs)
    np.testing.assert_allclose(gram.matrix @ found, rhs, rtol=1e-9)
    np.testing.assert_allclose([found[:3].sum(), found[3]], [6.0, 4.0], rtol=1e-6)
    np.testing.assert_allclose(found[:3], 2.0, rtol=1e-4)


def test_gram_of_separate_rows_is_its_diagonal():
    weights, unknowns = jnp.asarray([[1.0, 2.0], [3.0, 1.0]]), np.array([[0, 1], [2, 3]], np.int32)
    gram = pair_gram(ContactNormals(weights, unknowns), jnp.asarray([1.0, 2.0, 3.0, 4.0]))
    assert gram.matrix is None
    np.testing.assert_allclose(gram.diagonal, [9.0, 31.0])
    only_second = gram.inverse_on(jnp.asarray([False, True]))(jnp.asarray([5.0, 62.0]))
    np.testing.assert_allclose(only_second, [0.0, 2.0])
