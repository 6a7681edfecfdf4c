"""Long runs: progress while they run, parts, files, and a process that is killed at any moment."""

import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from support.bodies import BLOCK, DT, block, random_control

import jaxcontact as jc
from jaxcontact.output.vtu import read_list

SCALING = Path(__file__).parents[2] / "SCALING.md"
CALLS: list[tuple[int, int]] = []


def note(done, steps):
    CALLS.append((done, steps))


@pytest.fixture(autouse=True)
def _no_calls_yet():
    CALLS.clear()


@pytest.fixture(scope="module")
def stepper():
    return block()


@pytest.fixture(scope="module")
def motion(stepper):
    return jc.simulate(stepper, random_control(12))


def same(first, second):
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


def test_progress_is_reported_every_so_many_steps_and_at_the_end(stepper, motion):
    watched = jc.simulate(stepper, random_control(12), progress=jc.Progress(5, note))
    jax.effects_barrier()
    assert CALLS == [(5, 12), (10, 12), (12, 12)]
    same(watched, motion)


def test_progress_is_reported_under_jit_and_grad_and_changes_no_gradient(stepper):
    def cost(u, progress=None):
        return jnp.sum(jc.simulate(stepper, u, save_every=3, progress=progress).final.velocity ** 2)

    plain = jax.jit(jax.grad(cost))(random_control(12))
    watched = jax.jit(jax.grad(lambda u: cost(u, jc.Progress(6, note))))(random_control(12))
    jax.effects_barrier()
    assert CALLS == [(6, 12), (12, 12)]
    np.testing.assert_allclose(watched, plain, rtol=1e-12, atol=1e-15)


def test_progress_is_reported_twenty_times_if_nothing_else_is_said(stepper):
    jc.simulate(stepper, steps=60, progress=jc.Progress(report=note))
    jax.effects_barrier()
    assert CALLS == [(done, 60) for done in range(3, 61, 3)]


def test_progress_of_a_batch_is_reported_once(stepper):
    controls = jnp.stack([random_control(6), 2.0 * random_control(6)])
    jax.vmap(lambda u: jc.simulate(stepper, u, progress=jc.Progress(3, note)).unknowns)(controls)
    jax.effects_barrier()
    assert CALLS == [(3, 6), (6, 6)]


def test_progress_prints_one_line_that_ends_with_the_last_step(stepper, capfd):
    jc.simulate(stepper, steps=4, progress=jc.Progress(2))
    jax.effects_barrier()
    said = capfd.readouterr().err
    assert said.startswith("\rstep 2 of 4")
    assert "\rstep 4 of 4" in said
    assert said.endswith("\n")


@pytest.mark.parametrize("wrong", [{"every": 0}, {"report": "bar"}])
def test_progress_that_cannot_report_says_what_it_takes(wrong):
    with pytest.raises(ValueError, match="positive number of steps and a function"):
        jc.Progress(**wrong)


def test_trajectory_that_was_saved_is_loaded_bit_for_bit(motion, tmp_path):
    motion.save(tmp_path / "motion.npz")
    loaded = jc.load_trajectory(tmp_path / "motion.npz")
    same(loaded, motion)
    same(loaded.final, motion.final)
    assert repr(loaded) == repr(motion)


def test_trajectory_with_moving_supports_keeps_its_nodal_fields(tmp_path):
    scene = jc.Scene(BLOCK, jc.KelvinVoigt(young=100.0, poisson=0.3), clamped=("top",))
    push = jc.Schedule(motion={"top": np.linspace(0.0, 0.1, 4)[:, None] * np.ones((1, 2))})
    moved = jc.simulate(jc.prepare(jc.discretize(scene), DT), schedule=push)
    moved.save(tmp_path / "moved.npz")
    same(jc.load_trajectory(tmp_path / "moved.npz"), moved)


