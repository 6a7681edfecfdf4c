"""Claims about vmap: a batch of anything equals the loop."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.linear.dissection.nested_dissection import NestedDissection

#: Sums in another order, relative to the largest value.
ROUNDING = 1e-11
SCENES, STEPS, DT = 3, 25, 0.15
MESH = jc.meshes.rectangle((1.0, 1.0), h=1 / 4)
SOLVERS = [jc.Dense(), NestedDissection(leaf_size=8)]


def prepare(solver, young=1.0, height=-0.02, tilt=0.0):
    plane = jc.HalfSpace(jnp.stack([0.0, height]), jnp.stack([tilt, 1.0]))
    material = jc.KelvinVoigt(young=young, poisson=0.3)
    system = jc.discretize(jc.Scene(MESH, material, contact={"bottom": plane}))
    return jc.prepare(system, DT, linear_solver=solver)


stepper_of = cache(prepare)


def throw(speed=0.1, sideways=0.0):
    rest = jnp.zeros(MESH.points.shape)
    return jc.State(rest, rest + jnp.stack([sideways, -speed])[None, :])


def control(phase=0.0):
    shape = (STEPS, *MESH.points.shape)
    return 0.1 * jnp.sin(phase + jnp.arange(np.prod(shape), dtype=float)).reshape(shape)


def by_control(stepper, u):
    return jc.simulate(stepper, u, initial=throw())


def by_initial(stepper, x):
    return jc.simulate(stepper, control(), initial=throw(0.1 + 0.05 * x, 0.1 * x))


def by_gap(stepper, x):
    system = replace(stepper.system, gap=stepper.system.gap + 0.02 * x)
    return jc.simulate(replace(stepper, system=system), control(), initial=throw())


def by_pose(stepper, x):
    posed = prepare(stepper.linear_solver, height=-0.05 - 0.01 * x, tilt=0.02 * x)
    return jc.simulate(posed, control(), initial=throw())


def by_material(stepper, x):
    other = prepare(stepper.linear_solver, young=1.0 + 0.5 * x)
    return jc.simulate(other, control(), initial=throw())


def assert_batch_equals_loop(run, batch):
    def misfit(x):
        trajectory = run(x)
        return jnp.sum(trajectory.displacement**2), trajectory

    solve = jax.value_and_grad(misfit, has_aux=True)
    (values, together), gradients = jax.jit(jax.vmap(solve))(batch)
    alone = jax.jit(solve)
    results = [alone(x) for x in batch]
    assert np.all(np.any(np.asarray(together.active), axis=(1, 2)))
    assert len({float(v) for v in values}) == len(batch)
    for k, ((value, trajectory), gradient) in enumerate(results):
        np.testing.assert_array_equal(together.status[k], jc.Status.CONVERGED)
        np.testing.assert_array_equal(together.active[k], trajectory.active)
        pairs = [(values[k], value), (gradients[k], gradient)]
        for name in ("displacement", "velocity", "contact_impulse"):
            pairs.append((getattr(together, name)[k], getattr(trajectory, name)))
        for actual, expected in pairs:
            size = np.max(np.abs(expected))
            np.testing.assert_allclose(actual, expected, rtol=0, atol=ROUNDING * size)


@pytest.mark.parametrize("solver", SOLVERS)
def test_vmap_over_controls_equals_the_loop(solver):
    controls = jnp.stack([control(phase) for phase in range(SCENES)])
    assert_batch_equals_loop(partial(by_control, stepper_of(solver)), controls)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_vmap_over_materials_equals_the_loop(solver):
    assert_batch_equals_loop(partial(by_material, stepper_of(solver)), jnp.arange(SCENES) / SCENES)


@pytest.mark.parametrize("run", [by_initial, by_gap, by_pose])
def test_vmap_over_states_and_obstacles_equals_the_loop(run):
    assert_batch_equals_loop(partial(run, stepper_of(SOLVERS[0])), jnp.arange(SCENES) / SCENES)
