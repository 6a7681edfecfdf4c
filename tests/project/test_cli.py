import csv
import json
import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree

import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact import cli
from jaxcontact.cli import half_disc, main
from jaxcontact.output.page import CAPTIONS

TINY = ["half-disc", "--h", "3.75", "--steps", "12", "--gap", "0.01", "--iterations", "3"]
PICTURES = {
    f"{name}.png"
    for name in (
        "control",
        "functional",
        "distance",
        "state-error",
        "contact-force",
        "energy",
        "active-set",
        "stress",
    )
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run in a folder that held a file of the user's."""
    folder = tmp_path_factory.mktemp("out")
    (folder / "notes.txt").write_text("mine")
    return main([*TINY, "--out", str(folder)]), folder


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=3.75, steps=12, gap=0.01)


def read_history(folder):
    with (folder / "history.csv").open(newline="") as file:
        return {
            name: np.array(column, float) for name, *column in zip(*csv.reader(file), strict=True)
        }


def test_half_disc_succeeds_and_writes_everything(finished):
    code, folder = finished
    assert code == 0
    assert {path.name for path in folder.iterdir()} == {
        "config.json",
        "history.csv",
        "control.npz",
        "half-disc.pvd",
        "half-disc",
        "notes.txt",
        "motion.gif",
        "index.html",
        *PICTURES,
    }


def test_half_disc_leaves_files_of_the_user_alone(finished):
    assert (finished[1] / "notes.txt").read_text() == "mine"


def test_half_disc_history_starts_at_no_control_and_ends_at_the_saved_one(finished, problem):
    folder = finished[1]
    history = read_history(folder)
    control = np.load(folder / "control.npz")["control"]
    assert list(history) == [
        "iteration",
        "value",
        "gradient_norm",
        "distance_to_reference",
        "evaluations",
    ]
    np.testing.assert_array_equal(history["iteration"], np.arange(4))
    np.testing.assert_allclose(
        history["value"][[0, -1]],
        [problem.objective(0.0 * problem.reference), problem.objective(control)],
        rtol=1e-12,
    )
    assert history["value"][-1] < 0.9 * history["value"][0]


def test_half_disc_distance_is_relative_to_the_reference_in_l2(finished, problem):
    folder = finished[1]
    mass = problem.system.nodal_mass.to_scipy()

    def norm(u):
        return np.sqrt(sum(np.vdot(step, mass @ step) for step in np.asarray(u)))

    control = np.load(folder / "control.npz")["control"]
    expected = norm(control - problem.reference) / norm(problem.reference)
    distance = read_history(folder)["distance_to_reference"]
    assert distance[0] == pytest.approx(1.0, rel=1e-14)
    assert distance[-1] == pytest.approx(expected, rel=1e-12)


def test_half_disc_config_repeats_arguments_and_versions(finished):
    config = json.loads((finished[1] / "config.json").read_text())
    assert config["arguments"] == {
        "h": 3.75,
        "steps": 12,
        "dt": 5e-5,
        "gap": 0.01,
        "iterations": 3,
        "method": "steepest-descent",
    }
    assert {"python", "jaxcontact", "jax", "jaxlib"} <= set(config["versions"])


def test_half_disc_time_series_has_every_step(finished):
    entries = ElementTree.parse(finished[1] / "half-disc.pvd").findall(".//DataSet")
    times = [float(entry.attrib["timestep"]) for entry in entries]
    np.testing.assert_allclose(times, 5e-5 * np.arange(13), rtol=1e-11)


def test_half_disc_without_matplotlib_writes_the_rest_and_says_how_to_install_it(
    tmp_path, monkeypatch, capsys
):
    # None in sys.modules makes an import fail as if the package were not there.
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main([*TINY, "--out", str(tmp_path)]) == 0
    written = {path.name for path in tmp_path.iterdir()}
    assert "index.html" not in written
    assert {"history.csv", "control.npz", "half-disc.pvd"} <= written
    assert not PICTURES & written
    assert "pip install 'jaxcontact[plot]'" in capsys.readouterr().out


