"""The predictor of `ContactStabilized` has a contact problem of its own, with kinks of its own."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

DT = 0.05
STEPS = 4
MESH = jc.meshes.interval(1.0, h=0.25)
#: The inner nodes are pulled away from the wall, so that the step itself does not touch it when
#: the free flight of its predictor does.
PULL = jnp.asarray([0.0, 0.004, 0.006, 0.004, 0.0])[:, None]
SPEED = 0.4


def stepper():
    scene = jc.Scene(
        MESH,
        jc.KelvinVoigt(young=1.0, poisson=0.0),
        contact={"left": jc.HalfSpace(np.array([-DT * SPEED]), np.array([1.0]))},
    )
    return jc.prepare(jc.discretize(scene), DT, scheme=jc.ContactStabilized())


def start(speed):
    return jc.State(PULL, jnp.full((5, 1), -speed))


def height(trajectory):
    return 100.0 * jnp.sum(trajectory.final.displacement**2)


@jax.jit
def height_of(stepper, speed):
    return height(jc.simulate(stepper, steps=STEPS, initial=start(speed)))


def test_report_sees_the_weak_contact_of_the_predictor():
    body = stepper()
    trajectory = jc.simulate(body, steps=STEPS, initial=start(SPEED))
    # Free flight ends on the wall: gap and impulse of the predictor are zero, the step stays away.
    np.testing.assert_array_equal(np.asarray(trajectory.contact.weak)[0], [[False], [True]])
    assert float(trajectory.contact.gap[0, 0, 0]) > 1e-5
    report = jc.derivative_report(body, None, height, steps=STEPS, initial=start(SPEED))
    assert report.margin == 0.0
    assert not report.is_differentiable
    np.testing.assert_array_equal(report.weak[0], [0, 0])
    assert report.problem[0] == 1
    assert "of the predictor" in str(report)
    right, left = (
        s * (height_of(body, SPEED + s * 1e-6) - height_of(body, SPEED)) / 1e-6 for s in (1.0, -1.0)
    )
    assert abs(right - left) > 1e-3 * abs(right)
    # The multipliers tell the two sides apart: one of them is not zero.
    assert max(abs(report.cone[0]), abs(report.polar[0])) > 1e-6


def test_report_measures_the_margin_of_the_predictor():
    body = stepper()
    near = start(SPEED * (1.0 - 1e-6))
    report = jc.derivative_report(body, None, height, steps=STEPS, initial=near, tolerance=1e-4)
    assert report.is_differentiable
    assert 0.0 < report.margin < 1e-5
    assert [0, 0] in report.nearly_weak.tolist()


def test_check_gradient_counts_the_contacts_of_the_predictor():
    body = stepper()

    def trajectory(speed):
        return jc.simulate(body, steps=STEPS, initial=start(speed))

    check = jc.check_gradient(
        lambda speed: height_of(body, speed), jnp.asarray(SPEED), trajectory=trajectory
    )
    assert check.weak_contacts >= 1
    assert check.contact_changes >= 1
    assert check.verdict in (jc.Verdict.KINK_OF_CONTACT, jc.Verdict.ONE_SIDED)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_directions_choose_the_side_of_the_predictor(sign):
    body = stepper()
    direction = jc.State(jnp.zeros((5, 1)), jnp.full((5, 1), -sign))

    def of(initial):
        along = jc.AlongDirection(initial=direction)
        return height(jc.simulate(body, steps=STEPS, initial=initial, weak_contact=along))

    gradient = jax.grad(of)(start(SPEED))
    slope = jnp.vdot(gradient.velocity, direction.velocity)
    tangent = jc.directional_derivative(
        body, None, steps=STEPS, initial=start(SPEED), initial_direction=direction
    )
    final = jc.simulate(body, steps=STEPS, initial=start(SPEED)).final.displacement
    exact = 200.0 * jnp.vdot(final, tangent.displacement[-1])
    step = 1e-7
    moved = dataclasses.replace(
        start(SPEED), velocity=start(SPEED).velocity + step * direction.velocity
    )
    there = height(jc.simulate(body, steps=STEPS, initial=moved))
    difference = (there - height_of(body, SPEED)) / step
    np.testing.assert_allclose(slope, exact, rtol=1e-10)
    np.testing.assert_allclose(exact, difference, rtol=1e-4)
