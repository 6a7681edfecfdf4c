"""Several meshes as one, and meshes in another place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

SQUARE = jc.meshes.rectangle((1.0, 1.0), h=0.5)
TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def test_joined_bodies_keep_their_sets_and_regions():
    soft = jc.Mesh.from_arrays(SQUARE.points, SQUARE.cells, SQUARE.facets, {"core": [0, 3]})
    mesh = jc.join({"ball": jc.meshes.disc(1.0, h=0.5), "floor": soft})
    first, cells = jc.meshes.disc(1.0, h=0.5).n_nodes, jc.meshes.disc(1.0, h=0.5).n_cells
    np.testing.assert_array_equal(np.unique(mesh.components()), [0, 1])
    np.testing.assert_array_equal(mesh.facets["floor/top"], SQUARE.facets["top"] + first)
    assert set(mesh.regions) == {"ball", "floor", "floor/core"}
    np.testing.assert_array_equal(mesh.regions["floor/core"], [cells, cells + 3])
    np.testing.assert_array_equal(mesh.regions["floor"], cells + np.arange(SQUARE.n_cells))
    np.testing.assert_array_equal(mesh.points[first:], SQUARE.points)
    # Every check of a mesh from arrays passes.
    jc.Mesh.from_arrays(mesh.points, mesh.cells, mesh.facets, mesh.regions)


def test_joined_bodies_take_a_material_each():
    mesh = jc.join({"a": SQUARE, "b": SQUARE.moved(translation=[2.0, 0.0])})
    material = {
        "a": jc.KelvinVoigt(young=1.0, poisson=0.0, density=2.0),
        "b": jc.KelvinVoigt(young=1.0, poisson=0.0, density=3.0),
    }
    system = jc.discretize(jc.Scene(mesh, material))
    assert jnp.sum(system.mass.scalar.values) == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("meshes", "message"),
    [
        ({}, "needs bodies by name"),
        ({0: SQUARE}, "needs bodies by name"),
        ({"a": SQUARE, "b": jc.meshes.interval(1.0, h=0.5)}, "different dimensions"),
        ({"a/b": SQUARE, "a": jc.join({"b": SQUARE})}, r"facet sets \['a/b/bottom'.* twice"),
    ],
)
def test_joined_bodies_that_do_not_fit_are_refused(meshes, message):
    with pytest.raises(ValueError, match=message):
        jc.join(meshes)


def test_moved_mesh_is_turned_about_the_origin_and_then_shifted():
    moved = SQUARE.moved(rotation=TURN, translation=[3.0, 0.0])
    np.testing.assert_array_equal(moved.points[:, 0], 3.0 - SQUARE.points[:, 1])
    np.testing.assert_array_equal(moved.points[:, 1], SQUARE.points[:, 0])
    np.testing.assert_array_equal(moved.layout, moved.points)


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        ({"translation": [1.0]}, r"a translation \(2,\), got .*\(1,\)"),
        ({"rotation": np.eye(3)}, r"a rotation \(2, 2\) .* got \(3, 3\)"),
        ({"rotation": np.diag([1.0, -1.0])}, "orthogonal with determinant 1"),
        ({"rotation": 2.0 * np.eye(2)}, "orthogonal with determinant 1"),
    ],
)
def test_moved_mesh_refuses_what_is_no_motion(motion, message):
    with pytest.raises(ValueError, match=message):
        SQUARE.moved(**motion)


def test_moved_mesh_is_differentiable_by_the_motion():
    def moment(shift):
        return jnp.sum(SQUARE.moved(translation=shift).points[:, 0] ** 2)

    by_shift = jax.grad(moment)(jnp.zeros(2))
    np.testing.assert_allclose(by_shift, [2.0 * SQUARE.points[:, 0].sum(), 0.0])


def test_layout_is_where_the_nodes_last_were_concrete():
    layouts = []

    @jax.jit
    def trace(points):
        mesh = SQUARE.with_points(points)
        layouts.extend([mesh.layout, mesh.moved(translation=[1.0, 0.0]).layout])
        layouts.append(jc.join({"a": mesh, "b": SQUARE}).layout)
        return mesh.points

    trace(jnp.asarray(2.0 * SQUARE.points))
    np.testing.assert_array_equal(layouts[0], SQUARE.points)
    np.testing.assert_array_equal(layouts[1], SQUARE.points + np.array([1.0, 0.0]))
    np.testing.assert_array_equal(layouts[2], np.tile(SQUARE.points, (2, 1)))
    wider = SQUARE.with_points(2.0 * SQUARE.points)
    np.testing.assert_array_equal(wider.layout, 2.0 * SQUARE.points)
