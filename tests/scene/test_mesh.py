import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcontact.scene.mesh import Mesh, boundary_facets, cell_volumes

# The unit square cut by the diagonal from node 0 to node 2.
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
SIMPLICES = {d: np.concatenate([np.zeros((1, d)), np.eye(d)]) for d in (1, 2, 3)}


def square(**kwargs):
    return Mesh.from_arrays(SQUARE, TRIANGLES, **kwargs)


def test_mesh_counts_its_nodes_cells_and_dimension():
    mesh = square()
    assert (mesh.n_nodes, mesh.n_cells, mesh.dimension) == (4, 2, 2)


def test_mesh_stores_float64_points_and_int32_topology():
    mesh = Mesh.from_arrays(
        SQUARE.astype(int).tolist(),
        TRIANGLES.tolist(),
        facets={"bottom": [[0, 1]]},
        regions={"lower": [0]},
    )
    assert mesh.points.dtype == np.float64
    assert {mesh.cells.dtype, mesh.facets["bottom"].dtype, mesh.regions["lower"].dtype} == {
        np.dtype(np.int32)
    }


def test_mesh_does_not_share_memory_with_its_arguments():
    points, cells = SQUARE.copy(), TRIANGLES.astype(np.int32)
    mesh = Mesh.from_arrays(points, cells)
    points[:] = 0.0
    cells[:] = 0
    assert np.array_equal(mesh.points, SQUARE)
    assert np.array_equal(mesh.cells, TRIANGLES)


def test_mesh_survives_a_round_trip_through_the_pytree():
    mesh = square(facets={"bottom": [[0, 1]]}, regions={"lower": [0]})
    leaves, treedef = jax.tree_util.tree_flatten(mesh)
    again = jax.tree_util.tree_unflatten(treedef, leaves)
    assert len(leaves) == 5
    assert again.facets["bottom"] is mesh.facets["bottom"]
    assert isinstance(again.cells, np.ndarray)


def test_mesh_turns_named_facets_outward():
    facets = square(facets={"all": [[1, 0], [1, 2], [3, 2], [3, 0]]}).facets["all"]
    tangent = SQUARE[facets[:, 1]] - SQUARE[facets[:, 0]]
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    assert np.array_equal(normal, [[0, -1], [1, 0], [0, 1], [-1, 0]])


@pytest.mark.parametrize("d", [1, 2, 3])
def test_mesh_volume_of_the_reference_simplex_is_one_over_d_factorial(d):
    volume = cell_volumes(SIMPLICES[d], np.arange(d + 1)[None])
    np.testing.assert_allclose(volume, [1 / [1, 2, 6][d - 1]], rtol=1e-15)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_mesh_volume_is_the_determinant_of_the_edges(d):
    x = np.random.default_rng(0).normal(size=(20, d))
    cells = np.random.default_rng(1).permuted(np.tile(np.arange(20), (9, 1)), axis=1)[:, : d + 1]
    edges = x[cells[:, 1:]] - x[cells[:, :1]]
    expected = np.linalg.det(edges) / [1, 2, 6][d - 1]
    np.testing.assert_allclose(cell_volumes(x, cells), expected, rtol=1e-12)


