import meshio
import numpy as np
import pytest

from jaxcontact.scene import meshes
from jaxcontact.scene.io import read_mesh
from jaxcontact.scene.mesh import cell_volumes

# The unit square cut by the diagonal from node 0 to node 2, its bottom and its right side.
SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
SIDES = np.array([[0, 1], [1, 2]])
PHYSICAL = {
    "cell_data": {
        "gmsh:physical": [np.array([1, 2]), np.array([3, 3])],
        "gmsh:geometrical": [np.array([1, 2]), np.array([3, 3])],
    },
    "field_data": {name: np.array(tag) for name, tag in [("bottom", [1, 1]), ("body", [3, 2])]},
}

# Written by hand after the format's specification: meshio writes no entities. Both groups have the
# number 7, which Gmsh allows in different dimensions.
GMSH41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
2
1 7 "bottom"
2 7 "body"
$EndPhysicalNames
$Entities
0 1 1 0
1 0 0 0 1 0 0 1 7 0
1 0 0 0 1 1 0 1 7 1 1
$EndEntities
$Nodes
1 4 1 4
2 1 0 4
1
2
3
4
0 0 0
1 0 0
1 1 0
0 1 0
$EndNodes
$Elements
2 3 1 3
1 1 1 1
1 1 2
2 1 2 2
2 1 2 3
3 1 3 4
$EndElements
"""

ABAQUS = """*NODE
1, 0.0, 0.0
2, 1.0, 0.0
3, 1.0, 1.0
4, 0.0, 1.0
*ELEMENT, TYPE=T3D2, ELSET=SIDE
1, 1, 2
*ELEMENT, TYPE=CPS3, ELSET=BODY
2, 1, 2, 3
3, 1, 3, 4
"""


def write(path, cells, points=SQUARE, **kwargs):
    file_format = kwargs.pop("file_format", None)
    meshio.Mesh(points, cells, **kwargs).write(path, file_format=file_format)
    return path


@pytest.mark.parametrize("ending", ["vtu", "vtk", "msh", "inp", "mesh"])
@pytest.mark.parametrize("name", ["interval", "half_disc", "half_ball"])
def test_read_mesh_returns_the_mesh_that_was_written(tmp_path, ending, name):
    mesh = getattr(meshes, name)(1.0, h=0.5)
    kind = ["line", "triangle", "tetra"][mesh.dimension - 1]
    points = np.pad(mesh.points, [(0, 0), (0, 3 - mesh.dimension)])
    file_format = "gmsh" if ending == "msh" else None
    path = tmp_path / f"mesh.{ending}"
    again = read_mesh(write(path, [(kind, mesh.cells)], points, file_format=file_format))
    assert np.array_equal(again.cells, mesh.cells)
    np.testing.assert_allclose(again.points, mesh.points, atol=1e-15)
    assert again.facets == {}
    # Medit numbers every cell, and meshio writes the number 1.
    assert [*again.regions] == (["1"] if ending == "mesh" else [])


def test_read_mesh_names_facet_sets_and_regions_by_gmsh_physical_groups(tmp_path):
    path = write(
        tmp_path / "square.msh",
        [("line", SIDES), ("triangle", TRIANGLES)],
        file_format="gmsh22",
        **PHYSICAL,
    )
    mesh = read_mesh(path)
    assert {name: facets.tolist() for name, facets in mesh.facets.items()} == {
        "bottom": [[0, 1]],
        "2": [[1, 2]],
    }
    assert {name: cells.tolist() for name, cells in mesh.regions.items()} == {"body": [0, 1]}


def test_read_mesh_reads_the_groups_of_gmsh_41(tmp_path):
    path = tmp_path / "square.msh"
    path.write_text(GMSH41)
    mesh = read_mesh(path)
    assert mesh.dimension == 2
    assert mesh.facets["bottom"].tolist() == [[0, 1]]
    assert mesh.regions["body"].tolist() == [0, 1]
    assert len(mesh.facets) == len(mesh.regions) == 1


def test_read_mesh_reads_the_element_sets_of_abaqus(tmp_path):
    path = tmp_path / "square.inp"
    path.write_text(ABAQUS)
    mesh = read_mesh(path)
    assert mesh.facets["SIDE"].tolist() == [[0, 1]]
    assert mesh.regions["BODY"].tolist() == [0, 1]
    assert len(mesh.facets) == len(mesh.regions) == 1


def test_read_mesh_joins_the_blocks_of_one_group(tmp_path):
    cells = [("triangle", TRIANGLES[:1]), ("line", SIDES), ("triangle", TRIANGLES[1:])]
    tags = [np.array([4]), np.array([0, 0]), np.array([4])]
    path = write(
        tmp_path / "square.msh",
        cells,
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        file_format="gmsh22",
    )
    mesh = read_mesh(path)
    assert mesh.regions["4"].tolist() == [0, 1]
    # The number 0 stands for no group.
    assert mesh.facets == {}


def test_read_mesh_of_a_bar_names_its_end_points(tmp_path):
    tags = [np.array([5]), np.array([0])]
    path = write(
        tmp_path / "bar.msh",
        [("vertex", [[1]]), ("line", [[0, 1]])],
        SQUARE[:2],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        field_data={"right": np.array([5, 0])},
        file_format="gmsh22",
    )
    assert read_mesh(path).facets["right"].tolist() == [[1]]


def test_read_mesh_drops_unused_nodes_and_renumbers(tmp_path):
    points = np.concatenate([[[9.0, 9.0, 9.0]], SQUARE])
    tags = [np.array([1]), np.array([2, 2])]
    path = write(
        tmp_path / "square.msh",
        [("line", SIDES[:1] + 1), ("triangle", TRIANGLES + 1)],
        points,
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        file_format="gmsh22",
    )
    mesh = read_mesh(path)
    assert np.array_equal(mesh.points, SQUARE[:, :2])
    assert np.array_equal(mesh.cells, TRIANGLES)
    assert mesh.facets["1"].tolist() == [[0, 1]]


def test_read_mesh_drops_a_constant_height(tmp_path):
    path = write(
        tmp_path / "square.vtu", [("triangle", TRIANGLES)], SQUARE + np.array([0.0, 0.0, 3.0])
    )
    assert np.array_equal(read_mesh(path).points, SQUARE[:, :2])


def test_read_mesh_turns_inverted_cells_over(tmp_path):
    path = write(tmp_path / "square.vtu", [("triangle", [[0, 1, 2], [0, 3, 2]])])
    mesh = read_mesh(path)
    np.testing.assert_array_equal(cell_volumes(mesh.points, mesh.cells), [0.5, 0.5])


def test_read_mesh_takes_the_cells_of_the_dimension_asked_for(tmp_path):
    cells = [("line", SIDES[:1]), ("triangle", TRIANGLES)]
    path = write(tmp_path / "square.vtu", cells)
    assert read_mesh(path).dimension == 2
    mesh = read_mesh(path, dimension=1)
    assert mesh.points.tolist() == [[0.0], [1.0]]


def test_read_mesh_lists_a_facet_once_that_the_file_lists_twice(tmp_path):
    tags = [np.array([1, 1]), np.array([2, 2])]
    path = write(
        tmp_path / "square.msh",
        [("line", [[0, 1], [1, 0]]), ("triangle", TRIANGLES)],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        file_format="gmsh22",
    )
    assert read_mesh(path).facets["1"].tolist() == [[0, 1]]


def test_read_mesh_leaves_out_interior_groups_with_a_warning(tmp_path):
    tags = [np.array([1, 2]), np.array([3, 3])]
    path = write(
        tmp_path / "square.msh",
        [("line", [[0, 1], [0, 2]]), ("triangle", TRIANGLES)],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        file_format="gmsh22",
    )
    with pytest.warns(UserWarning, match=r"'2' is left out, 1 of its 1 facets"):
        mesh = read_mesh(path)
    assert [*mesh.facets] == ["1"]


def test_read_mesh_refuses_cells_without_corners(tmp_path):
    # meshio keeps the nodes of a polygon, whatever their number.
    path = write(tmp_path / "q.vtk", [("polygon", [[0, 1, 2, 3]])], file_format="vtk42")
    with pytest.raises(ValueError, match=r"type polygon are not supported; split them into tri"):
        read_mesh(path)


def test_read_mesh_refuses_a_file_with_points_only(tmp_path):
    path = write(tmp_path / "p.vtu", [("vertex", [[0], [1]])])
    with pytest.raises(ValueError, match=r"dimension is 0, but must be 1, 2 or 3.*2 vertex cells"):
        read_mesh(path)


def test_read_mesh_refuses_a_dimension_that_the_file_lacks(tmp_path):
    path = write(tmp_path / "s.vtu", [("triangle", TRIANGLES)])
    with pytest.raises(ValueError, match="no tetra cells; the file has 2 triangle cells: choose"):
        read_mesh(path, dimension=3)
    with pytest.raises(ValueError, match="dimension is 4, but must be 1, 2 or 3"):
        read_mesh(path, dimension=4)


def test_read_mesh_refuses_a_curved_surface(tmp_path):
    path = write(
        tmp_path / "s.vtu", [("triangle", TRIANGLES)], SQUARE + np.diag([1, 0, 1, 0])[:, :3]
    )
    with pytest.raises(ValueError, match="must lie flat in the first 2 coordinates: turn it, or"):
        read_mesh(path)


@pytest.mark.parametrize("ending", ["msh", "inp"])
def test_read_mesh_of_no_file_or_a_folder_says_so(tmp_path, ending):
    with pytest.raises(FileNotFoundError, match=rf"there is no file .*nothing\.{ending}; check"):
        read_mesh(tmp_path / f"nothing.{ending}")
    folder = tmp_path / f"folder.{ending}"
    folder.mkdir()
    with pytest.raises(IsADirectoryError, match="is a folder; name a file in it"):
        read_mesh(folder)


@pytest.mark.parametrize("ending", ["msh", "vtu", "unknown"])
def test_read_mesh_refuses_a_file_that_is_no_mesh(tmp_path, ending):
    path = tmp_path / f"text.{ending}"
    path.write_text("not a mesh\n")
    with pytest.raises(ValueError, match=r"meshio cannot read this file \(.{9,}\); check that"):
        read_mesh(path)


def test_read_mesh_prints_nothing(tmp_path, capfd):
    path = tmp_path / "square.msh"
    path.write_text(GMSH41)
    read_mesh(path)
    path.write_text("not a mesh\n")
    with pytest.raises(ValueError, match="meshio cannot read"):
        read_mesh(path)
    assert capfd.readouterr() == ("", "")
