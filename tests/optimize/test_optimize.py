"""Optimisation methods and the loop around them, on problems with known minimisers."""

import csv
import math
import sys

import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.tree_util import Partial
from support.optimize_problems import graded_bar, l2_distance, quadratic

import jaxcontact as jc
from jaxcontact.control.inner_product import Weighted

METHODS = {
    "steepest descent": jc.SteepestDescent(),
    "lbfgs": jc.LBFGS(memory=6),
    "newton": jc.NewtonCG(),
    "optax": jc.Optax(optax.sgd(0.1, momentum=0.9)),
}
DESCENT = [name for name in METHODS if name != "optax"]


def each_method(names=tuple(METHODS)):
    return pytest.mark.parametrize("method", [METHODS[n] for n in names], ids=list(names))


@pytest.fixture(scope="module")
def problem():
    return quadratic()


@each_method()
def test_optimize_finds_the_minimiser_of_a_quadratic(problem, method):
    objective, start, space, minimiser = problem
    result = jc.optimize(objective, start, method=method, iterations=400, **space)
    assert l2_distance(result.control, minimiser, **space) < 1e-6
    assert result.value == pytest.approx(float(objective(result.control)), rel=1e-13)


def evaluations_to(objective, start, minimiser, space, method, decrease=1e-4):
    result = jc.optimize(objective, start, method=method, iterations=300, **space)
    least = float(objective(minimiser))
    history = result.history
    reached = history.value - least <= decrease * (history.value[0] - least)
    assert reached.any()
    k = int(np.argmax(reached))
    return int(history.evaluations[k] + history.hessian_products[k])


@each_method(DESCENT)
def test_optimize_needs_the_same_evaluations_on_every_mesh(method):
    counts = []
    for n_cells, steps in ((16, 8), (48, 24)):
        objective, start, space, minimiser = quadratic(n_cells, steps)
        counts.append(evaluations_to(objective, start, minimiser, space, method))
    assert max(counts) <= 1.2 * counts[0]


def test_optimize_in_the_euclidean_product_needs_far_more_evaluations():
    # The counterexample that gives the test above its meaning: on a graded mesh the inner
    # product is what makes the counts small and equal.
    objective, start, space, minimiser = quadratic(32, 16)
    euclidean = {"inner_product": Weighted(jnp.ones((1, 1, 1)))}
    method = METHODS["lbfgs"]
    counts = [
        evaluations_to(objective, start, minimiser, product, method)
        for product in (space, euclidean)
    ]
    assert counts[1] > 2 * counts[0]


@each_method(DESCENT)
def test_optimize_descends_in_every_iteration(problem, method):
    objective, start, space, _ = problem
    history = jc.optimize(objective, start, method=method, iterations=12, **space).history
    assert np.all(np.diff(history.value) < 0.0)


def test_history_counts_what_was_evaluated(problem):
    objective, start, space, _ = problem
    calls = []

    def counted(u):
        calls.append(0)
        return objective(u)

    history = jc.optimize(counted, start, method=jc.LBFGS(), iterations=5, **space).history
    assert history.evaluations[-1] == len(calls)
    assert history.value.shape == history.seconds.shape == (6,)
    assert history.evaluations[0] == 1
    assert np.all(history.hessian_products == 0)
    assert np.all(np.diff(history.seconds) > 0.0)


def test_history_gradient_norm_is_the_l2_norm(problem):
    objective, start, space, _ = problem
    history = jc.optimize(objective, start, iterations=0, **space).history
    _, gradient = jc.l2_value_and_grad(objective, **space)(start)
    assert history.gradient_norm[0] == pytest.approx(l2_distance(gradient, start, **space))


def test_history_to_csv_reads_back(problem, tmp_path):
    objective, start, space, _ = problem
    history = jc.optimize(objective, start, iterations=3, **space).history
    history.to_csv(tmp_path / "history.csv")
    with open(tmp_path / "history.csv") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["iteration"]) for row in rows] == [0, 1, 2, 3]
    np.testing.assert_array_equal([float(row["value"]) for row in rows], history.value)


@each_method(DESCENT)
def test_optimize_stops_at_the_tolerance(problem, method):
    objective, start, space, _ = problem
    result = jc.optimize(objective, start, method=method, tolerance=1e-3, **space)
    assert result.status is jc.Ending.CONVERGED
    norms = result.history.gradient_norm
    assert norms[-1] <= 1e-3 * norms[0] < norms[-2]


@each_method()
def test_optimize_interrupted_returns_the_best_so_far(problem, method):
    objective, start, space, _ = problem
    count = 0

    def interrupted(u):
        nonlocal count
        count += 1
        if count == 6:
            raise KeyboardInterrupt
        return objective(u)

    result = jc.optimize(interrupted, start, method=method, **space)
    assert result.status is jc.Ending.INTERRUPTED
    assert result.value == result.history.value.min() < result.history.value[0]
    assert result.value == pytest.approx(float(objective(result.control)), rel=1e-13)


