"""The same lines on the host and under a trace."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcontact.transforms.loops import cond, select, while_loop


def halvings(x, seen):
    """Return how often x can be halved before it is at most one."""

    def halve(carry):
        x, count = carry
        seen.append(x)
        return x / 2, count + 1

    return while_loop(lambda carry: carry[0] > 1.0, halve, (x, jnp.int32(0)))[1]


def test_while_loop_on_concrete_values_runs_the_body_once_per_pass():
    seen = []
    assert int(halvings(jnp.asarray(40.0), seen)) == 6
    np.testing.assert_array_equal(seen, [40.0, 20.0, 10.0, 5.0, 2.5, 1.25])


def test_while_loop_that_has_nothing_to_do_returns_the_carry():
    seen = []
    assert int(halvings(jnp.asarray(0.5), seen)) == 0
    assert not seen


def test_while_loop_under_vmap_equals_the_loops_one_by_one():
    x = jnp.array([0.5, 3.0, 40.0])
    seen = []
    counts = jax.jit(jax.vmap(lambda x: halvings(x, seen)))(x)
    np.testing.assert_array_equal(counts, [halvings(x, []) for x in x])
    assert len(seen) < 6  # traced, not run


def test_while_loop_on_the_host_lets_an_interrupt_through():
    def interrupt(carry):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        while_loop(lambda x: x > 0, interrupt, jnp.int32(1))


def fail(x):
    raise AssertionError("this branch is not taken")


@pytest.mark.parametrize("branches", [(jnp.negative, fail), (fail, jnp.negative)])
def test_cond_on_a_concrete_value_runs_one_branch_only(branches):
    is_first = jnp.bool_(branches[1] is fail)
    assert int(cond(is_first, *branches, jnp.int32(3))) == -3


def test_cond_under_jit_chooses_by_the_value():
    absolute = jax.jit(lambda x: cond(x < 0, jnp.negative, jnp.positive, x))
    np.testing.assert_array_equal([absolute(-2.0), absolute(3.0)], [2.0, 3.0])


def test_select_on_a_concrete_value_copies_nothing():
    first, second = {"a": jnp.ones(2)}, {"a": jnp.zeros(2)}
    assert select(jnp.bool_(True), first, second) is first
    assert select(jnp.bool_(False), first, second) is second


def test_select_under_vmap_chooses_leaf_by_leaf():
    choose = jax.vmap(lambda is_first: select(is_first, (1.0, 2.0), (3.0, 4.0)))
    first, second = choose(jnp.array([True, False]))
    np.testing.assert_array_equal(jnp.stack([first, second]), [[1.0, 3.0], [2.0, 4.0]])
