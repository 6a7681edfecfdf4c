import os
import xml.etree.ElementTree as ElementTree

import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.output.export import write_time_series

STEPS, DT = 12, 5e-5


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=3.75, steps=STEPS, dt=DT, gap=0.01)


@pytest.fixture(scope="module")
def trajectory(problem):
    """Touches the plane within the twelve steps."""
    return problem.simulate(problem.reference)


@pytest.fixture(scope="module")
def series(problem, trajectory, tmp_path_factory):
    path = tmp_path_factory.mktemp("new") / "folder" / "bounce.pvd"
    force = problem.control_scale * problem.reference
    return write_time_series(path, problem.scene.mesh, problem.system, trajectory, force)


def bar_trajectory():
    mesh = jc.meshes.interval(1.0, h=0.25)
    scene = jc.Scene(
        mesh,
        jc.KelvinVoigt(young=1.0, poisson=0.0),
        contact={"left": jc.HalfSpace(point=np.array([-0.1]), normal=np.array([1.0]))},
    )
    system = jc.discretize(scene)
    falling = jc.State(jnp.zeros((5, 1)), -jnp.ones((5, 1)))
    return mesh, system, jc.simulate(jc.prepare(system, 0.05), steps=3, initial=falling)


def test_time_series_lists_existing_files_with_their_times(series, trajectory):
    entries = ElementTree.parse(series[0]).findall(".//DataSet")
    assert [series[0].parent / entry.attrib["file"] for entry in entries] == series[1:]
    np.testing.assert_allclose(
        [float(entry.attrib["timestep"]) for entry in entries], trajectory.time, rtol=1e-11
    )
    assert all(path.exists() for path in series)


def test_time_series_keeps_mesh_and_fields_exactly(series, problem, trajectory):
    mesh = problem.scene.mesh
    step = 7
    read = meshio.read(series[1 + step])
    np.testing.assert_array_equal(read.points[:, :2], mesh.points)
    np.testing.assert_array_equal(read.cells_dict["triangle"], mesh.cells)
    for name, expected in (
        ("displacement", trajectory.displacement[step]),
        ("velocity", trajectory.velocity[step]),
        ("control", problem.control_scale * problem.reference[step - 1]),
    ):
        np.testing.assert_array_equal(read.point_data[name][:, :2], expected)
        np.testing.assert_array_equal(read.point_data[name][:, 2], 0.0)


def test_time_series_pressure_integrates_to_the_contact_force(series, problem, trajectory):
    step = int(np.argmax(np.sum(trajectory.contact_impulse, axis=1)))
    area = np.zeros(problem.system.n_nodes)
    area[problem.system.contact_nodes] = problem.system.contact_area
    read = meshio.read(series[2 + step])
    force = np.sum(trajectory.contact_impulse[step]) / DT
    assert force > 0.0
    assert area @ read.point_data["contact_pressure"] == pytest.approx(float(force), rel=1e-12)
    assert np.sum(read.point_data["contact_impulse"]) == pytest.approx(float(DT * force), rel=1e-12)


def test_time_series_gap_is_not_a_number_off_the_contact_set(series, problem, trajectory):
    nodes = problem.system.contact_nodes
    gap = meshio.read(series[4]).point_data["gap"]
    np.testing.assert_array_equal(gap[nodes], trajectory.gap[3])
    assert np.isnan(np.delete(gap, nodes)).all()


def test_time_series_starts_without_control_and_impulse(series):
    start = meshio.read(series[1])
    assert not np.any(start.point_data["control"])
    assert not np.any(start.point_data["contact_impulse"])


def test_time_series_of_every_fifth_step_ends_with_the_last(problem, trajectory, tmp_path):
    path = tmp_path / "thin.pvd"
    files = write_time_series(path, problem.scene.mesh, problem.system, trajectory, every=5)
    assert [file.stem for file in files[1:]] == [f"thin_{k:02d}" for k in (0, 5, 10, 12)]
    last = meshio.read(files[-1])
    np.testing.assert_array_equal(
        last.point_data["displacement"][:, :2], trajectory.displacement[-1]
    )
    assert "control" not in last.point_data


