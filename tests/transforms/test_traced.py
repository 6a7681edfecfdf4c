"""Poison: a false condition is seen in values and derivatives, a true one is not there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcontact.transforms.traced import poison_unless


def test_poison_spares_values_of_a_true_condition_and_integers():
    values = {"x": jnp.array([0.1, -3.0], jnp.float32), "node": np.array([1, 2])}
    for is_good in (True, False):
        found = poison_unless(is_good, values)
        assert found["x"].dtype == jnp.float32
        np.testing.assert_array_equal(found["node"], values["node"])
    np.testing.assert_array_equal(poison_unless(True, values)["x"], values["x"])
    assert np.all(np.isnan(poison_unless(False, values)["x"]))


@pytest.mark.parametrize(("x", "slope"), [(2.0, 12.0), (-2.0, np.nan)])
def test_poison_is_seen_in_the_derivative(x, slope):
    found = jax.jit(jax.grad(lambda x: poison_unless(x > 0.0, x**3)))(x)
    np.testing.assert_equal(float(found), slope)


def test_poison_does_not_vanish_with_a_zero_cotangent():
    assert np.isnan(jax.grad(lambda x: 0.0 * poison_unless(x > 0.0, x))(-1.0))