def test_half_disc_interrupted_writes_what_there_is(tmp_path, monkeypatch, capsys):
    distance, calls = half_disc.distance, []

    def interrupt_second_iteration(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return distance(*arguments)

    monkeypatch.setattr(half_disc, "distance", interrupt_second_iteration)
    assert main([*TINY, "--out", str(tmp_path)]) == 130
    history = read_history(tmp_path)
    assert len(history["iteration"]) == 3
    assert np.isnan(history["distance_to_reference"][-1])
    assert {path.name for path in tmp_path.iterdir()} >= {"control.npz", *PICTURES}
    assert "interrupted" in capsys.readouterr().out


def test_half_disc_page_shows_every_picture_with_its_caption(finished):
    page = (finished[1] / "index.html").read_text(encoding="utf-8")
    assert set(CAPTIONS) == PICTURES | {"motion.gif"}
    for name, (title, *_) in CAPTIONS.items():
        assert f'<img src="{name}" alt="{title}">' in page
    assert "value at the result" in page


def test_half_disc_removes_the_time_series_of_a_longer_run(finished):
    folder = finished[1] / "half-disc"
    stale = folder / "half-disc_149.vtu"
    stale.write_text("old")
    assert main([*TINY, "--out", str(finished[1])]) == 0
    assert not stale.exists()
    assert len(list(folder.iterdir())) == 13


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError("lost")])
def test_half_disc_that_ends_after_the_optimisation_keeps_control_and_history(
    error, tmp_path, monkeypatch, capsys
):
    def stop(*_):
        raise error

    monkeypatch.setattr(jc, "energy", stop, raising=False)
    assert main([*TINY, "--out", str(tmp_path)]) == (130 if error is KeyboardInterrupt else 1)
    assert len(read_history(tmp_path)["value"]) == 4
    assert np.load(tmp_path / "control.npz")["control"].any()
    assert "  control.npz\n" in capsys.readouterr().out


def test_half_disc_that_is_killed_in_the_optimisation_has_kept_control_and_history(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("jaxcontact.cli.output.PERIOD", 0.0)

    def die(_):
        rows = (tmp_path / "history.csv").read_text().splitlines()
        assert len(rows) == 3
        assert rows[2].startswith("1,")
        assert np.load(tmp_path / "control.npz")["control"].any()
        raise SystemExit(9)

    def die_in_the_third(*arguments):
        calls.append(arguments)
        return die(arguments) if len(calls) == 3 else before(*arguments)

    calls, before = [], half_disc.distance
    monkeypatch.setattr(half_disc, "distance", die_in_the_third)
    with pytest.raises(SystemExit, match="9"):
        main([*TINY, "--out", str(tmp_path)])


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="has no SIGINT for other processes")
@pytest.mark.parametrize("pause", [0.0, 0.1, 1.0])
def test_half_disc_that_is_interrupted_twice_keeps_control_and_history(pause, tmp_path):
    program = "import sys; from jaxcontact.cli import main; sys.exit(main())"
    words = [*TINY[:-1], "1000000", "--method", "adam", "--out", str(tmp_path)]
    with subprocess.Popen([sys.executable, "-c", program, *words]) as run:
        history = tmp_path / "history.csv"
        while not history.exists() or history.read_text().count("\n") < 4:
            assert run.poll() is None
            time.sleep(0.1)
        for _ in range(2):
            run.send_signal(signal.SIGINT)
            time.sleep(pause)
        assert run.wait() == 130
    assert len(read_history(tmp_path)["value"]) > 1
    assert np.load(tmp_path / "control.npz")["control"].any()


