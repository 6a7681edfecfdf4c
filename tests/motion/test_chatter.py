"""Chatter of the contact force is said where a user reads it, and only where it is."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, DT, ELASTIC, block, block_scene, discretized

import jaxcontact as jc
from jaxcontact.motion.chatter import chatter


@pytest.fixture(scope="module")
def chattering():
    stepper = block(ELASTIC)
    return stepper, jc.simulate(stepper, steps=30)


@pytest.fixture(scope="module")
def quiet():
    stepper = jc.prepare(discretized(block_scene(ELASTIC)), DT, scheme=jc.ContactStabilized())
    return stepper, jc.simulate(stepper, steps=30)


READERS = [
    jc.contact_pressure,
    lambda _, motion: jc.contact_force(motion),
    lambda _, motion: jc.plot.plot_force(motion),
    jc.plot.plot_pressure,
    lambda stepper, motion: jc.plot.plot_active_set(stepper.system, motion),
    lambda stepper, motion: jc.plot.plot_contact_force(stepper.system, motion, 12),
]


@pytest.mark.parametrize("read", READERS)
def test_reader_of_a_chattering_force_is_warned_and_told_the_scheme(chattering, read):
    assert chatter(chattering[1]) > 0.2
    with pytest.warns(jc.ChatterWarning, match=r"scheme=jc\.ContactStabilized\(\)"):
        read(*chattering)


def test_warning_points_at_the_line_of_the_reader(chattering):
    with pytest.warns(jc.ChatterWarning) as caught:
        jc.contact_pressure(*chattering)
    assert caught[0].filename == __file__


def test_smooth_force_is_no_chatter(quiet):
    assert np.any(quiet[1].active)
    assert chatter(quiet[1]) == 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jc.contact_pressure(*quiet)


@pytest.mark.parametrize(
    ("force", "size"),
    [
        ([0, 1, 0, 1, 0, 1, 0, 0], 1.0),
        ([0, 1, 0.5, 1, 0.5, 1, 0.5, 0], 0.5),
        ([0, 1, 2, 3, 2, 1, 0, 0], 0.0),
        ([0, 1, 0.95, 1, 0.95, 1, 0.95, 0], 0.0),
        ([0, 1, 0, 0, 1, 0, 0, 1], 0.0),
        ([0, 0, 0, 0, 0, 0, 0, 0], 0.0),
        ([1, 0], 0.0),
    ],
)
def test_chatter_is_the_size_of_five_alternating_changes(chattering, force, size):
    impulse = np.asarray(force, float)[:, None] * np.array([[1.0, 0.0]])
    motion = type("Motion", (), {"contact_impulse": impulse})()
    assert chatter(motion) == pytest.approx(size)


def test_report_of_a_chattering_motion_names_the_scheme(chattering):
    report = jc.derivative_report(
        chattering[0], None, lambda motion: jnp.sum(motion.contact_impulse), steps=30
    )
    assert report.chatter == pytest.approx(chatter(chattering[1]))
    assert "jc.ContactStabilized()" in str(report)


def test_traced_force_is_not_looked_at(chattering):
    stepper, motion = chattering
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(jc.contact_force)(motion)
    assert BLOCK.n_nodes == stepper.system.n_nodes
