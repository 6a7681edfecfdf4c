"""Actuators: linear maps from parameters to controls and their inner products."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.tree_util import Partial

import jaxcontact as jc

STEPS = 7
DT = 0.1


def plate(**loads):
    mesh = jc.meshes.rectangle((1.0, 0.5), h=0.2)
    material = jc.KelvinVoigt(young=1.0, poisson=0.3, density=1.0)
    scene = jc.Scene(mesh=mesh, material=material, clamped=("bottom",), **loads)
    return mesh, jc.discretize(scene)


@pytest.fixture(scope="module")
def scene():
    return plate()


ACTUATORS = {
    "all nodes": lambda mesh, system: jc.actuator(system, STEPS),
    "region": lambda mesh, system: jc.actuator(
        system, STEPS, nodes=np.asarray(mesh.points)[:, 0] > 0.5, intervals=3
    ),
    "direction": lambda mesh, system: jc.actuator(
        system, STEPS, nodes=[3, 1, 8], direction=[0.0, -2.0], intervals=[0, 1, 5]
    ),
    "boundary": lambda mesh, system: jc.boundary_actuator(
        system, STEPS, mesh.facets["top"], intervals=2
    ),
    "boundary pressure": lambda mesh, system: jc.boundary_actuator(
        system, STEPS, mesh.facets["top"], direction=[0.0, -1.0], intervals=2
    ),
}
each_actuator = pytest.mark.parametrize("make", ACTUATORS.values(), ids=list(ACTUATORS))
VOLUME = ("all nodes", "region", "direction")
each_volume_actuator = pytest.mark.parametrize(
    "make", [ACTUATORS[name] for name in VOLUME], ids=VOLUME
)


def random_like(array, seed):
    return jax.random.normal(jax.random.key(seed), array.shape, array.dtype)


@each_volume_actuator
def test_actuator_inner_product_is_the_l2_product_of_the_controls(scene, make):
    mesh, system = scene
    actuator = make(mesh, system)
    p, q = (random_like(actuator.zeros(), seed) for seed in (0, 1))
    product = actuator.inner_product(system, DT)
    expected = jc.control_dot(system, DT, actuator(p), actuator(q))
    assert float(product.dot(p, q)) == pytest.approx(float(expected), rel=1e-12)


@each_actuator
@pytest.mark.parametrize("is_lumped", [False, True])
def test_actuator_gradient_represents_the_derivative(scene, make, is_lumped):
    mesh, system = scene
    actuator = make(mesh, system)
    derivative, q = (random_like(actuator.zeros(), seed) for seed in (2, 3))
    product = actuator.inner_product(system, DT, is_lumped=is_lumped)
    gradient = product.riesz(derivative)
    assert gradient.shape == derivative.shape
    assert float(product.dot(gradient, q)) == pytest.approx(float(jnp.vdot(derivative, q)))


def test_actuator_acts_on_its_region_and_intervals_only(scene):
    mesh, system = scene
    actuator = ACTUATORS["direction"](mesh, system)
    control = actuator(jnp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]))
    assert control.shape == (STEPS, system.n_nodes, 2)
    np.testing.assert_array_equal(control[0, jnp.array([3, 1, 8])], [[0, -2], [0, -4], [0, -6]])
    np.testing.assert_array_equal(control[1:5, 1, 1], [-10.0] * 4)
    np.testing.assert_array_equal(control[5:, 8, 1], [-18.0] * 2)
    assert int(jnp.sum(jnp.any(control != 0.0, axis=(0, 2)))) == 3


def test_boundary_actuator_loads_the_nodes_like_a_traction():
    traction = np.array([0.3, -0.7])
    mesh, system = plate(traction={"top": traction})
    actuator = jc.boundary_actuator(system, STEPS, mesh.facets["top"], intervals=1)
    control = actuator(actuator.zeros() + traction[None, None, :])
    np.testing.assert_allclose(system.control_load(control[-1]), system.load, atol=1e-12)


def test_boundary_actuator_norm_is_the_l2_norm_of_the_traction(scene):
    mesh, system = scene
    actuator = jc.boundary_actuator(system, STEPS, mesh.facets["top"], intervals=2)
    ones = actuator.zeros() + 1.0
    # Two components, length 1, duration 0.7.
    product = actuator.inner_product(system, DT)
    assert float(product.dot(ones, ones)) == pytest.approx(2.0 * 1.0 * 0.7)


def _distance(system, target, u):
    return 0.5 * jc.control_dot(system, DT, u - target, u - target)


def tracking(system):
    return Partial(_distance, system, random_like(jnp.zeros((STEPS, system.n_nodes, 2)), 4))


@pytest.mark.parametrize("name", ["region", "boundary pressure"])
@pytest.mark.parametrize(
    "method",
    [
        jc.SteepestDescent(),
        jc.LBFGS(memory=5),
        jc.NewtonCG(forcing=1e-6),
        # The boundary has a curvature of about 1 / h.
        jc.Optax(optax.sgd(0.02, momentum=0.9)),
    ],
    ids=lambda method: type(method).__name__,
)
def test_optimize_over_actuators_finds_the_best_admissible_control(scene, name, method):
    mesh, system = scene
    actuator = ACTUATORS[name](mesh, system)
    objective = tracking(system)
    result = jc.optimize(
        objective,
        actuator.zeros(),
        method=method,
        system=system,
        dt=DT,
        controls=actuator,
        tolerance=1e-4,
        iterations=300,
    )
    derivative = jax.jit(jax.grad(lambda p: objective(actuator(p))))
    first = float(jnp.max(jnp.abs(derivative(actuator.zeros()))))
    assert float(jnp.max(jnp.abs(derivative(result.parameters)))) < 1e-3 * first
    np.testing.assert_array_equal(result.control, actuator(result.parameters))


def test_optimize_over_a_volume_actuator_is_one_step_for_the_distance(scene):
    # In the pulled-back product the Hessian of the L2 distance is the identity.
    mesh, system = scene
    actuator = ACTUATORS["region"](mesh, system)
    result = jc.optimize(
        tracking(system),
        actuator.zeros(),
        method=jc.SteepestDescent(),
        system=system,
        dt=DT,
        controls=actuator,
        iterations=1,
    )
    norms = result.history.gradient_norm
    assert norms[1] < 1e-10 * norms[0]


def test_optimize_bounds_the_parameters_of_an_actuator(scene):
    mesh, system = scene
    actuator = ACTUATORS["direction"](mesh, system)
    result = jc.optimize(
        tracking(system),
        actuator.zeros(),
        system=system,
        dt=DT,
        controls=actuator,
        bounds=(-0.1, 0.1),
        tolerance=1e-8,
    )
    assert result.status is jc.Ending.CONVERGED
    assert float(jnp.max(jnp.abs(result.parameters))) == 0.1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"nodes": [1, 1]}, "different numbers"),
        ({"nodes": [10_000]}, "different numbers"),
        ({"nodes": []}, "at least one node"),
        ({"nodes": np.ones(3, bool)}, "a mask of nodes"),
        ({"direction": [0.0, 0.0]}, "not zero"),
        ({"direction": [1.0]}, "2 components"),
        ({"intervals": STEPS + 1}, "do not fit"),
        ({"intervals": [1, 3]}, "rise from 0"),
    ],
)
def test_actuator_refuses_what_does_not_fit(scene, options, message):
    _, system = scene
    with pytest.raises(ValueError, match=message):
        jc.actuator(system, STEPS, **options)