def test_help_needs_no_jax():
    program = (
        "import sys, jaxcontact.cli\n"
        "try: jaxcontact.cli.main(['half-disc', '--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'jax', 'numpy', 'scipy', 'optax'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--iterations" in done.stdout


def test_half_disc_unsolved_step_ends_with_its_message(tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise jc.SolveError("step 3 of 12 ended as not converged")

    monkeypatch.setattr(jc.scenes, "half_disc_control", fail)
    assert main([*TINY, "--out", str(tmp_path)]) == 1
    assert "step 3 of 12" in capsys.readouterr().err


def test_half_disc_on_a_full_disk_ends_with_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "config.json").write_text("old")

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    assert main([*TINY, "--out", str(tmp_path)]) == 1
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert line.startswith(f"jaxcontact: cannot write {tmp_path}/config.json: No space left on")
    assert "wrote to" not in said.out
    assert (tmp_path / "config.json").read_text() == "old"


def test_half_disc_whose_file_is_a_folder_ends_with_one_line_and_what_was_written(tmp_path, capsys):
    (tmp_path / "control.npz").mkdir()
    assert main([*TINY, "--out", str(tmp_path)]) == 1
    said = capsys.readouterr()
    # Before it are lines of the progress bar.
    assert "Traceback" not in said.err
    assert (
        said.err.splitlines()[-1]
        == f"jaxcontact: {tmp_path}/control.npz is a folder; name a file in it"
    )
    assert said.out.endswith("  config.json\n  history.csv\n")


@pytest.mark.parametrize("large", [["--h", "1e-9"], ["--h", "5e-324"], ["--steps", "1000000000"]])
def test_half_disc_that_no_memory_holds_ends_with_one_line(large, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(half_disc, "available_memory", lambda: 10**11)
    assert main(["half-disc", "--out", str(tmp_path), *large]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "GB of memory, and 1e+02 GB are free; choose a larger --h or fewer --steps" in line


def test_half_disc_is_not_refused_where_the_memory_is_unknown_or_holds_it(monkeypatch):
    for free in (None, 3 * 10**7):
        monkeypatch.setattr(half_disc, "available_memory", lambda free=free: free)
        half_disc.check_room(1.25, 150)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--h", "0"], "--h: must be above 0 and at most 15, got '0'"),
        (["--h", "16"], "--h: must be above 0 and at most 15"),
        (["--dt", "0"], "--dt: must be a positive number, got '0'"),
        (["--h", "15", "--dt", "1e200"], "positive definite"),
        (["--dt", "nan"], "--dt: must be a positive number"),
        (["--gap", "-1"], "--gap: must be zero or a positive number"),
        (["--steps", "1.5"], "--steps: must be a whole number from 1"),
        (["--steps", "1" + 400 * "0"], "--steps: must be a whole number from 1 to 2147483647"),
        (["--iterations", "0"], "--iterations: must be a whole number from 1"),
        (["--method", "magic"], "invalid choice: 'magic'"),
        (["--method"], "--method: expected one argument"),
    ],
)
def test_bad_arguments_end_with_code_2_and_a_message(wrong, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["half-disc", "--out", str(tmp_path), *wrong])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_out_that_is_a_file_ends_with_code_2_and_keeps_the_file(tmp_path, capsys):
    file = tmp_path / "thesis.tex"
    file.write_text("mine")
    with pytest.raises(SystemExit) as stop:
        main([*TINY, "--out", str(file)])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "--out: cannot make the folder" in said
    assert said.startswith("usage: jaxcontact half-disc ")
    assert file.read_text() == "mine"


@pytest.mark.parametrize("name", cli.METHODS)
def test_every_method_lowers_a_quadratic(name, problem):
    result = jc.optimize(
        lambda u: jnp.vdot(u - 1.0, u - 1.0),
        jnp.zeros_like(problem.reference),
        method=half_disc.METHODS[name],
        system=problem.system,
        dt=problem.dt,
        iterations=2,
    )
    assert len(result.history.value) > 1
    assert result.value < result.history.value[0]
