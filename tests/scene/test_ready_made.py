"""Every ready-made scene touches, obeys contact law and ledger, has a gradient and a picture."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxcontact as jc

#: Energy of some hundred steps; complementarity of a step.
KEPT, EXACT = 1e-12, 1e-12


def thrown(scene, velocity):
    return jc.State(velocity=jnp.broadcast_to(jnp.asarray(velocity), scene.mesh.points.shape))


def pressing(steps):
    way = np.linspace(0.0, 1.0, steps + 1)[:, None] * np.array([0.0, -0.1])
    return jc.Schedule(motion={"stamp/top": way})


#: Scene, time step, steps, initial velocity and what moves.
CASES = {
    "bar_on_wall": (jc.scenes.bar_on_wall(1.0), 4.4e-6, 45, [-202.2], None),
    "bars": (jc.scenes.bars(2, h=0.2), 0.1, 30, None, None),
    "half_disc": (jc.scenes.half_disc(h=5.0, gap=0.05), 2e-4, 40, None, None),
    "two_discs": (jc.scenes.two_discs(h=0.5, gap=0.01), 0.1, 40, None, None),
    "disc_in_bowl": (jc.scenes.disc_in_bowl(h=0.5), 0.2, 40, None, None),
    "bumper": (jc.scenes.bumper(h=0.5), 0.1, 40, None, None),
    "tumbling_block": (jc.scenes.tumbling_block(h=0.25), 4e-3, 60, [3.0, -8.0], None),
    "spinning_ball": (jc.scenes.spinning_ball(h=1.0), 0.2, 40, None, None),
    "press": (jc.scenes.press(h=0.5), 0.1, 40, None, pressing(40)),
}
MOVING = {"bars": {"bar0": [0.1]}, "two_discs": {"small": [0.0, -0.1]}, "half_disc": None}


def case(name, scheme=None):
    scene, dt, steps, velocity, schedule = CASES[name]
    stepper = jc.prepare(jc.discretize(scene), dt, scheme=scheme)
    initial = None if velocity is None else thrown(scene, velocity)
    if MOVING.get(name):
        initial = jc.State.of(scene, velocity=MOVING[name])
    control = None
    if name == "half_disc":
        shape = (steps, *scene.mesh.points.shape)
        control = jnp.broadcast_to(jnp.array([0.0, -1e6]), shape)
    options = {"control": control, "steps": steps, "initial": initial, "schedule": schedule}
    return scene, stepper, options


@pytest.mark.parametrize("name", CASES)
def test_ready_made_scene_touches_and_keeps_its_ledger(name):
    scene, stepper, options = case(name)
    motion = jc.simulate(stepper, **options)
    assert np.count_nonzero(np.any(motion.active, axis=1)) >= 5
    size = float(jnp.max(jnp.abs(motion.displacement)))
    assert float(jnp.min(motion.gap)) > -EXACT * size
    assert float(jnp.min(motion.contact_impulse)) >= 0.0
    work = motion.contact_impulse * motion.gap[1:]
    assert float(jnp.max(jnp.abs(work))) <= EXACT * size * float(jnp.max(motion.contact_impulse))
    ledger = jc.energy(stepper, motion, options["control"])
    scale = float(jnp.max(ledger.total)) + float(jnp.sum(jnp.abs(ledger.work)))
    assert float(jnp.max(jnp.abs(ledger.residual))) < KEPT * scale
    if scene.mesh.dimension > 1:
        ax = jc.plot.plot_body(scene, motion.displacement[-1])
        assert ax.collections
        plt.close("all")


@pytest.mark.parametrize("name", ["disc_in_bowl", "bumper", "press"])
def test_ready_made_scene_has_a_gradient_by_its_load(name):
    scene, stepper, options = case(name, jc.ContactStabilized())
    steps = options["steps"]
    rng = np.random.default_rng(0)
    force = 1e-3 * rng.normal(size=(steps, *scene.mesh.points.shape))
    weight = rng.normal(size=scene.mesh.points.shape)

    @jax.jit
    def cost(amount):
        motion = jc.simulate(stepper, **options | {"control": amount * force})
        return jnp.vdot(weight, motion.displacement[-1])

    slope = float(jax.grad(cost)(1.0))
    step = 1e-6
    difference = float(cost(1.0 + step) - cost(1.0 - step)) / (2.0 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-5)


def test_bar_on_wall_agrees_with_the_published_impact():
    scene = jc.scenes.bar_on_wall()
    stepper = jc.prepare(jc.discretize(scene), 2.226e-6, scheme=jc.ContactStabilized())
    motion = jc.simulate(stepper, steps=90, initial=thrown(scene, [-202.2]))
    closed = np.flatnonzero(motion.active[:, 0])
    assert motion.time[closed[0]] == pytest.approx(4.946e-5, abs=2.5e-6)
    assert motion.time[closed[-1] + 1] == pytest.approx(1.481e-4, abs=3 * 2.226e-6)
    force = np.asarray(motion.contact_force[:, 0])
    assert np.mean(force[closed[4:-4]]) == pytest.approx(2.992e4, rel=0.01)


def test_press_pushes_the_block_aside():
    _, stepper, options = case("press")
    motion = jc.simulate(stepper, **options)
    system = stepper.system
    right = np.argmax(system.points[:, 0])
    assert motion.displacement[-1, right, 0] > 0.005
    assert float(jnp.sum(jc.energy(stepper, motion).work)) > 0.0
