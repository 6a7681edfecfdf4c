"""The optimal control problem of the paper."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc


@pytest.fixture(scope="module")
def half_disc():
    return jc.scenes.half_disc_control()


@pytest.fixture(scope="module")
def paper(half_disc):
    """Steepest descent with 1000 iterations; it stalls at a kink before."""
    start = jnp.zeros_like(half_disc.reference)
    space = {"system": half_disc.system, "dt": half_disc.dt}
    method = jc.SteepestDescent()
    return (
        start,
        space,
        jc.optimize(half_disc.objective, start, method=method, iterations=1000, **space),
    )


@pytest.mark.slow
def test_steepest_descent_reduces_the_paper_problem_by_a_factor_30(paper):
    history = paper[2].history
    assert history.value[0] == pytest.approx(0.38715, rel=1e-4)
    assert history.value[200] < history.value[0] / 30.0
    assert np.all(np.diff(history.value) < 0.0)


@pytest.mark.slow
def test_optimal_control_vanishes_where_the_body_is_clamped(half_disc, paper):
    is_clamped = np.ones(half_disc.system.n_nodes, bool)
    is_clamped[half_disc.system.free_nodes] = False
    largest = float(jnp.max(jnp.abs(paper[2].control)))
    assert float(jnp.max(jnp.abs(paper[2].control[:, is_clamped]))) < 0.05 * largest


@pytest.mark.slow
def test_lbfgs_passes_steepest_descent_within_60_evaluations(half_disc, paper):
    start, space, slow = paper
    result = jc.optimize(half_disc.objective, start, method=jc.LBFGS(), iterations=55, **space)
    below = result.history.value < slow.value
    assert below.any()
    assert result.history.evaluations[np.argmax(below)] <= 60


@pytest.mark.slow
def test_newton_cg_passes_steepest_descent_within_25_gradients(half_disc, paper):
    start, space, slow = paper
    result = jc.optimize(half_disc.objective, start, method=jc.NewtonCG(), iterations=25, **space)
    below = result.history.value < slow.value
    assert below.any()
    first = np.argmax(below)
    assert result.history.evaluations[first] <= 25
    assert result.history.hessian_products[first] <= 100
