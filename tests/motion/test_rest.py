"""Claims about a body that rests on a plane at any angle: all is rounding, and known as such."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, DT, ELASTIC, SCHEMES

import jaxcontact as jc

ANGLES = [0.0, 20.0, 30.0, 37.0, 45.0]
#: Under these a body at rest can only lose energy.
DISSIPATIVE = [jc.ContactImplicit(), jc.ContactStabilized(), jc.BackwardEuler()]


def inclined(angle, corner=0, weight=0.0, dtype=jnp.float64, scheme=SCHEMES[0]):
    """The block turned by an angle [degrees] on a plane through a corner, and the inner normal"""
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    points = BLOCK.points @ np.array([[c, s], [-s, c]])
    normal = np.array([-s, c])
    point = points[np.unique(BLOCK.facets["bottom"])][corner]
    return _prepare(points, point, normal, -weight * normal, dtype, scheme), normal


# One program for all angles.
@partial(jax.jit, static_argnums=(4, 5))
def _prepare(points, point, normal, force, dtype, scheme):
    contact = {"bottom": jc.HalfSpace(point, normal)}
    scene = jc.Scene(BLOCK.with_points(points), ELASTIC, contact=contact, body_force=force)
    return jc.prepare(jc.discretize(scene, dtype=dtype), DT, scheme=scheme)


@pytest.mark.parametrize("corner", [0, -1])
@pytest.mark.parametrize("angle", ANGLES)
def test_body_on_an_inclined_plane_is_in_weak_contact_everywhere(angle, corner):
    # The corner of the block is the origin: its own position has no rounding error, but its
    # distance to a plane through the other corner has.
    stepper, _ = inclined(angle, corner)
    trajectory = jc.simulate(stepper, steps=3)
    assert np.sum(trajectory.weak) == 15  # 5 nodes in 3 steps


def test_report_names_every_weak_contact_on_an_inclined_plane():
    stepper, _ = inclined(30.0)
    report = jc.derivative_report(
        stepper, None, lambda motion: jnp.sum(motion.displacement), steps=3
    )
    assert not report.is_differentiable
    assert len(report.weak) == 15


PATTERN = jnp.linspace(1.0, 2.0, BLOCK.n_nodes)[:, None]


@jax.jit
def height(stepper, normal, push):
    """A mean height of the block after it was pushed onto the plane"""
    control = jnp.broadcast_to(-push * normal, (3, BLOCK.n_nodes, 2))
    final = jc.simulate(stepper, control).displacement[-1]
    return jnp.vdot(PATTERN * normal[None, :], final)


@pytest.mark.parametrize("angle", ANGLES)
def test_gradient_on_an_inclined_plane_is_that_towards_the_plane(angle):
    stepper, normal = inclined(angle)
    at = partial(height, stepper, jnp.asarray(normal))
    step = 1e-3  # piecewise linear: no error of truncation
    right, left = ((at(s * step) - at(0.0)) / (s * step) for s in (1.0, -1.0))
    np.testing.assert_allclose(jax.grad(at)(0.0), right, rtol=1e-9)
    assert abs(right - left) > 0.1 * abs(left)


@pytest.mark.parametrize("weight", [0.0, 1.0])
@pytest.mark.parametrize("scheme", DISSIPATIVE, ids=lambda scheme: type(scheme).__name__)
@pytest.mark.parametrize("angle", ANGLES)
def test_float32_body_at_rest_gains_no_energy(angle, scheme, weight):
    stepper, _ = inclined(angle, -1, weight, jnp.float32, scheme)
    ledger = jc.energy(stepper, jc.simulate(stepper, steps=20))
    gained = np.cumsum(np.asarray(ledger.change - ledger.work, float))
    # Nothing without a weight, and with it the rounding errors of the terms of the ledger.
    rounding = 4.0 * np.finfo(np.float32).eps * np.cumsum(np.abs(ledger.work))
    assert np.all(gained <= rounding)


def test_float32_body_at_rest_does_not_drift_under_contact_stabilized():
    # The pinned nodes keep what velocity they have: a rounding error that came back in every step
    # made their energy grow with the square of the time, 25 times from a fifth of the run on.
    stepper, normal = inclined(0.0, 0, 1.0, jnp.float32, jc.ContactStabilized())
    exact, _ = inclined(0.0, 0, 1.0, jnp.float64, jc.ContactStabilized())
    settle = jc.prepare(exact.system, 10.0, scheme=jc.BackwardEuler())
    rest = jc.simulate(settle, steps=200, save_every=200).final.displacement
    lifted = rest + 1e-7 * jnp.asarray(normal)[None, :]  # by its rounding in float32
    start = jc.State(lifted, jnp.zeros_like(lifted))
    trajectory = jc.simulate(stepper, steps=20_000, initial=start, save_every=4000)
    velocity = np.asarray(trajectory.velocity, float)
    mass = stepper.system.nodal_mass.to_scipy().toarray()
    kinetic = 0.5 * np.einsum("tai,ab,tbi->t", velocity, mass, velocity)
    assert kinetic[-1] < 4.0 * kinetic[1]
