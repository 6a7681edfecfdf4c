"""Claims about recording and checkpointing: they change memory, not results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

STEPS = 60


#: Two loops of the same operations may round them differently; impacts amplify that a little.
ROUNDING = 1e-12


def assert_same(actual, expected):
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=ROUNDING * size)


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=15 / 4, gap=0.1, steps=STEPS)


@pytest.mark.parametrize("save_every", [1, 5, STEPS])
@pytest.mark.parametrize("checkpoint", [None, jc.Checkpoint(), jc.Checkpoint(7)])
def test_simulate_records_the_same_states(problem, save_every, checkpoint):
    every = problem.simulate(problem.reference)
    force = problem.control_scale * problem.reference
    some = jc.simulate(problem.stepper, force, save_every=save_every, checkpoint=checkpoint)
    assert np.any(np.asarray(every.active))
    for name in ("time", "displacement", "velocity", "gap"):
        expected = getattr(every, name)[::save_every]
        assert_same(getattr(some, name), expected)
    assert_same(some.contact_impulse, every.contact_impulse)
    for name in ("active", "status"):
        np.testing.assert_array_equal(getattr(some, name), getattr(every, name))


def final_misfit(problem, checkpoint):
    def misfit(u):
        force = problem.control_scale * u
        trajectory = jc.simulate(problem.stepper, force, save_every=2, checkpoint=checkpoint)
        return jnp.sum(trajectory.displacement[-1] ** 2)

    return misfit


@pytest.mark.parametrize("segments", [None, 1, 7, STEPS])
def test_checkpoint_keeps_the_gradient(problem, segments):
    u = problem.reference
    expected = jax.grad(final_misfit(problem, None))(u)
    gradient = jax.grad(final_misfit(problem, jc.Checkpoint(segments)))(u)
    scale = np.max(np.abs(expected))
    assert scale > 0.0
    np.testing.assert_allclose(gradient, expected, atol=1e-14 * scale)


@pytest.mark.parametrize("save_every", [0, 7])
def test_simulate_refuses_a_save_every_that_does_not_divide(problem, save_every):
    with pytest.raises(ValueError, match="divisor"):
        jc.simulate(problem.stepper, problem.reference, save_every=save_every)


@pytest.mark.parametrize("segments", [0, -3])
def test_checkpoint_refuses_a_number_of_segments_that_is_not_positive(segments):
    with pytest.raises(ValueError, match=f"must be 1 or more, got {segments}; leave it out"):
        jc.Checkpoint(segments)
