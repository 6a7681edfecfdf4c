"""Single steps and states given by region."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import SCHEMES, block, block_scene, random_control, random_initial

import jaxcontact as jc

STEPS = 16


@pytest.mark.parametrize("scheme", SCHEMES[:4])
def test_steps_are_those_of_simulate(scheme):
    stepper = jc.prepare(block().system, 0.02, scheme=scheme)
    control, state = random_control(STEPS), random_initial()
    motion = jc.simulate(stepper, control, initial=state)
    assert np.any(motion.active)

    @jax.jit
    def run(stepper, state, control):
        return jax.lax.scan(lambda s, u: jc.step(stepper, s, u), state, control)

    final, record = run(stepper, state, control)
    np.testing.assert_allclose(final.displacement, motion.final.displacement, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(final.velocity, motion.final.velocity, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(record.contact_impulse, motion.contact_impulse, atol=1e-13)
    np.testing.assert_allclose(record.gap, motion.gap[1:], atol=1e-14)
    np.testing.assert_array_equal(record.status, motion.status)


def test_gradient_through_single_steps_is_that_of_simulate():
    stepper, control, state = block(), random_control(STEPS), random_initial()

    def by_steps(control):
        final, _ = jax.lax.scan(lambda s, u: jc.step(stepper, s, u), state, control)
        return jnp.sum(final.displacement**2)

    def by_simulate(control):
        return jnp.sum(jc.simulate(stepper, control, initial=state).final.displacement ** 2)

    gradients = [jax.jit(jax.grad(f))(control) for f in (by_steps, by_simulate)]
    np.testing.assert_allclose(gradients[0], gradients[1], rtol=1e-10, atol=1e-15)


def test_step_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match=r"\(T, 15, 2\), .*, got \(1, 2, 15\)"):
        jc.step(block(), None, np.zeros((2, 15)))
    other = jc.prepare(block().system, 0.02, scheme=jc.Trapezoidal())
    with pytest.raises(ValueError, match="hands on more from step to step"):
        jc.step(other)


def test_state_without_values_is_at_rest():
    stepper = block()
    rest = jnp.zeros((15, 2))
    moving = jc.State(velocity=rest.at[:, 0].set(1.0))
    whole = jc.State(rest, moving.velocity)
    for first, second in ((jc.State(), None), (moving, whole)):
        motions = [jc.simulate(stepper, steps=3, initial=x) for x in (first, second)]
        np.testing.assert_array_equal(motions[0].displacement, motions[1].displacement)
    tangents = [
        jc.directional_derivative(
            stepper, None, steps=3, initial=whole, initial_direction=x
        ).displacement
        for x in (moving, whole)
    ]
    np.testing.assert_array_equal(tangents[0], tangents[1])


def two_blocks(**clamped):
    mesh = jc.meshes.rectangle((1.0, 1.0), h=0.5)
    joined = jc.join({"a": mesh, "b": mesh.moved(translation=np.array([2.0, 0.0]))})
    return jc.Scene(joined, jc.KelvinVoigt(young=1.0, poisson=0.3), **clamped)


def test_regions_start_with_their_own_velocity():
    scene = two_blocks(clamped=("a/left",))
    state = jc.State.of(scene, velocity={"a": [1.0, 2.0], "b": [3.0, 4.0]}, displacement=[0.5, 0.0])
    a, b = (np.unique(scene.mesh.cells[scene.mesh.regions[name]]) for name in "ab")
    held = np.unique(scene.mesh.facets["a/left"])
    free = np.setdiff1d(a, held)
    np.testing.assert_array_equal(state.velocity[free], np.tile([1.0, 2.0], (free.size, 1)))
    np.testing.assert_array_equal(state.velocity[b], np.tile([3.0, 4.0], (b.size, 1)))
    assert not np.any(state.velocity[held])
    assert not np.any(state.displacement[held])
    assert np.all(state.displacement[b, 0] == 0.5)
    slope = jax.jacobian(lambda v: jc.State.of(scene, velocity={"b": v}).velocity)(jnp.ones(2))
    np.testing.assert_array_equal(np.sum(slope, axis=0), b.size * np.eye(2))


def test_wrong_states_of_regions_are_refused():
    scene = two_blocks()
    with pytest.raises(ValueError, match=r"'c' is not in the mesh; it has \['a', 'b'\]"):
        jc.State.of(scene, velocity={"c": [0.0, 0.0]})
    with pytest.raises(ValueError, match=r"velocity\['a'\] must have shape \(2,\), got \(3,\)"):
        jc.State.of(scene, velocity={"a": [0.0, 0.0, 1.0]})
    mesh = block_scene().mesh
    halves = jc.Mesh.from_arrays(
        mesh.points, mesh.cells, mesh.facets, {"one": np.arange(8), "two": np.arange(8, 16)}
    )
    parts = jc.Scene(halves, scene.material)
    with pytest.raises(ValueError, match="nodes a second value"):
        jc.State.of(parts, velocity={"one": [0.0, 1.0], "two": [0.0, 2.0]})
