"""The examples of the docstrings run and print what they say."""

import doctest
import inspect

import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact import api

NAMES = {"jc": jc, "jnp": jnp, "np": np}
FINDER = doctest.DocTestFinder(exclude_empty=True)
PUBLIC = [getattr(api, name) for name in api.__all__]
TESTS = {
    test.name: test
    for thing in PUBLIC
    if inspect.isclass(thing) or inspect.isfunction(thing) or hasattr(thing, "__wrapped__")
    for test in FINDER.find(thing, thing.__name__, module=False, globs=NAMES)
    if test.examples
}


def test_examples_are_found_also_behind_decorators():
    assert {"discretize", "stress", "KelvinVoigt", "State.of"} <= set(TESTS)


@pytest.mark.parametrize("name", TESTS)
def test_example_of_a_docstring_prints_what_it_says(name):
    said = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    runner.run(TESTS[name], out=said.append)
    assert not runner.failures, "".join(said)
