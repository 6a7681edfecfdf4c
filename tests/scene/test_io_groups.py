"""Names in mesh files reach the mesh, in whatever way the format has them."""

import numpy as np
import pytest
from test_io import GMSH41, SIDES, SQUARE, TRIANGLES, write

import jaxcontact as jc
from jaxcontact.scene.io import read_mesh

# Bottom and right side of the square are numbered 1 and 2, its two triangles 3 and 4.
NUMBERS = [np.array([1, 2]), np.array([3, 4])]
CELLS = [("line", SIDES), ("triangle", TRIANGLES)]

SU2 = """NDIME= 2
NELEM= 2
5 0 1 2 0
5 0 2 3 1
NPOIN= 4
0.0 0.0 0
1.0 0.0 1
1.0 1.0 2
0.0 1.0 3
NMARK= 3
MARKER_TAG= floor
MARKER_ELEMS= 1
3 0 1
MARKER_TAG= 7
MARKER_ELEMS= 1
3 1 2
MARKER_TAG= roof
MARKER_ELEMS= 1
3 2 3
"""


def gmsh41(tmp_path, *changes):
    text = GMSH41
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "square.msh"
    path.write_text(text)
    return path


def listed(groups):
    return {name: rows.tolist() for name, rows in groups.items()}


@pytest.mark.parametrize("ending", ["vtu", "vtk"])
def test_read_mesh_names_groups_by_integer_cell_data(tmp_path, ending):
    data = {"mat_id": NUMBERS, "pressure": [np.zeros(2), np.ones(2)]}
    mesh = read_mesh(write(tmp_path / f"square.{ending}", CELLS, cell_data=data))
    assert listed(mesh.facets) == {"mat_id:1": [[0, 1]], "mat_id:2": [[1, 2]]}
    assert listed(mesh.regions) == {"mat_id:3": [0], "mat_id:4": [1]}


def test_read_mesh_takes_the_material_number_zero_of_cell_data(tmp_path):
    path = write(tmp_path / "s.vtu", CELLS[1:], cell_data={"mat_id": [np.array([0, 1])]})
    assert listed(read_mesh(path).regions) == {"mat_id:0": [0], "mat_id:1": [1]}


def test_read_mesh_leaves_out_cell_data_that_counts_the_cells(tmp_path):
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / 12)
    points = np.pad(mesh.points, [(0, 0), (0, 1)])
    data = {"id": [np.arange(mesh.n_cells)]}
    path = write(tmp_path / "s.vtu", [("triangle", mesh.cells)], points, cell_data=data)
    with pytest.warns(UserWarning, match="'id' is left out, 288 different numbers are no groups"):
        assert read_mesh(path).regions == {}


def test_read_mesh_names_groups_by_the_references_of_medit(tmp_path):
    references = [np.array([0, 2]), np.array([3, 4])]
    mesh = read_mesh(write(tmp_path / "s.mesh", CELLS, cell_data={"medit:ref": references}))
    # The number 0 stands for no group.
    assert listed(mesh.facets) == {"2": [[1, 2]]}
    assert listed(mesh.regions) == {"3": [0], "4": [1]}


def test_read_mesh_names_facet_sets_by_the_markers_of_su2(tmp_path):
    path = tmp_path / "square.su2"
    path.write_text(SU2)
    mesh = read_mesh(path)
    assert listed(mesh.facets) == {"floor": [[0, 1]], "7": [[1, 2]], "roof": [[2, 3]]}
    assert mesh.regions == {}


def test_read_mesh_names_regions_by_the_references_of_tetgen(tmp_path):
    path = tmp_path / "cube.node"
    path.write_text("4 3 0 0\n0 0 0 0\n1 1 0 0\n2 0 1 0\n3 0 0 1\n")
    path.with_suffix(".ele").write_text("1 4 1\n0 0 1 2 3 5\n")
    assert listed(read_mesh(path.with_suffix(".ele")).regions) == {"5": [0]}


def test_read_mesh_keeps_the_names_of_reversed_gmsh_groups(tmp_path):
    path = gmsh41(tmp_path, ("1 0 0 1 7 0", "1 0 0 1 -7 0"), ("1 1 0 1 7 1 1", "1 1 0 1 -7 1 1"))
    mesh = read_mesh(path)
    assert listed(mesh.facets) == {"bottom": [[0, 1]]}
    assert listed(mesh.regions) == {"body": [0, 1]}


def test_read_mesh_takes_a_gmsh_cell_in_two_groups_once(tmp_path):
    cells = [("triangle", TRIANGLES[[0, 1, 1]])]
    tags = [np.array([3, 3, 4])]
    path = write(
        tmp_path / "s.msh",
        cells,
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        file_format="gmsh22",
    )
    mesh = read_mesh(path)
    assert np.array_equal(mesh.cells, TRIANGLES)
    assert listed(mesh.regions) == {"3": [0, 1], "4": [1]}


BODY_UNNAMED = ("1 0 0 0 1 1 0 1 7 1 1", "1 0 0 0 1 1 0 0 1 1")
ONLY_SIDES = ("2 3 1 3\n", "1 1 1 1\n"), ("2 1 2 2\n2 1 2 3\n3 1 3 4\n", "")


def test_read_mesh_does_not_take_the_boundary_of_an_unsaved_body_for_a_bar(tmp_path):
    path = gmsh41(tmp_path, BODY_UNNAMED, *ONLY_SIDES)
    with pytest.raises(ValueError, match=r"dimension 2.*only 1 line cells.*no physical group; put"):
        read_mesh(path)
    assert read_mesh(path, dimension=1).dimension == 1


@pytest.mark.parametrize(
    ("changes", "advice"),
    [
        ([("2 1 0 4\n1", "2 1 1 4\n1")], r"Mesh\.SaveParametric=0"),
        ([BODY_UNNAMED], r"in no physical group: put them into one, or .*Mesh\.SaveAll=0"),
        ([("3 1 3 4\n", "3 1 3 9\n")], "name nodes that it does not have: write it again"),
    ],
)
def test_read_mesh_says_how_to_save_a_gmsh_file_that_meshio_refuses(tmp_path, changes, advice):
    with pytest.raises(ValueError, match=advice):
        read_mesh(gmsh41(tmp_path, *changes))


@pytest.mark.parametrize("wrong", [-1, 4])
@pytest.mark.parametrize("block", ["line", "triangle"])
def test_read_mesh_refuses_cells_that_name_no_node(tmp_path, block, wrong):
    cells = {"line": SIDES.copy(), "triangle": TRIANGLES.copy()}
    cells[block][1, 1] = wrong
    path = write(tmp_path / "s.vtu", list(cells.items()))
    with pytest.raises(ValueError, match=rf"1 {block} cells name nodes that are not in the file"):
        read_mesh(path)


def test_mesh_components_tell_the_bodies_apart(tmp_path):
    points = np.concatenate([SQUARE, SQUARE + np.array([[3.0, 0.0, 0.0]])])
    cells = np.concatenate([TRIANGLES + 4, TRIANGLES])
    mesh = read_mesh(write(tmp_path / "s.vtu", [("triangle", cells)], points))
    labels = mesh.components()
    assert labels.dtype == np.int32
    assert labels.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert np.all(jc.meshes.half_ball(1.0, h=0.5).components() == 0)
