"""Stress: exact states, the energy of the stiffness matrix, averages, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

MATERIAL = jc.KelvinVoigt(young=2.0, poisson=0.3, bulk_viscosity=0.7, shear_viscosity=0.4)
FIRST, SECOND = MATERIAL.elastic_lame()
MESHES = {
    1: jc.meshes.interval(1.0, h=0.25),
    2: jc.meshes.rectangle((1.0, 0.5), h=0.25),
    3: jc.meshes.box((1.0, 1.0, 0.5), h=0.5),
}
GRADIENT = np.array([[0.1, 0.3, -0.2], [0.05, -0.4, 0.15], [0.25, 0.1, 0.2]])
# Some ten operations on numbers of size one.
ROUNDING = 1e-14


def scene_of(d, **scene):
    return jc.Scene(MESHES[d], MATERIAL, **scene)


def affine(d):
    """A displacement with a constant gradient, and its strain"""
    gradient = GRADIENT[:d, :d]
    return MESHES[d].points @ gradient.T, 0.5 * (gradient + gradient.T)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_stress_of_an_affine_displacement_is_exact(d):
    y, strain = affine(d)
    found = jc.stress(scene_of(d), y, -2.0 * y)
    trace = np.trace(strain)
    elastic = FIRST * trace * np.eye(d) + 2.0 * SECOND * strain
    bulk, shear = MATERIAL.viscous_lame()
    viscous = -2.0 * (bulk * trace * np.eye(d) + 2.0 * shear * strain)
    for field, value in (
        (found.strain, strain),
        (found.elastic, elastic),
        (found.viscous, viscous),
        (found.cells, elastic + viscous),
        (found.nodes, elastic + viscous),
    ):
        np.testing.assert_allclose(field, np.broadcast_to(value, field.shape), atol=ROUNDING)
    lateral = (FIRST - 2.0 * bulk) * trace * (d < 3)
    np.testing.assert_allclose(found.out_of_plane, lateral, atol=ROUNDING)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_von_mises_stress_is_that_of_the_whole_tensor(d):
    y, strain = affine(d)
    found = jc.stress(scene_of(d), y)
    whole = np.zeros((3, 3))
    whole[:d, :d] = strain
    deviator = 2.0 * SECOND * (whole - np.trace(whole) / 3.0 * np.eye(3))
    expected = np.sqrt(1.5 * np.sum(deviator**2))
    np.testing.assert_allclose(found.von_mises, expected, rtol=1e-13)
    np.testing.assert_allclose(found.von_mises_cells, expected, rtol=1e-13)


def test_principal_stresses_are_those_of_mohrs_circle():
    y, _ = affine(2)
    found = jc.stress(scene_of(2), y)
    (xx, xy), (_, yy) = np.asarray(found.nodes[0])
    radius = np.hypot(0.5 * (xx - yy), xy)
    expected = 0.5 * (xx + yy) + radius * np.array([1.0, -1.0])
    np.testing.assert_allclose(found.principal[0], expected, rtol=1e-13)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_energy_density_is_that_of_the_stiffness_matrix(d):
    scene = scene_of(d)
    y = np.random.default_rng(0).normal(size=MESHES[d].points.shape)
    volumes = jc.scene.cells.cell_volumes(MESHES[d].points, MESHES[d].cells)
    system = jc.discretize(scene)
    x = system.restrict(jnp.asarray(y))
    energy = np.sum(jc.stress(scene, y).energy_density * volumes)
    np.testing.assert_allclose(energy, 0.5 * jnp.vdot(x, system.stiffness @ x), rtol=1e-13)


def test_stress_of_a_trajectory_is_that_of_its_states():
    fields = np.random.default_rng(1).normal(size=(4, 3, *MESHES[2].points.shape))
    found = jc.stress(scene_of(2), fields, fields)
    one = jc.stress(scene_of(2), fields[2, 1], fields[2, 1])
    assert found.nodes.shape == (4, 3, MESHES[2].n_nodes, 2, 2)
    assert found.von_mises.shape == (4, 3, MESHES[2].n_nodes)
    for name in ("cells", "nodes", "von_mises", "von_mises_cells", "principal", "energy_density"):
        part = getattr(found, name)[2, 1]
        np.testing.assert_allclose(part, getattr(one, name), atol=100 * ROUNDING)


def test_stress_at_a_node_is_the_mean_of_its_cells_by_volume():
    mesh = jc.Mesh.from_arrays(np.array([[0.0], [1.0], [4.0]]), np.array([[0, 1], [1, 2]]))
    scene = jc.Scene(mesh, jc.KelvinVoigt(young=1.0, poisson=0.0))
    found = jc.stress(scene, np.array([[0.0], [1.0], [10.0]]))
    np.testing.assert_allclose(found.cells.ravel(), [1.0, 3.0], rtol=1e-15)
    np.testing.assert_allclose(found.nodes.ravel(), [1.0, 2.5, 3.0], rtol=1e-15)


def test_materials_of_regions_have_their_own_stress():
    mesh = jc.join({name: MESHES[2] for name in ("soft", "hard")})
    stiff = jc.KelvinVoigt(young=20.0, poisson=0.3)
    scene = jc.Scene(mesh, {"soft": MATERIAL, "hard": stiff})
    y, _ = affine(2)
    soft, hard = np.split(jc.stress(scene, np.concatenate([y, y])).cells, 2)
    np.testing.assert_allclose(hard, 10.0 * soft, rtol=1e-13)


def test_stress_is_differentiable_by_everything():
    y = jnp.asarray(np.random.default_rng(2).normal(size=MESHES[2].points.shape))
    values = {"young": jnp.asarray(2.0), "y": y, "points": jnp.asarray(MESHES[2].points)}

    def cost(values):
        material = jc.KelvinVoigt(young=values["young"], poisson=0.3)
        mesh = MESHES[2].with_points(values["points"])
        return jnp.sum(jc.stress(jc.Scene(mesh, material), values["y"]).von_mises ** 2)

    assert jc.check_gradient(cost, values).verdict is jc.Verdict.RIGHT


def test_gradient_of_the_von_mises_stress_of_no_stress_is_zero():
    zero = jnp.zeros(MESHES[2].points.shape)
    gradient = jax.grad(lambda y: jnp.sum(jc.stress(scene_of(2), y).von_mises))(zero)
    np.testing.assert_array_equal(gradient, zero)


@pytest.mark.parametrize("fields", [(np.zeros((3, 2)),), (np.zeros((15, 2)), np.zeros((15, 3)))])
def test_fields_that_do_not_fit_the_mesh_are_refused(fields):
    with pytest.raises(ValueError, match=r"has shape .*pass nodal vectors.*\(15, 2\)"):
        jc.stress(scene_of(2), *fields)


def test_stress_of_float32_is_float32():
    y = jnp.asarray(affine(2)[0], jnp.float32)
    assert jc.stress(scene_of(2), y).von_mises.dtype == jnp.float32