def test_mesh_volume_is_differentiable_in_the_points():
    area = jax.grad(lambda x: cell_volumes(x, TRIANGLES).sum())(jnp.asarray(SQUARE))
    # Half the diagonal across each corner, turned outward.
    np.testing.assert_allclose(area, [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


@pytest.mark.parametrize("d", [1, 2, 3])
def test_boundary_facets_of_a_simplex_point_outward(d):
    x = SIMPLICES[d]
    facets = boundary_facets(np.arange(d + 1)[None])
    assert facets.shape == (d + 1, d)
    if d == 1:
        return
    edges = x[facets[:, 1:]] - x[facets[:, :1]]
    normals = (
        np.stack([edges[:, 0, 1], -edges[:, 0, 0]], axis=1)
        if d == 2
        else np.cross(edges[:, 0], edges[:, 1])
    )
    assert (np.einsum("fi,fi->f", normals, x[facets].mean(axis=1) - x.mean(axis=0)) > 0).all()


def test_boundary_facets_leave_out_the_shared_facet():
    found = {tuple(sorted(facet)) for facet in boundary_facets(TRIANGLES).tolist()}
    assert found == {(0, 1), (1, 2), (2, 3), (0, 3)}


def test_boundary_facets_refuse_a_facet_of_three_cells():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0], [0.5, 2.0], [0.5, 3.0]])
    with pytest.raises(ValueError, match=r"1 facets belong to more than two.*\[0, 1\].*remove"):
        Mesh.from_arrays(points, [[0, 1, 2], [0, 1, 3], [0, 1, 4]])


def test_mesh_with_points_moves_the_nodes_and_keeps_the_topology():
    mesh = square(facets={"bottom": [[0, 1]]})
    moved = mesh.with_points(2 * SQUARE)
    assert np.array_equal(moved.points, 2 * SQUARE)
    assert moved.cells is mesh.cells
    assert moved.facets is mesh.facets


def test_mesh_with_points_passes_the_derivative_through():
    mesh = square()

    @jax.jit
    def area(scale):
        moved = mesh.with_points(scale * jnp.asarray(SQUARE))
        return cell_volumes(moved.points, moved.cells).sum()

    np.testing.assert_allclose(jax.grad(area)(3.0), 6.0, rtol=1e-14)


def test_mesh_from_arrays_takes_traced_points_and_checks_topology_still():
    @jax.jit
    def area(points):
        mesh = Mesh.from_arrays(points, TRIANGLES, facets={"bottom": [[0, 1]]})
        return cell_volumes(mesh.points, mesh.cells).sum()

    assert area(SQUARE) == 1.0
    with pytest.raises(ValueError, match="not on the boundary"):
        jax.jit(lambda x: Mesh.from_arrays(x, TRIANGLES, facets={"diagonal": [[0, 2]]}))(SQUARE)


def test_mesh_keeps_a_float32_jax_array():
    points = jnp.asarray(SQUARE, dtype=jnp.float32)
    assert Mesh.from_arrays(points, TRIANGLES).points is points


def test_mesh_accepts_a_flat_cell_far_from_degenerate():
    thin = SQUARE * [1.0, 1e-9]
    assert Mesh.from_arrays(thin, TRIANGLES).n_cells == 2


def test_mesh_with_points_refuses_another_shape():
    with pytest.raises(ValueError, match=r"shape \(3, 2\); pass \(4, 2\)"):
        square().with_points(SQUARE[:3])


def test_mesh_with_points_refuses_positions_that_invert_a_cell():
    with pytest.raises(ValueError, match=r"cells \[0, 1\] \(2 in all\) are inverted"):
        square().with_points(SQUARE * [-1.0, 1.0])


