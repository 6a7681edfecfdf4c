"""Cells that are no linear simplices become some, which fit each other and keep their names."""

import itertools

import meshio
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.scene.mesh import boundary_facets, cell_volumes
from jaxcontact.scene.split_cells import FACES, shape_of

#: One cell of each shape with its volume.
CELLS = {
    "tetra": ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], 1 / 6),
    "pyramid": ([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]], 1 / 3),
    "wedge": ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], 1 / 2),
    "hexahedron": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
        1.0,
    ),
}


def read(tmp_path, points, cells, **options):
    path = tmp_path / "cells.vtu"
    points = np.asarray(points, float)
    points = np.pad(points, [(0, 0), (0, 3 - points.shape[1])])
    meshio.Mesh(points, cells, **options).write(path, binary=True)
    return jc.read_mesh(path)


@pytest.mark.parametrize("shape", CELLS)
def test_faces_of_a_shape_look_inward(shape):
    x = np.asarray(CELLS[shape][0], float)
    for face in FACES[shape]:
        a, b, c = x[list(face[:3])]
        assert np.dot(np.cross(b - a, c - a), x.mean(axis=0) - a) > 0.0
    counts = np.bincount([k for face in FACES[shape] for k in face])
    # Every corner is in as many faces as edges meet there.
    assert counts.min() == 3
    assert len(counts) == shape_of(shape)[1]


@pytest.mark.parametrize("shape", CELLS)
def test_every_numbering_of_a_cell_gives_a_conforming_division(tmp_path, shape):
    points, volume = CELLS[shape]
    rng = np.random.default_rng(0)
    for _ in range(6):
        order = rng.permutation(len(points))  # node k of the file is corner order[k]
        cell = np.argsort(order)[None]
        if shape == "tetra":
            mesh = read(tmp_path, np.asarray(points)[order], [(shape, cell)])
        else:
            with pytest.warns(UserWarning, match=rf"1 {shape} cells are cut into simplices"):
                mesh = read(tmp_path, np.asarray(points)[order], [(shape, cell)])
        np.testing.assert_allclose(np.sum(cell_volumes(mesh.points, mesh.cells)), volume)
        # What is inside is in two cells: the boundary is that of the cell.
        n_triangles = sum(len(face) - 2 for face in FACES[shape])
        assert len(boundary_facets(mesh.cells)) == n_triangles


def two_by_two(numbers):
    """Four hexahedra of unit cubes in a row of two by two, with nodes numbered in any order"""
    grid = np.array(list(itertools.product(range(3), range(3), range(2))), float)
    place = {tuple(x): numbers[k] for k, x in enumerate(grid.astype(int))}
    points = np.zeros_like(grid)
    points[numbers] = grid
    corners = np.array(CELLS["hexahedron"][0])
    cells = [
        [place[tuple(corner + np.array([i, j, 0]))] for corner in corners]
        for i, j in itertools.product(range(2), range(2))
    ]
    return points, np.array(cells)


@pytest.mark.filterwarnings("ignore:.*cut into simplices")
def test_neighbours_fit_whatever_their_nodes_are_called(tmp_path):
    rng = np.random.default_rng(1)
    for _ in range(5):
        points, cells = two_by_two(rng.permutation(18))
        mesh = read(tmp_path, points, [("hexahedron", cells)])
        np.testing.assert_allclose(np.sum(cell_volumes(mesh.points, mesh.cells)), 4.0)
        # Sixteen outer squares, cut in two each; a face that does not fit would count as boundary.
        assert len(boundary_facets(mesh.cells)) == 32


@pytest.mark.filterwarnings("ignore:.*cut into simplices")
def test_groups_of_cut_cells_hold_their_pieces(tmp_path):
    points, cells = two_by_two(np.arange(18))
    floor = ("quad", np.array([[0, 2, 8, 6]]))
    numbers = [np.array([1, 1, 2, 2]), np.array([3])]
    mesh = read(tmp_path, points, [("hexahedron", cells), floor], cell_data={"m": numbers})
    assert mesh.facets["m:3"].shape == (2, 3)
    np.testing.assert_array_equal(np.unique(mesh.facets["m:3"]), [0, 2, 6, 8])
    for name, x in (("m:1", 0.5), ("m:2", 1.5)):
        centres = mesh.points[mesh.cells[mesh.regions[name]]].mean(axis=1)
        assert np.all(np.abs(centres[:, 0] - x) < 0.5)
        np.testing.assert_allclose(
            np.sum(cell_volumes(mesh.points, mesh.cells[mesh.regions[name]])), 2.0
        )


def test_triangles_and_quadrilaterals_make_one_mesh(tmp_path):
    points = [[0, 0], [1, 0], [1, 1], [0, 1], [2, 0.5]]
    sides = ("line", [[0, 1]])
    with pytest.warns(UserWarning, match="1 quad cells are cut into simplices"):
        mesh = read(tmp_path, points, [("triangle", [[1, 4, 2]]), ("quad", [[0, 1, 2, 3]]), sides])
    np.testing.assert_allclose(np.sum(cell_volumes(mesh.points, mesh.cells)), 1.5)
    assert mesh.n_cells == 3
    assert len(boundary_facets(mesh.cells)) == 5


@pytest.mark.filterwarnings("ignore:.*cut into simplices")
@pytest.mark.parametrize("kind", ["triangle6", "quad8"])
def test_cells_of_second_order_are_read_by_their_corners(tmp_path, kind):
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])[: 3 + (kind == "quad8")]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    # A curved side: its middle is not where the mesh of corners has it.
    middles[0, 1] -= 0.2
    points = np.concatenate([middles, corners])
    n = len(corners)
    cell = np.concatenate([np.arange(n, 2 * n), np.arange(n)])[None]
    bottom = np.array([[n, n + 1, 0]])
    with pytest.warns(UserWarning, match=rf"1 {kind}, 1 line3 cells are read by their corners"):
        mesh = read(
            tmp_path,
            points,
            [(kind, cell), ("line3", bottom)],
            cell_data={"side": [np.array([0]), np.array([7])]},
        )
    assert mesh.n_nodes == n
    np.testing.assert_array_equal(mesh.points[np.unique(mesh.facets["side:7"]), 1], 0.0)


def test_cells_that_are_not_convex_are_refused(tmp_path):
    dart = [[-1, 1], [0, 0.2], [1, 1], [0, 0]]
    with pytest.raises(ValueError, match="1 quad cells are not convex, the first is number 0"):
        read(tmp_path, dart, [("quad", [[0, 1, 2, 3]])])


def test_cells_turned_inside_out_are_turned_over(tmp_path):
    points = np.asarray(CELLS["hexahedron"][0]) * [1.0, 1.0, -1.0]
    with pytest.warns(UserWarning, match="cut into simplices"):
        mesh = read(tmp_path, points, [("hexahedron", np.arange(8)[None])])
    np.testing.assert_allclose(np.sum(cell_volumes(mesh.points, mesh.cells)), 1.0)