def test_time_series_of_a_bar_has_lines_and_three_components(tmp_path):
    mesh, system, trajectory = bar_trajectory()
    files = write_time_series(tmp_path / "bar.pvd", mesh, system, trajectory)
    read = meshio.read(files[-1])
    assert read.cells_dict["line"].shape == (4, 2)
    np.testing.assert_array_equal(read.point_data["velocity"][:, 0], trajectory.velocity[-1, :, 0])
    assert read.points.shape == read.point_data["velocity"].shape == (5, 3)


@pytest.mark.parametrize("name", ["a & b", "h<1", 'the "new" one', "it's", "größer"])
def test_time_series_of_any_name_is_well_formed(tmp_path, name):
    files = write_time_series(tmp_path / f"{name}.pvd", *bar_trajectory())
    entries = ElementTree.parse(files[0]).findall(".//DataSet")
    assert [tmp_path / entry.attrib["file"] for entry in entries] == files[1:]


def test_time_series_leaves_other_files_alone(problem, trajectory, tmp_path):
    mine = tmp_path / "a" / "mine.vtu"
    mine.parent.mkdir()
    mine.write_text("mine")
    write_time_series(
        tmp_path / "a.pvd", problem.scene.mesh, problem.system, trajectory, every=STEPS
    )
    assert mine.read_text() == "mine"


def test_time_series_that_fails_keeps_the_files_that_were_there(tmp_path, monkeypatch):
    bar = bar_trajectory()
    files = write_time_series(tmp_path / "a.pvd", *bar)
    before = {file: file.read_bytes() for file in files}
    stillborn = tmp_path / "b.pvd"
    write = meshio.Mesh.write

    def fill_the_disk(picture, name, **options):
        write(picture, name, **options)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(meshio.Mesh, "write", fill_the_disk)
    with pytest.raises(OSError, match=r"cannot write .*a_0\.vtu: No space left on device; choose"):
        write_time_series(tmp_path / "a.pvd", *bar)
    assert {file: file.read_bytes() for file in files} == before
    assert sorted(file.name for file in files[1].parent.iterdir()) == [
        file.name for file in files[1:]
    ]
    # A list that was never there is not made before its files.
    with pytest.raises(OSError, match="No space"):
        write_time_series(stillborn, *bar)
    assert not stillborn.exists()


def test_time_series_that_cannot_list_its_files_keeps_the_old_list(tmp_path, monkeypatch):
    bar = bar_trajectory()
    path = tmp_path / "a.pvd"
    path.write_text("old")
    replace = os.replace

    def stop_at_the_list(part, place):
        if str(place).endswith(".pvd"):
            raise OSError(28, "No space left on device")
        replace(part, place)

    monkeypatch.setattr(os, "replace", stop_at_the_list)
    with pytest.raises(OSError, match=r"cannot write .*a\.pvd: No space"):
        write_time_series(path, *bar)
    assert path.read_text() == "old"


def test_time_series_whose_folder_is_a_file_says_so(tmp_path):
    (tmp_path / "a").write_text("mine")
    with pytest.raises(FileExistsError, match=r"cannot make the folder .*a: File exists; choose"):
        write_time_series(tmp_path / "a.pvd", *bar_trajectory())
    assert (tmp_path / "a").read_text() == "mine"


def test_time_series_of_some_of_the_states_is_refused(problem, tmp_path):
    force = problem.control_scale * problem.reference
    coarse = jc.simulate(problem.stepper, force, save_every=3)
    with pytest.raises(ValueError, match=r"5 states of 12 steps.*simulate it with save_every=1"):
        write_time_series(tmp_path / "a.pvd", problem.scene.mesh, problem.system, coarse)


def test_time_series_refuses_what_does_not_fit(problem, trajectory, tmp_path):
    mesh, system = problem.scene.mesh, problem.system
    with pytest.raises(ValueError, match=r"ends in \.pvd, got .*\.xdmf"):
        write_time_series(tmp_path / "a.xdmf", mesh, system, trajectory)
    with pytest.raises(ValueError, match="every must be 1 or more, got 0"):
        write_time_series(tmp_path / "a.pvd", mesh, system, trajectory, every=0)
    with pytest.raises(ValueError, match="pass the mesh of the scene"):
        write_time_series(tmp_path / "a.pvd", bar_trajectory()[0], system, trajectory)
    with pytest.raises(ValueError, match=r"control must have shape \(12, "):
        write_time_series(tmp_path / "a.pvd", mesh, system, trajectory, problem.reference[1:])
    assert not list(tmp_path.iterdir())