def test_file_that_is_no_trajectory_is_refused(stepper, tmp_path):
    stepper.system.save(tmp_path / "system.npz")
    with pytest.raises(ValueError, match="cannot be read as a saved Trajectory"):
        jc.load_trajectory(tmp_path / "system.npz")


def test_motion_in_parts_is_that_of_one_run(stepper, motion):
    control = random_control(12)
    first = jc.simulate(stepper, control[:6])
    second = jc.simulate(stepper, control[6:], initial=first.final)
    np.testing.assert_allclose(second.unknowns, motion.unknowns[6:], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(second.contact_force, motion.contact_force[6:], atol=1e-11)


def test_series_that_grows_holds_what_one_series_of_the_whole_motion_holds(
    stepper, motion, tmp_path
):
    whole = jc.export.TimeSeries(tmp_path / "whole.pvd", BLOCK, stepper.system)
    whole.append(motion, 0)
    parts = jc.export.TimeSeries(tmp_path / "parts.pvd", BLOCK, stepper.system)
    states: dict[int, jc.State | None] = {0: None}
    for start in (0, 4, 4, 8):  # the second part twice, as after a kill
        control = random_control(12)[start : start + 4]
        part = jc.simulate(stepper, control, initial=states[start])
        parts.append(part, start)
        assert len(read_list(tmp_path / "parts.pvd")) == start + 5
        states[start + 4] = part.final
    times = read_list(tmp_path / "whole.pvd")
    assert list(times.values()) == list(read_list(tmp_path / "parts.pvd").values())
    np.testing.assert_allclose(list(times.values()), motion.time, rtol=1e-12)
    for name in times:
        a = meshio.read(tmp_path / "whole" / name).point_data
        b = meshio.read(tmp_path / "parts" / name.replace("whole", "parts")).point_data
        for field, values in a.items():
            np.testing.assert_allclose(b[field], values, rtol=0.0, atol=1e-10, err_msg=field)


def program():
    """The program of the section on long runs."""
    blocks = re.findall(r"```python\n(.*?)```", SCALING.read_text(encoding="utf-8"), re.DOTALL)
    (found,) = [block for block in blocks if "load_trajectory" in block]
    return found


def start_program(folder):
    folder.mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-c", program()], stdout=subprocess.PIPE, text=True, cwd=folder
    )


def run_with_kills(folder, draw):
    """Start the program until it ends by itself, every time but the last killed; return how often.

    Half of the kills come while it starts, the others after a part of the motion.
    """
    for kills in range(100):
        with start_program(folder) as run:
            if kills < 8:
                if kills % 2:
                    run.stdout.readline()
                    time.sleep(draw.uniform(0.0, 0.05))
                else:
                    time.sleep(draw.uniform(0.5, 3.0))
                run.send_signal(signal.SIGKILL)
            else:
                run.communicate()
            ended = run.wait() == 0
        listed = read_list(folder / "run" / "bounce.pvd")
        assert all(len(meshio.read(folder / "run/bounce" / name).points) for name in listed)
        if ended:
            return kills
    raise AssertionError("the program never ended")


@pytest.mark.slow
def test_run_that_is_killed_at_random_moments_ends_bit_for_bit_as_one_that_is_not(tmp_path):
    draw, kills, rounds = random.Random(22), 0, 0
    with start_program(tmp_path / "quiet") as quiet:
        quiet.communicate()
    files = [x.relative_to(tmp_path / "quiet") for x in (tmp_path / "quiet").rglob("*.*")]
    assert len(files) == 20 + 1 + 101
    while kills < 20:
        folder = tmp_path / f"killed{rounds}"
        kills, rounds = kills + run_with_kills(folder, draw), rounds + 1
        for file in files:
            first, second = tmp_path / "quiet" / file, folder / file
            if file.suffix == ".npz":
                same(jc.load_trajectory(first), jc.load_trajectory(second))
            else:
                assert first.read_bytes() == second.read_bytes(), file
