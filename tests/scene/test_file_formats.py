"""Files of many formats give the same body with the same names.

The files in `samples/` are of Gmsh 4.15.2: a unit square with the physical groups `bottom` (two
curves), `bottom_right` (the second one of them, so that the two overlap), `top` and `body`, and a
unit cube of hexahedra with `floor`, `lid` and `body`.
"""

import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.scene.mesh import cell_volumes

SAMPLES = Path(__file__).parent / "samples"
#: What the sides of the square are called, by format: Medit, Nastran and VTK have numbers only.
NAMED = {"bottom": (0.0, 1.0, 0.0), "bottom_right": (0.5, 1.0, 0.0), "top": (0.0, 1.0, 1.0)}


def extents(mesh, name):
    """First and last coordinate along the bottom of a set of the square, and its height"""
    x = mesh.points[np.unique(mesh.facets[name])]
    assert np.ptp(x[:, 1]) < 1e-12
    return (x[:, 0].min(), x[:, 0].max(), x[0, 1])


def check_square(mesh):
    assert mesh.dimension == 2
    np.testing.assert_allclose(np.sum(cell_volumes(mesh.points, mesh.cells)), 1.0)
    for name, expected in NAMED.items():
        np.testing.assert_allclose(extents(mesh, name), expected, atol=1e-12)
    np.testing.assert_array_equal(mesh.regions["body"], np.arange(mesh.n_cells))


def check_cube(mesh):
    assert mesh.dimension == 3
    np.testing.assert_allclose(np.sum(cell_volumes(mesh.points, mesh.cells)), 1.0)
    for name, height in (("floor", 0.0), ("lid", 1.0)):
        np.testing.assert_allclose(mesh.points[np.unique(mesh.facets[name]), 2], height)
        corners = mesh.points[mesh.facets[name]]
        sides = corners[:, 1:] - corners[:, :1]
        areas = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        np.testing.assert_allclose(np.sum(areas), 1.0)
    np.testing.assert_array_equal(mesh.regions["body"], np.arange(mesh.n_cells))


@pytest.mark.parametrize(
    "name", ["square22.msh", "square22b.msh", "square41.msh", "square41b.msh", "square.inp"]
)
def test_read_mesh_reads_the_groups_of_a_file_of_gmsh(name):
    check_square(jc.read_mesh(SAMPLES / name))


@pytest.mark.parametrize("name", ["square.mesh", "square.su2", "square2.inp"])
@pytest.mark.filterwarnings("ignore:.*read by their corners")
def test_read_mesh_reads_other_files_of_gmsh(name):
    mesh = jc.read_mesh(SAMPLES / name)
    np.testing.assert_allclose(np.sum(cell_volumes(mesh.points, mesh.cells)), 1.0)
    sides = {tuple(np.round(extents(mesh, key), 12)) for key in mesh.facets if is_level(mesh, key)}
    assert (0.0, 1.0, 1.0) in sides


def test_read_mesh_reads_the_corners_of_a_file_of_second_order():
    with pytest.warns(UserWarning, match=r"triangle6.* cells are read by their corners"):
        mesh = jc.read_mesh(SAMPLES / "square2.msh")
    check_square(mesh)
    coarse = jc.read_mesh(SAMPLES / "square41.msh")
    assert mesh.n_nodes == coarse.n_nodes


def test_read_mesh_cuts_the_quadrilaterals_of_a_file():
    with pytest.warns(UserWarning, match="quad cells are cut into simplices"):
        check_square(jc.read_mesh(SAMPLES / "quads.msh"))


@pytest.mark.parametrize("name", ["hexes.msh", "hexes2.inp"])
@pytest.mark.filterwarnings("ignore:.*are read by their corners")
def test_read_mesh_cuts_the_hexahedra_of_a_file(name):
    with pytest.warns(UserWarning, match="8 hexahedron cells are cut into simplices"):
        check_cube(jc.read_mesh(SAMPLES / name))


def is_level(mesh, name):
    """Whether the nodes of a facet set have one height"""
    return np.ptp(mesh.points[np.unique(mesh.facets[name]), 1]) < 1e-12


