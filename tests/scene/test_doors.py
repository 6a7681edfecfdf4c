"""Meshes from other programs, bodies with their contact set, and how objects show themselves."""

import meshio
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.scene.mesh import boundary_facets, cell_volumes

SQUARE = meshio.Mesh(
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]],
    [("quad", [[0, 1, 2, 3]]), ("line", [[0, 1]])],
    cell_data={"gmsh:physical": [np.array([1]), np.array([2])]},
    field_data={"body": np.array([1, 2]), "floor": np.array([2, 1])},
)


def test_from_meshio_keeps_groups_and_leaves_the_source_alone():
    with pytest.warns(UserWarning, match="the meshio mesh: 1 quad cells are cut into simplices"):
        mesh = jc.Mesh.from_meshio(SQUARE)
    assert mesh.cells.shape == (2, 3)
    assert mesh.facets["floor"].tolist() == [[0, 1]]
    assert set(mesh.regions["body"]) == {0, 1}
    assert [block.type for block in SQUARE.cells] == ["quad", "line"]


@pytest.fixture
def gmsh():
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(["gmsh", "-nopopup", "-v", "0"])
    yield gmsh
    gmsh.finalize()


def test_from_gmsh_takes_the_current_model_with_its_groups_and_restores_options(gmsh):
    gmsh.option.setNumber("Mesh.SaveAll", 1)
    gmsh.model.occ.addRectangle(0.0, 0.0, 0.0, 2.0, 1.0)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(1, [1], name="floor")
    gmsh.model.addPhysicalGroup(2, [1], name="body")
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
    gmsh.model.mesh.generate(2)
    mesh = jc.Mesh.from_gmsh()
    assert gmsh.option.getNumber("Mesh.SaveAll") == 1
    assert cell_volumes(mesh.points, mesh.cells).sum() == pytest.approx(2.0, rel=1e-12)
    assert np.all(mesh.points[mesh.facets["floor"], 1] == 0.0)
    assert len(mesh.regions["body"]) == mesh.n_cells


def test_from_gmsh_without_a_mesh_says_which_call_is_missing(gmsh):
    with pytest.raises(ValueError, match=r"gmsh\.model\.mesh\.generate"):
        jc.Mesh.from_gmsh()


def test_ball_has_the_half_ball_below_and_its_mirror_image_above():
    half, ball = (make(2.0, h=0.5) for make in (jc.meshes.half_ball, jc.meshes.ball))
    volumes = cell_volumes(ball.points, ball.cells)
    is_below = ball.points[ball.cells, 2].mean(axis=1) < 0.0
    expected = np.sort(cell_volumes(half.points, half.cells))
    np.testing.assert_allclose(np.sort(volumes[is_below]), expected, rtol=1e-12)
    np.testing.assert_allclose(np.sort(volumes[~is_below]), expected, rtol=1e-12)
    assert len(ball.facets["boundary"]) == len(boundary_facets(ball.cells))
    np.testing.assert_allclose(np.linalg.norm(ball.points[ball.facets["boundary"]], axis=2), 2.0)
    assert len(ball.facets["contact"]) == len(half.facets["contact"])


@pytest.mark.parametrize(
    ("contact", "count"), [((-120.0, -60.0), 4), ((-180.0, 180.0), 24), ((170.0, 200.0), 2)]
)
def test_disc_has_its_contact_set_between_two_angles(contact, count):
    mesh = jc.meshes.disc(1.0, h=0.25, contact=contact)
    facets = mesh.facets["contact"]
    assert len(facets) == count
    middle = mesh.points[facets].mean(axis=1)
    angle = np.degrees(np.arctan2(middle[:, 1], middle[:, 0]))
    assert np.all((angle - contact[0]) % 360.0 < contact[1] - contact[0])


def test_disc_without_a_facet_in_its_contact_set_says_how_large_one_is():
    with pytest.raises(ValueError, match="a facet has 15 of them"):
        jc.meshes.disc(1.0, h=0.25, contact=(0.0, 5.0))
