"""Claims about the limits of the model: what a motion did is told, and nothing else."""

import dataclasses
from functools import partial

import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.accuracy.limits import limits

H, DT = 0.25, 0.02


def drop(obstacle, *, force=-1.0, steps=40):
    """Scene, stepper and motion of a clamped block that is pushed down"""
    scene = jc.Scene(
        mesh=jc.meshes.rectangle((1.0, 0.5), h=H),
        material=jc.KelvinVoigt(young=100.0, poisson=0.3),
        clamped=("top",),
        contact={"bottom": obstacle},
        body_force=[0.0, force],
    )
    stepper = jc.prepare(jc.discretize(scene), DT)
    return scene, stepper, jc.simulate(stepper, steps=steps)


FLOOR = jc.HalfSpace(point=np.array([0.0, -2e-4]), normal=np.array([0.0, 1.0]))


@pytest.fixture(scope="module")
def gentle():
    return drop(FLOOR)


def test_a_small_motion_with_a_long_wide_contact_is_within_the_limits(gentle):
    assert np.max(np.sum(gentle[2].active, axis=1)) >= 3
    assert limits(*gentle, H, 0.01) == ()


def test_large_strains_are_told_with_their_place(gentle):
    scene, stepper, motion = gentle
    enlarged = dataclasses.replace(motion, nodal=_scaled(motion, 1e4))
    (sentence,) = limits(scene, stepper, enlarged, H, 1.0)
    assert "strain or rotation reaches" in sentence


def _scaled(motion, factor):
    return motion.nodal.shown(factor * motion.displacement, factor * motion.velocity)


def test_a_narrow_and_a_short_contact_are_told(gentle):
    scene, stepper, motion = gentle
    active = np.zeros(motion.contact.active.shape, bool)
    active[5:8, 0, 2] = True
    short = dataclasses.replace(motion.contact, active=active)
    found = limits(scene, stepper, dataclasses.replace(motion, contact=short), H, 0.01)
    assert ["less than 2 cells" in x for x in found] == [True, False]
    assert "lasts 3 steps, fewer than 10" in found[1]


def test_a_curved_obstacle_is_told_where_the_body_slides_along_it():
    ball = jc.Ball(center=np.array([0.5, -1e-3]), radius=8e-4)
    scene, stepper, motion = drop(ball, force=-1.0, steps=2)
    curved = partial(limits, scene, stepper, motion, H)
    assert any("gap is linearised" in x for x in curved(1e-9))
    assert not any("gap is linearised" in x for x in curved(1.0))
