"""Interrupts, errors and damaged files do not cost what was computed."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from support.kinked import START, grazing
from support.optimize_problems import quadratic

import jaxcontact as jc
from jaxcontact.optimize import driver

METHOD = jc.LBFGS(memory=2)
ITERATIONS = 6


@pytest.fixture(scope="module")
def problem():
    objective, start, space, _ = quadratic()
    return objective, start, {"method": METHOD, **space}


@pytest.fixture(scope="module")
def whole(problem):
    objective, start, options = problem
    return jc.optimize(objective, start, iterations=ITERATIONS, **options)


class Stop:
    """An objective that raises at the k-th evaluation."""

    def __init__(self, objective, k, error):
        self.objective, self.left, self.error = objective, k, error

    def __call__(self, u):
        self.left -= 1
        if self.left == 0:
            raise self.error
        return self.objective(u)


def assert_continues(result, problem, whole):
    """The rest of the run is the one that nothing had stopped."""
    objective, _, options = problem
    history = result.history
    assert result.value == history.value.min()
    n = len(history.value)
    np.testing.assert_allclose(history.value, whole.history.value[:n], rtol=1e-12)
    rest = jc.optimize(objective, result, iterations=ITERATIONS + 1 - n, **options)
    np.testing.assert_allclose(rest.control, whole.control, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(rest.history.evaluations, whole.history.evaluations)


@pytest.mark.parametrize("k", [2, 3, 4, 7])
def test_optimize_interrupted_in_any_evaluation_after_the_first_can_go_on(problem, whole, k):
    objective, start, options = problem
    stop = Stop(objective, k, KeyboardInterrupt())
    result = jc.optimize(stop, start, iterations=ITERATIONS, **options)
    assert result.status is jc.Ending.INTERRUPTED
    assert_continues(result, problem, whole)


@pytest.mark.parametrize("k", [2, 5])
def test_optimize_ended_by_an_error_of_the_objective_hands_over_the_result(problem, whole, k):
    objective, start, options = problem
    with pytest.raises(ZeroDivisionError, match="by hand") as caught:
        jc.optimize(Stop(objective, k, ZeroDivisionError("by hand")), start, **options)
    assert "attribute `result`" in caught.value.__notes__[-1]
    assert caught.value.result.status is jc.Ending.FAILED
    assert_continues(caught.value.result, problem, whole)


@pytest.mark.parametrize("last", [0, 3])
def test_optimize_ended_by_an_error_of_the_callback_hands_over_the_result(problem, whole, last):
    objective, start, options = problem

    def callback(iteration, *_):
        if iteration == last:
            raise OSError("the disk is full")

    with pytest.raises(OSError, match="disk is full") as caught:
        jc.optimize(objective, start, callback=callback, **options)
    assert len(caught.value.result.history.value) == last + 1
    assert_continues(caught.value.result, problem, whole)


def test_optimize_interrupted_while_it_checks_a_result_returns_the_result(problem, whole):
    objective, _, options = problem
    again = jc.optimize(Stop(objective, 1, KeyboardInterrupt()), whole, **options)
    assert again.status is jc.Ending.INTERRUPTED
    np.testing.assert_array_equal(again.control, whole.control)
    assert again.history is whole.history


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (
            KeyboardInterrupt(),
            jc.Ending.INTERRUPTED,
            "before the certificate; call jc.stationarity",
        ),
        (jc.SolveError("step 3; reduce dt"), jc.Ending.STOPPED, "step 3; reduce dt"),
        (RuntimeError(), jc.Ending.STOPPED, "RuntimeError"),
    ],
    ids=["interrupt", "error", "silent error"],
)
def test_optimize_stopped_in_the_certificate_returns_the_result(monkeypatch, error, status, reason):
    def certify(*_):
        raise error

    monkeypatch.setattr(driver, "certify", certify)
    contact = grazing()
    result = jc.optimize(contact.objective, START, iterations=2, **contact.options)
    assert result.status is status
    assert result.stationarity is None
    assert result.uncertified.endswith(reason)
    assert result.value == result.history.value[2]


def test_save_that_fails_keeps_the_file_that_was_there(whole, tmp_path, monkeypatch):
    path = tmp_path / "result.npz"
    whole.save(path)

    def savez(file, **_):
        file.write(b"half of it")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", savez)
    with pytest.raises(OSError, match="no space"):
        whole.save(path)
    np.testing.assert_array_equal(jc.load_result(path).control, whole.control)
    assert [file.name for file in tmp_path.iterdir()] == ["result.npz"]


def test_saved_result_keeps_why_it_has_no_certificate(whole, tmp_path):
    path = tmp_path / "result.npz"
    whole.save(path)
    assert whole.uncertified.startswith("the objective does not tell its motion")
    assert jc.load_result(path).uncertified == whole.uncertified
    replace(whole, uncertified="").save(path)
    lost = "a file does not keep the certificate; jc.stationarity makes it anew"
    assert jc.load_result(path).uncertified == lost
    # As of a file that an older version wrote.
    assert jc.load_result(resaved(path.read_bytes(), path, uncertified=None)).uncertified == lost


@pytest.fixture(scope="module")
def saved(whole, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "result.npz"
    whole.save(path)
    return path.read_bytes()


def test_load_result_refuses_every_truncated_file(saved, tmp_path):
    path = tmp_path / "result.npz"
    for length in np.linspace(0, len(saved) - 1, 101).astype(int):
        path.write_bytes(saved[:length])
        with pytest.raises(ValueError, match="cannot be read as a saved result"):
            jc.load_result(path)


def test_load_result_of_a_file_with_a_wrong_byte_raises_or_is_right(saved, whole, tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "result.npz"
    messages = []
    # Bytes of content and of the directory at the end, in which most flips must be noticed.
    for place in rng.choice(len(saved), 400, replace=False):
        wrong = bytearray(saved)
        wrong[place] ^= 1 << rng.integers(8)
        path.write_bytes(wrong)
        try:
            loaded = jc.load_result(path)
        except ValueError as error:
            messages.append(str(error))
        else:  # a date, or another field that nobody reads
            np.testing.assert_array_equal(loaded.control, whole.control)
            np.testing.assert_array_equal(loaded.history.value, whole.history.value)
            assert loaded.status is whole.status
            assert len(loaded.state) == 8
    assert len(messages) > 200
    assert all(str(path) in message for message in messages)


def resaved(saved, path, **changes):
    path.write_bytes(saved)
    with np.load(path) as file:
        data = dict(file) | changes
    np.savez(path, **{name: value for name, value in data.items() if value is not None})
    return path


@pytest.mark.parametrize(
    "changes",
    [
        {"status": "DANCED"},
        {"value": np.zeros(2)},
        {"history_value": np.zeros(3)},
        {"history_value": np.zeros((7, 1))},
        {"state_003": None},
        {"parameters": np.array(["a"])},
    ],
    ids=str,
)
def test_load_result_refuses_parts_that_do_not_fit(saved, tmp_path, changes):
    path = resaved(saved, tmp_path / "result.npz", **changes)
    with pytest.raises(ValueError, match="do not fit each other"):
        jc.load_result(path)


def test_load_result_of_what_is_no_file_of_arrays_says_so(tmp_path):
    (tmp_path / "text.npz").write_text("control")
    np.save(tmp_path / "array.npz.npy", np.zeros(3))
    np.savez(tmp_path / "pickled.npz", control=np.array([{}], dtype=object))
    for name in ("text.npz", "array.npz.npy", "pickled.npz"):
        with pytest.raises(ValueError, match="cannot be read as a saved result"):
            jc.load_result(tmp_path / name)
    with pytest.raises(FileNotFoundError, match=r"there is no file .*none\.npz; check its name"):
        jc.load_result(tmp_path / "none.npz")
    with pytest.raises(IsADirectoryError, match="is a folder; name a file in it"):
        jc.load_result(tmp_path)


def test_optimize_refuses_a_saved_state_of_another_shape(saved, problem, tmp_path):
    objective, _, options = problem
    path = resaved(saved, tmp_path / "result.npz", state_004=np.zeros((3, 2)))
    with pytest.raises(ValueError, match="cannot be continued"):
        jc.optimize(objective, jc.load_result(path), **options)
    assert jnp.isfinite(jc.load_result(path).value)