def write_square(path):
    """The square with its groups by the wheel of Gmsh"""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        pytest.skip(f"Gmsh is not there, or a library that it needs: {error}")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        geo, model = gmsh.model.geo, gmsh.model
        corners = [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
        points = [geo.addPoint(x, y, 0.0, 0.4) for x, y in corners]
        lines = [geo.addLine(points[k], points[(k + 1) % 5]) for k in range(5)]
        surface = geo.addPlaneSurface([geo.addCurveLoop(lines)])
        geo.synchronize()
        model.addPhysicalGroup(0, [points[0]], name="corner")
        model.addPhysicalGroup(1, lines[:2], name="bottom")
        model.addPhysicalGroup(1, lines[1:2], name="bottom_right")
        model.addPhysicalGroup(1, [lines[3]], name="top")
        model.addPhysicalGroup(2, [surface], name="body")
        model.mesh.generate(2)
        gmsh.option.setNumber("Mesh.MshFileVersion", 2.2 if path.stem.endswith("22") else 4.1)
        gmsh.write(str(path))
    finally:
        gmsh.finalize()
    return path


@pytest.mark.parametrize("name", ["square22.msh", "square41.msh", "square.inp", "square.med"])
def test_read_mesh_reads_what_the_installed_gmsh_writes(tmp_path, name):
    if name.endswith("med"):
        pytest.importorskip("h5py")
    check_square(jc.read_mesh(write_square(tmp_path / name)))


def write_exodus(path):
    """Two hexahedral blocks of one cell each, with a side set over both and a set of nodes"""
    netcdf = pytest.importorskip("netCDF4")
    grid = [[x, y, z] for x in (0.0, 1.0, 2.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]
    cell = np.array([1, 5, 7, 3, 2, 6, 8, 4])  # from one, as in the file
    with netcdf.Dataset(path, "w", format="NETCDF3_64BIT_OFFSET") as file:

        def put(name, values, kind, *sizes):
            dimensions = []
            for axis, size in enumerate(np.shape(values)):
                dimensions.append(f"{name}_{axis}")
                file.createDimension(dimensions[-1], size)
            variable = file.createVariable(name, kind, dimensions)
            variable[:] = values
            return variable

        def put_names(name, texts):
            rows = [list(text.ljust(33, chr(0))) for text in texts]
            put(name, np.array(rows, "S1"), "S1")

        for axis, x in zip("xyz", np.transpose(grid), strict=True):
            put(f"coord{axis}", x, "f8")
        for k in (0, 1):
            put(f"connect{k + 1}", [cell + 4 * k], "i4").elem_type = "HEX8"
            put(f"elem_ss{k + 1}", [[1, 2], [2]][k], "i4")
        # Side 5 of a hexahedron is its bottom, side 2 looks to the right.
        put("side_ss1", [5, 5], "i4")
        put("side_ss2", [2], "i4")
        put("node_ns1", [1, 2, 3, 4], "i4")
        put("eb_prop1", [10, 20], "i4")
        put("ss_prop1", [1, 2], "i4")
        put("ns_prop1", [7], "i4")
        put_names("eb_names", ["soft", ""])
        put_names("ss_names", ["floor", "end"])
        put_names("ns_names", [""])
    return path


@pytest.mark.filterwarnings("ignore:.*cut into simplices")
def test_read_mesh_reads_blocks_and_sets_of_exodus(tmp_path):
    mesh = jc.read_mesh(write_exodus(tmp_path / "two.exo"))
    assert set(mesh.regions) == {"soft", "20"}
    for name, x in (("soft", 0.5), ("20", 1.5)):
        cells = mesh.cells[mesh.regions[name]]
        np.testing.assert_allclose(np.sum(cell_volumes(mesh.points, cells)), 1.0)
        assert np.all(np.abs(mesh.points[cells][:, :, 0] - x) < 0.6)
    planes = {"floor": (2, 0.0, 4), "end": (0, 2.0, 2), "7": (0, 0.0, 2)}
    assert set(mesh.facets) == set(planes)
    for name, (axis, level, count) in planes.items():
        assert len(mesh.facets[name]) == count
        np.testing.assert_array_equal(mesh.points[np.unique(mesh.facets[name]), axis], level)


def test_read_mesh_says_which_package_a_format_needs(tmp_path, monkeypatch):
    path = tmp_path / "mesh.exo"
    path.write_bytes(b"CDF")
    monkeypatch.setitem(sys.modules, "netCDF4", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxcontact\[formats\]'"):
        jc.read_mesh(path)


@pytest.mark.parametrize("ending", ["xdmf", "med"])
def test_read_mesh_reads_back_what_meshio_writes_with_h5py(tmp_path, ending):
    pytest.importorskip("h5py")
    mesh = jc.meshes.rectangle((1.0, 1.0), h=0.5)
    cells = [("line", mesh.facets["bottom"]), ("triangle", mesh.cells)]
    numbers = [np.full(len(block), k + 1) for k, (_, block) in enumerate(cells)]
    key = "cell_tags" if ending == "med" else "part"
    source = meshio.Mesh(mesh.points, cells, cell_data={key: numbers})
    source.cell_tags = {1: ["bottom", "held"], 2: ["body"]}
    source.write(tmp_path / f"mesh.{ending}")
    found = jc.read_mesh(tmp_path / f"mesh.{ending}")
    assert found.n_nodes == mesh.n_nodes
    expected = {"med": ({"bottom", "held"}, {"body"}), "xdmf": ({"part:1"}, {"part:2"})}[ending]
    assert (set(found.facets), set(found.regions)) == expected
    for name in found.facets:
        np.testing.assert_allclose(extents(found, name), NAMED["bottom"])
