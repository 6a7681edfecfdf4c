"""`descend` under vmap takes the steps of `optimize`, start by start."""

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

METHODS = [
    jc.SteepestDescent(),
    jc.LBFGS(memory=4),
    jc.Optax(optax.sgd(0.1, momentum=0.9)),
]
each_method = pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
ITERATIONS = 8
#: Batched sums round in another order, and the iterations amplify that a little.
ROUNDING = 1e-9
#: Near a minimum, values that agree to 1e-9 hold the control to the root of that only.
CLOSE = 3e-5
EUCLIDEAN = {"inner_product": Weighted(jnp.ones(1))}


def descend_all(objective, starts, **options):
    @jax.jit
    def run(objective, starts):
        return jax.vmap(lambda u: jc.descend(objective, u, **options))(starts)

    return run(objective, starts)


def assert_equal_runs(many, objective, starts, **options):
    for k, start in enumerate(starts):
        single = jc.optimize(objective, start, **options)
        n = single.history.value.size
        size = single.history.gradient_norm[0]
        np.testing.assert_allclose(many.values[k, :n], single.history.value, rtol=ROUNDING)
        np.testing.assert_allclose(
            many.gradient_norms[k, :n], single.history.gradient_norm, atol=ROUNDING * size
        )
        np.testing.assert_allclose(many.value[k], single.value, rtol=ROUNDING)
        np.testing.assert_allclose(many.control[k], single.control, atol=CLOSE)
        assert int(many.iterations[k]) == n - 1


@each_method
@pytest.mark.parametrize("bounds", [None, (-1.5, 2.0)], ids=["free", "bounded"])
def test_descend_over_many_starts_equals_the_single_runs(method, bounds):
    objective, start, space, _ = quadratic()
    starts = start[None] + jnp.linspace(-1.0, 3.0, 3)[:, None, None, None]
    options = {"method": method, "bounds": bounds, "iterations": ITERATIONS, **space}
    many = descend_all(objective, starts, **options)
    assert_equal_runs(many, objective, starts, **options)


@each_method
def test_descend_through_contact_equals_the_single_runs(method):
    problem = grazing()
    starts = jnp.stack([START, 0.5 * START, 2.0 * START])
    options = {"method": method, "iterations": 6, **problem.options}
    many = descend_all(Partial(type(problem).objective, problem), starts, **options)
    assert float(jnp.max(jax.vmap(problem.simulate)(many.control).contact_impulse)) > 0.0
    assert_equal_runs(many, problem.objective, starts, **options)


def kinked(x):
    return jnp.maximum(jnp.abs(x[0]), 10.0 * jnp.abs(x[1])) + 0.5 * jnp.sum((x[2:] - 1.0) ** 2)


def test_descend_by_lbfgs_converges_to_a_kinked_minimiser():
    # The searches bisect, fail, and forget: every branch of the traced search is taken.
    starts = jnp.array([[2.0, 0.3, 0.0, 0.0], [-1.0, 1.0, 3.0, 0.5]])
    many = descend_all(Partial(kinked), starts, iterations=300, **EUCLIDEAN)
    assert float(jnp.max(many.value)) < 1e-8
    np.testing.assert_array_equal(many.value, jnp.min(many.values, axis=1))


def test_descend_stays_where_a_method_finds_no_better_point():
    starts = jnp.array([[2.0, 0.3, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    method = jc.SteepestDescent()
    many = descend_all(Partial(kinked), starts, method=method, iterations=300, **EUCLIDEAN)
    assert float(many.value[0]) > 1e-2
    assert int(many.iterations[0]) < 300
    np.testing.assert_array_equal(many.values[0, many.iterations[0] :], many.value[0])
    assert int(many.iterations[1]) == 0
    np.testing.assert_array_equal(many.control[1], starts[1])


def test_descend_maps_over_the_data_of_the_problem():
    targets = jnp.array([0.02, 0.05, 0.15])

    def best(target):
        problem = grazing(target)
        return jc.descend(problem.objective, START, iterations=8, **problem.options).value

    singles = [
        jc.optimize(grazing(target).objective, START, iterations=8, **grazing().options).value
        for target in targets
    ]
    np.testing.assert_allclose(jax.vmap(best)(targets), singles, rtol=ROUNDING)


@each_method
def test_descend_from_a_start_that_is_not_finite_spoils_no_other(method):
    starts = jnp.array([[jnp.nan, 0.3, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]])
    many = descend_all(Partial(kinked), starts, method=method, iterations=5, **EUCLIDEAN)
    assert np.isinf(many.value[0])
    alone = descend_all(Partial(kinked), starts[1:], method=method, iterations=5, **EUCLIDEAN)
    np.testing.assert_allclose(many.values[1], alone.values[0], rtol=ROUNDING)
    assert float(many.value[1]) < float(many.values[1, 0])


def test_descend_in_float32_keeps_its_type():
    starts = jnp.array([[2.0, 0.0, 0.0, 0.0]], jnp.float32)
    product = {"inner_product": Weighted(jnp.ones(1, jnp.float32))}
    for method in METHODS:
        many = descend_all(Partial(kinked), starts, method=method, iterations=5, **product)
        assert many.control.dtype == many.values.dtype == jnp.float32
        assert float(many.value[0]) < float(many.values[0, 0])


@pytest.mark.parametrize("method", [jc.NewtonCG(), jc.Homotopy()])
def test_descend_refuses_a_method_that_decides_on_the_host(method):
    with pytest.raises(ValueError, match="decides on the host"):
        jc.descend(kinked, jnp.zeros(4), method=method, **EUCLIDEAN)
