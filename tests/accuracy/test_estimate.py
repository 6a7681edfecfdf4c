"""Claims about the error of a quantity: its parts, on a bar whose motion is known exactly."""

import jax.numpy as jnp
import numpy as np
import pytest
from support.falling_bar import BAR, build, exact_mean, mean_height

import jaxcontact as jc


@pytest.fixture(scope="module")
def found():
    return jc.estimate_error(build, mean_height, h=BAR.length / 10, dt=0.02, modes=4)


def test_estimate_separates_the_parts(found):
    assert min(found.space, found.time, found.reduction) > 0.0
    assert found.precision == 0.0
    np.testing.assert_allclose(found.total, found.space + found.time + found.reduction)
    assert getattr(found, found.dominant) == max(found.space, found.time, found.reduction)


def test_estimate_is_the_error_within_its_factor(found):
    error = abs(found.value - exact_mean())
    assert 0.3 < found.total / error < 3.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"h": -1.0}, "h must be a positive number"),
        ({"dt": 0.0}, "dt must be a positive number"),
        ({"scheme": jc.ContactImplicit}, "scheme"),
        ({"quantity": lambda stepper: jnp.zeros(3)}, "must be a number"),
        ({"build": lambda h: 3}, "must return a Scene"),
    ],
)
def test_estimate_says_what_is_wrong(options, message):
    given = {"build": build, "quantity": mean_height, "h": 5.0, "dt": 0.5} | options
    with pytest.raises(ValueError, match=message):
        jc.estimate_error(given.pop("build"), given.pop("quantity"), **given)
