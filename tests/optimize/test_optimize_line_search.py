"""The weak Wolfe search, and L-BFGS with it where the objective has kinks."""

import math

import jax.numpy as jnp
import pytest
from jax.tree_util import Partial

import jaxcontact as jc
from jaxcontact.control.inner_product import Weighted
from jaxcontact.optimize.line_search import Trial

EUCLIDEAN = Weighted(jnp.ones(1))


def line(value, slope):
    return lambda t: Trial(value(t), slope(t), t)


def search(along, value, slope, step=1.0, wolfe=jc.WeakWolfe()):  # noqa: B008
    trial, is_found = wolfe.search(along, Trial(value, slope, 0.0), step)
    return trial if is_found else None


@pytest.mark.parametrize("step", [1e-3, 1.0, 1e3])
def test_weak_wolfe_crosses_the_kink_of_the_modulus(step):
    along = line(lambda t: abs(t - 1.0), lambda t: math.copysign(1.0, t - 1.0))
    trial = search(along, 1.0, -1.0, step)
    # The only points that satisfy both conditions lie behind the kink.
    assert 1.0 <= trial.point < 2.0
    assert trial.value < 1.0


@pytest.mark.parametrize("step", [1e-4, 1.0, 1e4])
def test_weak_wolfe_conditions_hold_for_a_maximum_of_parabolas(step):
    pieces = [
        (lambda t: (t - 2.0) ** 2, lambda t: 2.0 * (t - 2.0)),
        (lambda t: 5.0 * t - 1.0, lambda t: 5.0),
        (lambda t: 1.0 - t, lambda t: -1.0),
    ]

    def active(t):
        return max(pieces, key=lambda piece: piece[0](t))

    along = line(lambda t: active(t)[0](t), lambda t: active(t)[1](t))
    trial = search(along, 4.0, -4.0, step, jc.WeakWolfe(decrease=0.1, curvature=0.3))
    assert trial.value <= 4.0 - 0.1 * trial.point * 4.0
    assert trial.slope >= -0.3 * 4.0


def test_weak_wolfe_backs_off_from_values_that_are_not_finite():
    along = line(lambda t: (t - 1.0) ** 2 if t < 1.3 else math.inf, lambda t: 2.0 * (t - 1.0))
    assert 0.4 < search(along, 1.0, -2.0, 1000.0).point < 1.3


def test_weak_wolfe_finds_nothing_where_nothing_decreases():
    assert search(line(lambda t: 1.0 + t, lambda t: 1.0), 1.0, -1.0) is None


@pytest.mark.parametrize("slope", [0.0, 1.0, math.nan])
def test_weak_wolfe_evaluates_nothing_along_no_descent(slope):
    assert search(None, 1.0, slope) is None


def test_weak_wolfe_returns_a_decrease_where_the_value_falls_forever():
    along = line(lambda t: -t, lambda t: -1.0)
    trial = search(along, 0.0, -1.0, wolfe=jc.WeakWolfe(max_trials=5))
    assert trial.point == 16.0
    assert trial.value == -16.0


def kinked(x):
    """Convex, with the minimum 0 at a kink in all directions of x_0 and x_1."""
    return jnp.maximum(jnp.abs(x[0]), 10.0 * jnp.abs(x[1])) + 0.5 * jnp.sum((x[2:] - 1.0) ** 2)


def test_lbfgs_converges_to_a_kinked_minimiser_where_steepest_descent_stalls():
    start = jnp.array([2.0, 0.3, 0.0, 0.0])
    options = {"inner_product": EUCLIDEAN, "iterations": 300}
    assert jc.optimize(Partial(kinked), start, method=jc.LBFGS(), **options).value < 1e-8
    stalled = jc.optimize(Partial(kinked), start, method=jc.SteepestDescent(), **options)
    assert stalled.value > 1e-2
    assert stalled.status is jc.Ending.NO_DESCENT


def test_lbfgs_solves_the_nonsmooth_rosenbrock_function():
    # 8 |x^2 - y| + (1 - x)^2 of Lewis and Overton: the valley is a kink.
    def banana(x):
        return 8.0 * jnp.abs(x[0] ** 2 - x[1]) + (1.0 - x[0]) ** 2

    start = jnp.array([-1.0, 2.0])
    result = jc.optimize(Partial(banana), start, inner_product=EUCLIDEAN, iterations=400)
    assert result.value < 1e-6


def _ellipsoid(curvatures, x):
    return 0.5 * jnp.sum(curvatures * (x - 1.0) ** 2)


def test_lbfgs_needs_no_more_evaluations_for_a_scaled_objective():
    counts = []
    for scale in (1.0, 1e6):
        objective = Partial(_ellipsoid, scale * jnp.linspace(1.0, 30.0, 40))
        options = {"method": jc.LBFGS(memory=4), "inner_product": EUCLIDEAN, "tolerance": 1e-6}
        result = jc.optimize(objective, jnp.zeros(40), **options)
        assert result.status is jc.Ending.CONVERGED
        counts.append(int(result.history.evaluations[-1]))
    # The first search alone pays for the scale, by log2(1e6) = 20 bisections.
    assert counts[1] <= counts[0] + 25
