"""Claims about pairs that are taken to stay open: only the work changes, or it is refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=15 / 10, gap=0.4, steps=100)


@pytest.fixture(scope="module")
def control(problem):
    return problem.control_scale * problem.reference


@pytest.fixture(scope="module")
def motion(problem, control):
    return jc.simulate(problem.stepper, control)


def touching(motion):
    return np.array(jnp.any(motion.active, axis=0))


def test_pairs_that_stay_open_change_nothing(problem, control, motion):
    mask = touching(motion)
    assert 0 < mask.sum() < mask.size
    system = problem.system.with_pairs(mask)
    assert system.normals.count == mask.sum()
    found = jc.simulate(jc.prepare(system, problem.dt), control)
    size = np.max(np.abs(motion.displacement))
    np.testing.assert_allclose(found.displacement, motion.displacement, atol=1e-10 * size)
    np.testing.assert_allclose(
        found.contact_impulse,
        motion.contact_impulse[:, mask],
        atol=1e-8 * np.max(motion.contact_impulse),
    )


@pytest.mark.parametrize("reduce", [lambda x: x, partial(jc.reduce, modes=20)])
def test_a_pair_that_would_close_is_not_passed_over(problem, control, motion, reduce):
    mask = touching(motion)
    mask[np.argmax(mask)] = False
    stepper = jc.prepare(reduce(problem.system.with_pairs(mask)), problem.dt)
    with pytest.raises(jc.SolveError, match="taken to stay open would penetrate"):
        jc.simulate(stepper, control)
    found = jax.jit(jc.simulate)(stepper, control)
    first = np.argmax(np.asarray(found.status) == jc.Status.PENETRATES)
    assert first > 0
    assert np.all(np.isfinite(found.displacement[: first + 1]))
    assert np.all(np.any(np.isnan(found.displacement[first + 1 :]), axis=(1, 2)))
    recorded = jax.jit(partial(jc.simulate, save_every=50))(stepper, control)
    np.testing.assert_array_equal(recorded.status, found.status)


def test_pairs_are_chosen_twice(problem):
    once = problem.system.with_pairs([2, 4, 6])
    twice = once.with_pairs([True, False, True])
    assert once.open_pairs.normals.count == problem.system.normals.count - 3
    assert twice.open_pairs.normals.count == problem.system.normals.count - 2
    np.testing.assert_array_equal(twice.contact_nodes, problem.system.contact_nodes[[2, 6]])


def test_all_pairs_are_the_system_itself(problem):
    system = problem.system.with_pairs(problem.system.gap < np.inf)
    assert jax.tree.structure(system) == jax.tree.structure(problem.system)


def test_static_contact_refuses_a_pair_that_would_close(problem):
    pressed = problem.system.with_gap(problem.system.gap - 0.5)
    assert np.any(jc.solve_static(pressed).active)
    with pytest.raises(jc.SolveError, match="taken to stay open would penetrate"):
        jc.solve_static(pressed.with_pairs([0]))


@pytest.mark.parametrize("pairs", [[0.5], [-1], np.ones(3, bool), [10_000]])
def test_with_pairs_refuses_what_are_no_pairs(problem, pairs):
    with pytest.raises(ValueError, match="pairs must be a mask"):
        problem.system.with_pairs(pairs)
