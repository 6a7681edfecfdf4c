"""Each body of a mesh keeps its own mass when that of its contact nodes moves inside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import bodies

import jaxcontact as jc
from jaxcontact.schemes.mass_redistribution import redistribute

#: Sums of a few hundred products, relative to the largest of them.
ROUNDING = 1e-13
TURN = np.array([[0.8, -0.6], [0.6, 0.8]])


def two_bodies(sets=("left/bottom", "right/bottom")):
    """A block, and another of half its size that is turned and heavy, on one plane"""
    left, right = jc.meshes.rectangle((2.0, 1.0), h=0.25), jc.meshes.rectangle((1.0, 1.0), h=0.25)
    mesh = jc.Mesh.from_arrays(
        np.concatenate([left.points, right.points @ TURN.T + np.array([[4.0, 0.5]])]),
        np.concatenate([left.cells, right.cells + left.n_nodes]),
        {
            "left/bottom": left.facets["bottom"],
            "right/bottom": right.facets["bottom"] + left.n_nodes,
        },
        {
            "left": np.arange(left.n_cells),
            "right": left.n_cells + np.arange(right.n_cells),
        },
    )
    heavy = jc.KelvinVoigt(young=100.0, poisson=0.3, density=7.0)
    plane = jc.HalfSpace(np.array([0.0, -0.1]), np.array([0.0, 1.0]))
    return jc.Scene(
        mesh,
        {"left": bodies.ELASTIC, "right": heavy},
        contact={name: plane for name in sets},
    )


def moments(system, matrix, body):
    """Kinetic energies of the rigid motions of one body, (3, 3)"""
    x = np.asarray(system.points)
    motions = [np.tile([1.0, 0.0], (len(x), 1)), np.tile([0.0, 1.0], (len(x), 1))]
    motions.append(np.stack([-x[:, 1], x[:, 0]], axis=1))
    fields = np.stack([(body[:, None] * motion).ravel() for motion in motions], axis=1)
    return fields.T @ matrix @ fields


@pytest.mark.parametrize("sets", [("left/bottom", "right/bottom"), ("right/bottom",)])
def test_redistributed_mass_keeps_mass_centre_and_inertia_of_each_body(sets):
    scene = two_bodies(sets)
    system = bodies.discretized(scene)
    moved = redistribute(system).to_symmetric(system.n_nodes).to_scipy().toarray()
    labels = scene.mesh.components()
    assert labels.max() == 1
    for label in (0, 1):
        before = moments(system, system.mass.to_scipy().toarray(), labels == label)
        after = moments(system, moved, labels == label)
        np.testing.assert_allclose(after, before, atol=ROUNDING * np.max(np.abs(before)))


def test_redistributed_mass_moves_nothing_between_bodies():
    scene = two_bodies()
    system = bodies.discretized(scene)
    moved = redistribute(system).to_symmetric(system.n_nodes).to_scipy().toarray()
    first = np.repeat(scene.mesh.components() == 0, 2)
    np.testing.assert_array_equal(moved[first][:, ~first], 0.0)


def test_redistributed_mass_of_two_bodies_is_traceable():
    mesh = two_bodies().mesh

    @jax.jit
    def entries(scale):
        scene = two_bodies()
        moved = jc.Scene(mesh.with_points(scale * mesh.points), scene.material, (), scene.contact)
        return redistribute(jc.discretize(moved)).blocks

    expected = redistribute(bodies.discretized(two_bodies())).blocks
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(entries(1.0), expected, atol=ROUNDING * scale)


def test_redistributed_mass_has_a_derivative_by_positions_without_optimisation():
    # A maximum has a derivative only where its argument equals it: a compiler that rounds the
    # argument in two ways finds no such entry, and a derivative through it is NaN.
    mesh = jc.meshes.rectangle((1.0, 0.5), h=0.25)
    plane = jc.HalfSpace(np.array([0.0, -1.0]), np.array([0.0, 1.0]))

    def mean_mass(points):
        scene = jc.Scene(mesh.with_points(points), bodies.ELASTIC, contact={"bottom": plane})
        return jnp.mean(redistribute(jc.discretize(scene)).blocks ** 2)

    gradient = jax.jit(jax.grad(mean_mass), compiler_options={"xla_backend_optimization_level": 0})
    for seed in range(10):
        shift = np.random.default_rng(seed).normal(size=2)
        assert np.all(np.isfinite(gradient(jnp.asarray(0.37 * mesh.points @ TURN.T + shift))))