NAN = np.where(np.arange(4)[:, None] == 2, np.nan, SQUARE)
EXTRA = np.concatenate([SQUARE, [[5.0, 5.0]]])
LINE = np.stack([np.arange(4.0), 0.1 * np.arange(4.0)], axis=1)
REFUSED = {
    "points not a matrix": (SQUARE[0], TRIANGLES, None, None, r"shape \(2,\); pass 1, 2 or 3"),
    "four coordinates": (np.ones((5, 4)), [[0, 1, 2, 3, 4]], None, None, "pass 1, 2 or 3"),
    "no points": (np.ones((0, 2)), TRIANGLES, None, None, r"shape \(0, 2\)"),
    "nan": (NAN, TRIANGLES, None, None, r"nodes \[2\] \(1 in all\) have a NaN"),
    "no cells": (SQUARE, np.zeros((0, 3), int), None, None, "cells: empty"),
    "quadrilateral": (SQUARE, [[0, 1, 2, 3]], None, None, r"expected \(rows, 3\)"),
    "float cells": (SQUARE, TRIANGLES * 1.0, None, None, "cells: dtype float64"),
    "one-based": (SQUARE, TRIANGLES + 1, None, None, r"rows \[1\] .*outside 0..3.*count from 0"),
    "negative": (SQUARE, [[0, 1, -1]], None, None, "outside 0..3"),
    "unused node": (EXTRA, TRIANGLES, None, None, r"nodes \[4\] \(1 in all\) are in no cell"),
    "repeated node": (SQUARE, [[0, 1, 2], [0, 3, 3]], None, None, r"cells \[1\] .*node twice"),
    "inverted": (SQUARE, [[0, 1, 2], [0, 3, 2]], None, None, r"cells \[1\] .*inverted: swap"),
    "no volume": (LINE, [[0, 1, 2], [1, 2, 3]], None, None, r"\[0, 1\] \(2 in all\) have no vol"),
    "empty facets": (SQUARE, TRIANGLES, {"a": []}, None, "facet set 'a': empty"),
    "interior facet": (
        SQUARE,
        TRIANGLES,
        {"a": [[0, 1], [0, 2]]},
        None,
        r"'a': rows \[1\].*not on",
    ),
    "facet twice": (SQUARE, TRIANGLES, {"a": [[0, 1], [1, 0]]}, None, r"rows \[0, 1\].*not unique"),
    "facet shape": (SQUARE, TRIANGLES, {"a": [0, 1]}, None, r"expected \(rows, 2\)"),
    "facet range": (SQUARE, TRIANGLES, {"a": [[0, 9]]}, None, r"facet set 'a'.*outside 0..3"),
    "facet name": (SQUARE, TRIANGLES, {7: [[0, 1]]}, None, r"\[7\] have to be named by strings"),
    "region range": (SQUARE, TRIANGLES, None, {"r": [0, 2]}, r"region 'r': rows \[1\].*0..1"),
    "region empty": (SQUARE, TRIANGLES, None, {"r": []}, "region 'r': empty"),
    "region mask": (SQUARE, TRIANGLES, None, {"r": [True, False]}, "region 'r': dtype bool"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_mesh_refuses_what_it_cannot_use(case):
    points, cells, facets, regions, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        Mesh.from_arrays(points, cells, facets, regions)


def test_mesh_refuses_traced_topology():
    with pytest.raises(ValueError, match=r"cells: topology must be concrete.*with_points"):
        jax.jit(lambda cells: Mesh.from_arrays(SQUARE, cells).points)(TRIANGLES)


def test_mesh_names_at_most_five_offenders():
    points = np.concatenate([SQUARE, np.ones((10, 2))])
    with pytest.raises(ValueError, match=r"\[4, 5, 6, 7, 8\] \(10 in all\)"):
        Mesh.from_arrays(points, TRIANGLES)


def test_mesh_advice_for_unused_nodes_makes_the_mesh_usable():
    names = {"np": np, "points": np.concatenate([[[9.0, 9.0]], SQUARE]), "cells": TRIANGLES + 1}
    with pytest.raises(ValueError, match="are in no cell") as error:
        Mesh.from_arrays(names["points"], names["cells"])
    exec(re.search(r"remove them \((.*)\)$", str(error.value))[1], names)
    assert np.array_equal(Mesh.from_arrays(names["points"], names["cells"]).points, SQUARE)


def test_mesh_advice_for_inverted_cells_makes_the_mesh_usable():
    names = {"cells": TRIANGLES[:, [1, 0, 2]], "inverted": np.array([0, 1])}
    with pytest.raises(ValueError, match="are inverted") as error:
        Mesh.from_arrays(SQUARE, names["cells"])
    exec(re.search(r"swap two nodes \((.*)\)$", str(error.value))[1], names)
    assert Mesh.from_arrays(SQUARE, names["cells"]).n_cells == 2
