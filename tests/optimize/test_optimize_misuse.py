"""What a user gets wrong, or a run meets: an error that says so, or a status in words."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.tree_util import Partial
from support.kinked import START, grazing
from support.optimize_problems import quadratic

import jaxcontact as jc
from jaxcontact.control.inner_product import Weighted

METHODS = [jc.SteepestDescent(), jc.LBFGS(memory=4), jc.NewtonCG(), jc.Optax(optax.sgd(0.1))]
each_method = pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)


@pytest.fixture(scope="module")
def problem():
    objective, start, space, _ = quadratic()
    return objective, start, space


@pytest.mark.parametrize("method", [jc.LBFGS, jc.Homotopy, "lbfgs", optax.adam(0.1)], ids=range(4))
def test_optimize_refuses_what_is_no_method(problem, method):
    objective, start, space = problem
    with pytest.raises(ValueError, match=r"an object, such as jc\.(LBFGS|Homotopy)\(\)"):
        jc.optimize(objective, start, method=method, **space)


@each_method
def test_optimize_of_an_objective_without_the_control_says_that_the_gradient_is_zero(
    problem, method
):
    _, start, space = problem
    result = jc.optimize(lambda u: jnp.asarray(3.0), start, method=method, **space)
    assert result.status is jc.Ending.CONVERGED
    assert result.value == 3.0
    np.testing.assert_array_equal(result.control, start)


def _uphill(objective, u):
    """The objective with the opposite of its gradient"""
    value = objective(u)
    return 2.0 * jax.lax.stop_gradient(value) - value


@pytest.mark.parametrize("method", METHODS[:3], ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("bounds", [None, (-3.0, 3.0)], ids=["free", "bounded"])
def test_optimize_along_a_wrong_gradient_returns_the_start_and_says_why(problem, method, bounds):
    objective, start, space = problem
    wrong = Partial(_uphill, objective)
    result = jc.optimize(wrong, start, method=method, bounds=bounds, **space)
    assert result.status is jc.Ending.NO_DESCENT
    np.testing.assert_array_equal(result.control, start)
    assert result.value == pytest.approx(float(objective(start)), rel=1e-13)


@each_method
def test_optimize_starts_within_the_bounds(problem, method):
    objective, start, space = problem
    far = start + 7.0
    result = jc.optimize(objective, far, method=method, bounds=(-1.0, 2.0), iterations=0, **space)
    np.testing.assert_array_equal(result.control, start + 2.0)
    assert result.value == pytest.approx(float(objective(start + 2.0)), rel=1e-13)
    assert result.status is jc.Ending.STOPPED


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": (1.0, -1.0)}, "1 lower bounds are above"),
        ({"bounds": (np.nan, 1.0)}, "above their upper bounds or NaN"),
        ({"bounds": (jnp.zeros(3), 1.0)}, r"a bound of shape \(3,\) does not fit"),
        ({"bounds": (0.0, 1.0, 2.0)}, "a pair"),
        ({"bounds": "positive"}, "a pair"),
        ({"iterations": -1}, "not be negative"),
        ({"inner_product": Weighted}, "inner_product must be an object, such as Weighted"),
        ({"inner_product": 2.0}, r"inner_product must be .* got 2\.0"),
        ({"controls": lambda p: p}, r"controls must be an object, such as jc\.actuator"),
    ],
)
def test_optimize_refuses_options_that_do_not_fit(problem, options, message):
    objective, start, space = problem
    with pytest.raises(ValueError, match=message):
        jc.optimize(objective, start, **space, **options)


def test_every_entry_refuses_what_is_no_problem(problem):
    objective, start, space = problem
    for enter in (jc.optimize, jc.descend, jc.stationarity):
        with pytest.raises(ValueError, match="must be a function of a control, got float"):
            enter(3.0, start, **space)
        with pytest.raises(ValueError, match="floating point numbers, got int"):
            enter(objective, np.zeros(start.shape, int), **space)
        with pytest.raises(ValueError, match="system= and dt="):
            enter(objective, start)
        with pytest.raises(ValueError, match="above their upper bounds"):
            enter(objective, start, bounds=(1.0, -1.0), **space)


@pytest.mark.parametrize("shape", [(3, 2), (3, 4, 1), (3, 2, 2)], ids=str)
def test_optimize_refuses_a_control_of_another_shape(shape):
    problem = grazing()
    with pytest.raises(ValueError, match="control"):
        jc.optimize(problem.objective, jnp.zeros(shape), **problem.options)


@pytest.mark.parametrize("method", [*METHODS, jc.Homotopy(levels=3)], ids=lambda m: str(type(m)))
def test_optimize_over_a_single_step_descends(method):
    problem = grazing()
    start = jnp.full((1, 2, 1), 10.0)
    result = jc.optimize(problem.objective, start, method=method, iterations=3, **problem.options)
    assert result.control.shape == (1, 2, 1)
    assert result.value < result.history.value[0]


@pytest.mark.parametrize("method", [*METHODS, jc.Homotopy(levels=3)], ids=lambda m: str(type(m)))
def test_optimize_in_float32_keeps_its_type_and_descends(method):
    problem = grazing(dtype=jnp.float32)
    start = START.astype(jnp.float32)
    result = jc.optimize(problem.objective, start, method=method, iterations=3, **problem.options)
    assert result.control.dtype == jnp.float32
    assert result.value < result.history.value[0]


def test_optimize_interrupted_in_the_callback_returns_the_best_so_far(problem):
    objective, start, space = problem

    def callback(iteration, control, value, norm):
        if iteration == 3:
            raise KeyboardInterrupt

    result = jc.optimize(objective, start, callback=callback, **space)
    assert result.status is jc.Ending.INTERRUPTED
    assert len(result.history.value) == 4
    assert result.value == result.history.value[3] == result.history.value.min()
    rest = jc.optimize(objective, result, iterations=2, **space)
    whole = jc.optimize(objective, start, iterations=5, **space)
    np.testing.assert_array_equal(rest.control, whole.control)


def _scaled(objective, factor, u):
    return factor * objective(u)


def test_optimize_refuses_the_saved_result_of_another_problem(problem, tmp_path):
    objective, start, space = problem
    path = tmp_path / "result.npz"
    jc.optimize(objective, start, iterations=2, **space).save(path)
    with pytest.raises(ValueError, match="belongs to another problem"):
        jc.optimize(Partial(_scaled, objective, 1.01), jc.load_result(path), **space)
    other, _, other_space, _ = quadratic(n_cells=9)
    with pytest.raises((ValueError, TypeError), match="shape"):
        jc.optimize(other, jc.load_result(path), **other_space)


def test_load_result_refuses_another_file(tmp_path):
    np.savez(tmp_path / "other.npz", control=np.zeros(3))
    with pytest.raises(ValueError, match="no saved result"):
        jc.load_result(tmp_path / "other.npz")