@each_method(DESCENT)
def test_optimize_rejects_steps_to_where_the_objective_is_nan(problem, method):
    objective, start, space, minimiser = problem
    wall = 0.6 * l2_distance(minimiser, start, **space)

    def walled(u):
        return objective(u) * jnp.where(l2_norm(u, space) > wall, jnp.nan, 1.0)

    # A first trial step that is much too long lands in the forbidden region.
    start = start + 0.1 * minimiser
    result = jc.optimize(Partial(walled), start, method=method, iterations=8, **space)
    assert math.isfinite(result.value)
    assert result.value < float(objective(start))
    assert np.all(np.isfinite(result.history.value))


def l2_norm(u, space):
    return jnp.sqrt(jc.control_dot(space["system"], space["dt"], u, u))


def test_optax_that_diverges_returns_the_start(problem):
    objective, start, space, minimiser = problem
    start = minimiser + 1e-3
    method = jc.Optax(optax.sgd(1e3))
    result = jc.optimize(objective, start, method=method, iterations=500, **space)
    assert result.status is jc.Ending.NOT_FINITE
    np.testing.assert_array_equal(result.control, start)
    assert result.history.value[-1] > result.value


def test_optimize_refuses_a_start_that_is_not_finite(problem):
    objective, start, space, _ = problem
    with pytest.raises(ValueError, match="not finite at the start"):
        jc.optimize(lambda u: objective(u) * jnp.nan, start, **space)


def test_optimize_says_what_defines_the_inner_product(problem):
    objective, start, _, _ = problem
    with pytest.raises(ValueError, match="system= and dt="):
        jc.optimize(objective, start)


@each_method()
def test_optimize_continues_a_saved_result_bit_for_bit(problem, method, tmp_path):
    objective, start, space, _ = problem
    whole = jc.optimize(objective, start, method=method, iterations=9, **space)
    first = jc.optimize(objective, start, method=method, iterations=4, **space)
    first.save(tmp_path / "result.npz")
    loaded = jc.load_result(tmp_path / "result.npz")
    assert loaded.status is first.status is jc.Ending.STOPPED
    rest = jc.optimize(objective, loaded, method=method, iterations=5, **space)
    np.testing.assert_array_equal(rest.control, whole.control)
    for name in ("value", "gradient_norm", "evaluations", "hessian_products"):
        np.testing.assert_array_equal(getattr(rest.history, name), getattr(whole.history, name))


def test_optimize_refuses_to_continue_another_method(problem):
    objective, start, space, _ = problem
    result = jc.optimize(objective, start, method=jc.LBFGS(), iterations=2, **space)
    with pytest.raises(ValueError, match="cannot be continued by NewtonCG"):
        jc.optimize(objective, result, method=jc.NewtonCG(), **space)


@each_method()
def test_optimize_compiles_once_for_all_iterations_and_new_data(method):
    system = graded_bar(6)
    traces = []

    def distance(target, u):
        traces.append(0)
        return 1e-2 * jnp.sum((u - target) ** 2)

    start = jnp.full((3, 7, 1), 0.0)  # of weak type, which must not matter
    options = {"method": method, "system": system, "dt": 0.1, "iterations": 5}
    jc.optimize(Partial(distance, jnp.ones((3, 7, 1))), start, **options)
    n_traces = len(traces)
    assert n_traces <= 2  # value and gradient, Hessian product
    result = jc.optimize(Partial(distance, 2.0 * jnp.ones((3, 7, 1))), start, **options)
    assert len(traces) == n_traces
    assert float(jnp.mean(result.control)) > 0.2


def test_optimize_reports_every_iteration_to_the_callback(problem):
    objective, start, space, _ = problem
    seen = []
    result = jc.optimize(
        objective, start, iterations=3, callback=lambda *report: seen.append(report), **space
    )
    assert [report[0] for report in seen] == [0, 1, 2, 3]
    assert all(report[1].shape == start.shape for report in seen)
    np.testing.assert_array_equal([report[2] for report in seen], result.history.value)
    np.testing.assert_array_equal([report[3] for report in seen], result.history.gradient_norm)


def test_optimize_shows_progress(problem, capsys):
    objective, start, space, _ = problem
    jc.optimize(objective, start, iterations=3, progress=True, **space)
    shown = capsys.readouterr().err
    assert "3/3" in shown
    assert "gradient norm" in shown


def test_optimize_says_how_to_get_the_progress_bar(problem, monkeypatch):
    objective, start, space, _ = problem
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxcontact\[progress\]'"):
        jc.optimize(objective, start, progress=True, **space)
