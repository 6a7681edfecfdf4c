"""Scene files: every key is checked by name, and a file is the same as its Python program."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.cli import main
from jaxcontact.cli.scene_file import SceneFileError, read_scene_file

SCENES = Path(__file__).parents[2] / "notebooks" / "scenes"
SAMPLES = Path(__file__).parents[1] / "scene" / "samples"
EXAMPLES = sorted(SCENES.glob("*.toml"))
BAR = """
[mesh]
shape = "interval"
length = 1.0
h = 0.25
[material]
young = 1.0
poisson = 0.0
[contact.left]
obstacle = "plane"
point = [-0.1]
normal = [1.0]
[start]
velocity = [-1.0]
[run]
dt = 0.05
steps = 8
[output]
trajectory = true
"""


def scene_file(folder, *changes):
    text = BAR
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "bar.toml"
    path.write_text(text)
    return path


def test_there_are_five_examples():
    assert len(EXAMPLES) == 5


# What is asked for is shortened: the drawing of an animation is a test of its own.
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_right_and_its_program_can_be_read(path, capsys):
    assert main(["run", str(path), "--as-python"]) == 0
    program = capsys.readouterr().out
    compile(program, path.name, "exec")
    assert program.count("\n") < 60


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs_and_writes_what_it_asks_for(path, tmp_path, capsys):
    assert main(["run", str(path), "--out", str(tmp_path)]) == 0
    names = {
        "series": {"motion.pvd", "motion"},
        "animation": {"motion.gif"},
        "force": {"force.png", "force.csv"},
        "stress": {"stress.png"},
        "trajectory": {"motion.npz"},
    }
    wanted = set().union(*(names[key] for key in read_scene_file(path)["output"]))
    assert {file.name for file in tmp_path.iterdir()} == wanted
    said = capsys.readouterr().out
    assert "largest_force=0 N" not in said
    assert "converged" in said


def test_scene_file_makes_the_motion_that_its_program_makes(tmp_path, capsys):
    path = scene_file(tmp_path)
    assert main(["run", str(path), "--out", str(tmp_path / "run")]) == 0
    assert "wrote to" in capsys.readouterr().out
    assert main(["run", str(path), "--out", str(tmp_path / "python"), "--as-python"]) == 0
    program = capsys.readouterr().out
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    first, second = (jc.load_trajectory(tmp_path / x / "motion.npz") for x in ("run", "python"))
    assert np.any(first.active)
    np.testing.assert_allclose(first.unknowns, second.unknowns, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("young", "yuong"), r"\[material\] has no key 'yuong'; do you mean 'young'\? there are y"),
        (("young = 1.0", 'young = "soft"'), r"young must be a positive number \[Pa\], got 'soft'"),
        (("[start]", "[strat]"), r"\[strat\] is unknown; do you mean 'start'\?"),
        (("dt = 0.05", ""), r"\[run\] needs dt, a positive time"),
        (("steps = 8", "steps = 8.5"), r"\[run\] steps must be a positive whole number, got 8.5"),
        (
            ('"plane"', '"wall"'),
            r"\[contact.left\] needs obstacle = one of 'plane', .*; got 'wall'",
        ),
        (('"interval"', '"bar"'), r"\[mesh\] needs shape = one of 'interval'.* or a file = \.\.\."),
        (("length", "radius"), r"\[mesh\] has no key 'radius'; there are shape, length"),
        (("normal = [1.0]", "normal = [nan]"), r"normal must be a list of as many numbers"),
        (("[run]", "[run"), "no TOML"),
        (("[material]", "[other]"), r"\[material\] is missing"),
        (("trajectory = true", "trajectory = 1"), r"trajectory must be true or false, got 1"),
        (("[start]", "[contact]\nleft = 3\n[start]"), "no TOML"),
    ],
)
def test_scene_file_with_a_wrong_key_names_it_and_what_is_allowed(tmp_path, change, message):
    with pytest.raises(SceneFileError, match=message):
        read_scene_file(scene_file(tmp_path, change))


def test_scene_file_with_several_wrong_keys_has_a_line_for_each(tmp_path, capsys):
    path = scene_file(tmp_path, ("young", "yuong"), ("dt", "td"))
    assert main(["check", str(path)]) == 2
    assert capsys.readouterr().err.count("bar.toml: ") == 4  # two unknown, two missing


def test_scene_file_lets_free_bodies_turn_if_it_says_so(tmp_path, capsys):
    path = scene_file(tmp_path, ("dt = 0.05", "dt = 0.05\nlarge_rotation = true"))
    assert main(["run", str(path), "--as-python"]) == 0
    assert "    large_rotation=True,\n" in capsys.readouterr().out


def test_check_says_what_only_the_mesh_tells(tmp_path, capsys):
    path = scene_file(tmp_path, ("contact.left", "contact.lfet"))
    assert main(["check", str(path)]) == 2
    assert (
        "facet set 'lfet' is not in the mesh; it has ['left', 'right']" in capsys.readouterr().err
    )


def test_check_of_a_right_file_shows_mesh_and_courant_number(tmp_path, capsys):
    assert main(["check", str(scene_file(tmp_path))]) == 0
    said = capsys.readouterr().out
    assert "courant=0.2," in said
    assert "nothing is wrong" in said


def test_scene_file_that_is_not_there_ends_with_one_line(tmp_path, capsys):
    assert main(["check", str(tmp_path / "no.toml")]) == 1
    assert "no.toml" in capsys.readouterr().err


def test_info_shows_sets_regions_quality_and_courant_number(capsys):
    mesh = str(SAMPLES / "square22.msh")
    assert main(["info", mesh, "--young", "1e6", "--density", "1e3", "--dt", "1e-3"]) == 0
    said = capsys.readouterr().out
    for words in (
        "dimension 2, 12 nodes, 14 cells",
        "volume 1 m^2",
        "facet set 'top': 2 facets, 3 nodes",
        "region 'body': 14 cells",
        "mean ratio",
        "Courant number c dt / h",
    ):
        assert words in said


def test_info_without_a_time_step_says_what_is_missing(capsys):
    assert main(["info", str(SAMPLES / "square22.msh"), "--young", "1"]) == 2
    assert "needs both --young and --dt" in capsys.readouterr().err
