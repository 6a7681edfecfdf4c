"""Claims about the record of a motion: unknowns are kept, nodal fields are made when asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc


@pytest.fixture(scope="module")
def body():
    scene = jc.Scene(
        mesh=jc.meshes.rectangle((1.0, 0.5), h=0.25),
        material=jc.KelvinVoigt(young=100.0, poisson=0.3),
        clamped=("top",),
        contact={"bottom": jc.HalfSpace(point=[0.0, -0.01], normal=[0.0, 1.0])},
    )
    stepper = jc.prepare(jc.discretize(scene), 0.02)
    control = jnp.zeros((8, *scene.mesh.points.shape)).at[..., 1].set(-10.0)
    return stepper, control


def test_nodal_fields_are_lifted_from_the_unknowns(body):
    stepper, control = body
    motion = jc.simulate(stepper, control)
    np.testing.assert_array_equal(motion.displacement, stepper.system.lift(motion.unknowns))
    np.testing.assert_array_equal(motion.velocity, stepper.system.lift(motion.rates))
    np.testing.assert_array_equal(motion.final.velocity, motion.velocity[-1])
    assert motion.displacement is motion.displacement


def test_nodal_fields_that_nobody_asks_for_are_not_made(body):
    stepper, control = body
    motion = jc.simulate(stepper, control)
    assert not motion.nodal._fields
    program = jax.make_jaxpr(lambda u: jc.simulate(stepper, u).unknowns)(control)
    assert str((9, *control.shape[1:])).replace(" ", "") not in str(program).replace(" ", "")


def test_a_body_without_clamped_nodes_is_recorded_once():
    bar = jc.Scene(
        jc.meshes.interval(1.0, h=0.25), jc.KelvinVoigt(young=1.0, poisson=0.0), contact={}
    )
    stepper = jc.prepare(jc.discretize(bar), 0.1)
    motion = jax.jit(lambda: jc.simulate(stepper, steps=3))()
    assert sum(x.shape[:1] == (4,) and x.size >= 20 for x in jax.tree.leaves(motion)) == 2
    difference = jax.tree.map(lambda a, b: a - b, motion.nodal, motion.nodal)
    assert difference.displacement.shape == motion.displacement.shape == (4, 5, 1)
    shapes = jax.eval_shape(lambda: jc.simulate(stepper, steps=3))
    assert shapes.velocity.shape == (4, 5, 1)


def test_trajectories_are_pytrees_with_nodal_fields(body):
    stepper, control = body
    motion = jc.simulate(stepper, control)
    jitted = jax.jit(jc.simulate)(stepper, control)
    batch = jax.vmap(lambda u: jc.simulate(stepper, u))(jnp.stack([control, 2.0 * control]))
    last = jax.tree.map(lambda x: x[0], batch)
    for other in (jitted, last):
        np.testing.assert_allclose(other.displacement, motion.displacement, atol=1e-15)
        np.testing.assert_allclose(other.velocity, motion.velocity, atol=1e-13)
    difference = jax.tree.map(lambda a, b: jnp.asarray(a, float) - b, last, motion)
    assert np.max(np.abs(difference.displacement)) < 1e-15


def test_forward_mode_of_a_trajectory_has_nodal_tangents(body):
    stepper, control = body

    def motion(u):
        return jc.simulate(stepper, u, weak_contact=jc.ClosedBranch())

    _, tangent = jax.jvp(motion, (control,), (control,))
    expected = stepper.system.lift(tangent.unknowns)
    assert np.max(np.abs(expected)) > 0.0
    np.testing.assert_allclose(tangent.displacement, expected, atol=1e-15)


def test_a_motion_asked_under_jit_leaves_nothing_behind(body):
    stepper, control = body
    motion = jc.simulate(stepper, control)
    total = jax.jit(lambda: jnp.sum(motion.displacement))()
    np.testing.assert_allclose(jnp.sum(motion.displacement), total)
