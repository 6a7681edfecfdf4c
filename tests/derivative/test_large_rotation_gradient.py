"""Gradients of bodies that turn, through an impact, by everything that a motion depends on."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.turning import DT, SCHEMES, STEPS, cost, hit, parameters, stepper_of

import jaxcontact as jc

IMPLICIT, STABILIZED, EULER = SCHEMES

KINDS = ("material", "floor", "points", "gravity", "dt", "control", "displacement", "velocity")


@cache
def gradient(dimension, scheme, floor):
    return jax.jit(jax.grad(cost, argnums=1), static_argnums=(0, 2, 3))(
        dimension, parameters(dimension, floor=floor), scheme, floor == "bowl"
    )


def check_by_differences(dimension, scheme, kind, floor="plane"):
    """Central differences along a random direction, of the size of the values, to 1e-7"""
    values, rng = parameters(dimension, floor=floor), np.random.default_rng(7)
    size = {"displacement": 1e-3, "points": 1e-3}.get(kind, 1e-2)
    direction = jax.tree.map(
        lambda x: jnp.asarray(size * rng.normal(size=x.shape)) * (jnp.max(jnp.abs(x)) + 1e-2),
        values[kind],
    )
    products = jax.tree.map(
        lambda g, d: jnp.sum(g * d), gradient(dimension, scheme, floor)[kind], direction
    )
    expected = float(sum(jax.tree.leaves(products)))

    def at(step):
        moved = jax.tree.map(lambda x, d: x + step * d, values[kind], direction)
        return float(cost(dimension, values | {kind: moved}, scheme, floor == "bowl"))

    errors = [abs((at(s) - at(-s)) / (2 * s) - expected) for s in (1e-1, 1e-2, 1e-3)]
    assert min(errors) <= 1e-7 * abs(expected)


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_through_a_turning_impact_is_exact(kind):
    assert bool(jnp.any(hit(2, STABILIZED)[2].strong))
    check_by_differences(2, STABILIZED, kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda x: type(x).__name__)
def test_gradient_is_exact_with_every_scheme(dimension, scheme, kind):
    check_by_differences(dimension, scheme, kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("floor", ["ball", "bowl"])
@pytest.mark.parametrize("scheme", SCHEMES[:2], ids=lambda x: type(x).__name__)
def test_gradient_is_exact_on_round_obstacles(scheme, floor, kind):
    check_by_differences(2, scheme, kind, floor)


def test_pure_force_and_pure_torque_have_a_gradient():
    """The adjoint of the mass centre has no torque, that of the rotation no force"""
    values = parameters(2)
    stepper = stepper_of(2, values, IMPLICIT, is_flight=True)
    points = values["points"] + values["displacement"]
    arm = points - jnp.mean(points, axis=0, keepdims=True)
    fields = {
        "way": jnp.ones_like(points) * jnp.array([[1.0, 0.0]]),
        "spin": arm @ jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
    }

    @jax.jit
    @jax.jacrev
    def end(velocity):
        start = jc.State(values["displacement"], velocity)
        motion = jc.simulate(stepper, steps=STEPS, initial=start)
        R = motion.rotation[-1, 0]
        return jnp.array([motion.centre[-1, 0, 0], jnp.arctan2(R[1, 0], R[0, 0])])

    slopes = end(values["velocity"])
    found = {name: jnp.sum(slopes * x[None], axis=(1, 2)) for name, x in fields.items()}
    time = STEPS * DT
    np.testing.assert_allclose(found["way"], [time, 0.0], atol=1e-10)
    # The arms are about the mean of the nodes, not about the mass centre.
    np.testing.assert_allclose(found["spin"], [0.0, time], rtol=2e-2, atol=1e-5)


def test_checkpoints_give_the_same_gradient():
    values = parameters(2)
    stepper, control, _ = hit(2, STABILIZED)

    def final(velocity, checkpoint):
        start = jc.State(values["displacement"], velocity)
        motion = jc.simulate(stepper, control, initial=start, checkpoint=checkpoint)
        return jnp.sum(motion.displacement[-1] ** 2)

    plain = jax.grad(final)(values["velocity"], None)
    recomputed = jax.grad(final)(values["velocity"], jc.Checkpoint(5))
    np.testing.assert_allclose(recomputed, plain, rtol=1e-11)


def test_nothing_of_the_sweeps_is_stored():
    """What grows with the number of steps is what a step is made of, whatever the sweeps"""
    values = parameters(2)
    stepper = stepper_of(2, values, STABILIZED)

    def final(velocity):
        start = jc.State(values["displacement"], velocity)
        return jnp.sum(jc.simulate(stepper, steps=STEPS, initial=start).displacement[-1])

    _, back = jax.vjp(final, values["velocity"])
    n = stepper.system.size
    per_step = sum(x.size for x in jax.tree.leaves(back) if x.ndim and x.shape[0] == STEPS) / STEPS
    assert per_step < 30 * n


@pytest.mark.slow
def test_batch_of_gradients_is_each_of_them():
    values = parameters(2)
    stepper, control, _ = hit(2, STABILIZED)

    def final(speed):
        start = jc.State(values["displacement"], speed * values["velocity"])
        return jnp.sum(jc.simulate(stepper, control, initial=start).displacement[-1])

    speeds = jnp.array([0.9, 1.0])
    together = jax.vmap(jax.grad(final))(speeds)
    alone = jnp.stack([jax.grad(final)(speed) for speed in speeds])
    np.testing.assert_allclose(together, alone, rtol=1e-8)
