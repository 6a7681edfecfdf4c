"""Every mode of differentiation, users' own JAX code in front, and what a gradient costs."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.thrown_bodies import (
    MESHES,
    STEPS,
    cost,
    initial_of,
    motion,
    parameters,
    stepper_of,
    thrown,
    value_and_gradient,
)

import jaxcontact as jc

#: The same derivative by two modes.
ROUNDING = 1e-10
#: Central differences of gradients with the step 1e-5.
DIFFERENCE = 1e-6
#: Half of the digits of float32, after condition numbers of about 100 in 24 steps.
SINGLE = 1e-4


@pytest.fixture(scope="module")
def gradient():
    """The gradient of the cost by the control, (T, N, d)"""
    return value_and_gradient(*thrown())[1][0]


def value(control, weak_contact=None, checkpoint=None):
    stepper, _, initial = thrown()
    return cost(
        jc.simulate(
            stepper, control, initial=initial, weak_contact=weak_contact, checkpoint=checkpoint
        )
    )


def random_like(x, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=x.shape))


def relative(a, b):
    return float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b))


def test_gradient_without_jit_is_the_one_under_jit(gradient):
    assert relative(jax.grad(value)(thrown()[1]), gradient) <= ROUNDING


def test_gradient_compiles_nothing_for_other_values(gradient):
    del gradient  # it was compiled for this one
    _, control, initial = thrown()
    values = parameters(2)
    stiffer = values | {"material": values["material"] | {"young": 200.0}}
    programs = value_and_gradient._cache_size()
    value_and_gradient(stepper_of(2, stiffer), 0.5 * control, jax.tree.map(jnp.negative, initial))
    assert value_and_gradient._cache_size() == programs


def test_gradient_under_vmap_over_controls_and_initial_states_equals_the_loop():
    stepper, control, initial = thrown()
    factors = jnp.array([1.0, 0.5, -1.0])
    controls, states = jax.tree.map(
        lambda x: jnp.stack([factor * x for factor in factors]), (control, initial)
    )
    batched = jax.jit(jax.vmap(value_and_gradient, (None, 0, 0)))(stepper, controls, states)
    for k in range(3):
        state = jax.tree.map(lambda x, k=k: x[k], states)
        alone = value_and_gradient(stepper, controls[k], state)
        for a, b in zip(jax.tree.leaves(batched), jax.tree.leaves(alone), strict=True):
            assert relative(a[k], b) <= ROUNDING


def test_gradient_is_the_same_with_both_contact_solvers(gradient):
    stepper, *point = thrown()
    sweeps = jc.with_contact(stepper, jc.ProjectedGaussSeidel())
    # Both solve a step to a relative 1e-12 or so.
    assert relative(value_and_gradient(sweeps, *point)[1][0], gradient) <= 1e-9


def test_gradient_in_single_precision_is_that_of_double_precision():
    values = parameters(2)
    stepper = stepper_of(2, values, dtype=jnp.float32)
    point = jax.tree.map(lambda x: x.astype(jnp.float32), (values["control"], initial_of(values)))
    single, double = (
        value_and_gradient(*arguments)[1] for arguments in ((stepper, *point), thrown())
    )
    for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
        assert a.dtype == jnp.float32
        assert relative(a, b) <= SINGLE


def test_gradient_by_a_single_precision_control_of_a_double_precision_scene_works(gradient):
    stepper, control, initial = thrown()
    found = value_and_gradient(stepper, control.astype(jnp.float32), initial)[1][0]
    assert relative(found, gradient) <= SINGLE


@pytest.mark.parametrize("treatment", [jc.OpenBranch(), jc.CriticalCone()], ids=str)
def test_forward_mode_without_weak_contact_is_the_gradient_for_every_treatment(gradient, treatment):
    control = thrown()[1]
    direction = random_like(control)

    @jax.jit
    def forward(direction):
        return jax.jvp(partial(value, weak_contact=treatment), (control,), (direction,))[1]

    scale = float(jnp.linalg.norm(gradient) * jnp.linalg.norm(direction))
    error = float(forward(direction)) - float(jnp.vdot(gradient, direction))
    assert abs(error) <= ROUNDING * scale


def test_forward_mode_without_a_named_treatment_of_weak_contact_is_refused():
    control = thrown()[1]
    with pytest.raises(TypeError, match=r"weak_contact=jc\.ClosedBranch\(\)"):
        jax.jvp(value, (control,), (control,))


def test_jacobian_by_rows_and_by_columns_agree():
    stepper, control, initial = thrown()

    def by_nodes(heights):
        lift = jnp.zeros_like(control).at[:, :3, 1].add(heights)
        trajectory = jc.simulate(
            stepper, control + lift, initial=initial, weak_contact=jc.ClosedBranch()
        )
        return jnp.concatenate([trajectory.velocity[-1, :3].ravel(), trajectory.gap[-1]])

    rows = jax.jit(jax.jacrev(by_nodes))(jnp.zeros((1, 3)))
    columns = jax.jit(jax.jacfwd(by_nodes))(jnp.zeros((1, 3)))
    np.testing.assert_allclose(rows, columns, atol=ROUNDING * float(jnp.max(jnp.abs(rows))))


def test_second_derivative_by_material_and_control_agrees_in_every_mode_and_with_differences():
    values = parameters(1)
    direction = random_like(values["control"])

    def of(theta):
        material = values["material"] | {"young": 100.0 * theta[0], "density": 1.3 * theta[1]}
        control = values["control"] + theta[2] * direction
        return cost(motion(1, values | {"material": material, "control": control}))

    point = jnp.array([1.0, 1.0, 0.0])
    forward = jax.jit(jax.jacfwd(jax.grad(of)))(point)
    reverse = jax.jit(jax.jacrev(jax.grad(of)))(point)
    np.testing.assert_allclose(forward, forward.T, rtol=1e-8)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8)
    h = 1e-5
    gradient = jax.jit(jax.grad(of))
    columns = [(gradient(point + h * e) - gradient(point - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(forward, jnp.stack(columns, axis=1), rtol=1e-5)


@pytest.mark.parametrize("treatment", [None, jc.OpenBranch()], ids=str)
def test_gradient_with_checkpoints_is_the_same(gradient, treatment):
    checkpointed = partial(value, weak_contact=treatment, checkpoint=jc.Checkpoint())
    assert relative(jax.jit(jax.grad(checkpointed))(thrown()[1]), gradient) <= ROUNDING


def test_gradient_of_a_network_and_of_a_few_pulses_as_control_is_right():
    rng = np.random.default_rng(0)
    shape = thrown()[1].shape
    top = np.unique(MESHES[2].facets["top"])
    point = {
        "inner": jnp.asarray(rng.normal(size=(2, 4))),
        "outer": jnp.asarray(0.1 * rng.normal(size=(4, shape[1] * 2))),
        "pulses": jnp.array([1.0, -2.0, 3.0, 0.5]),
    }
    time = jnp.linspace(0.0, 1.0, STEPS)

    def objective(point):
        features = jnp.stack([time, jnp.ones_like(time)], axis=1)
        network = jnp.tanh(features @ point["inner"]) @ point["outer"]
        pulses = jnp.repeat(point["pulses"], STEPS // 4)[:, None]
        return value(network.reshape(shape).at[:, top, 1].add(pulses))

    check = jc.check_gradient(objective, point, directions=1, n_steps=5)
    assert check.is_right, check
    assert np.max(check.central_relative_error) <= DIFFERENCE


def saved_per_step(by_material):
    """Shape of (step, pair), and shapes and types of what the backward pass keeps of every step"""
    values = parameters(2)
    thrown_stepper, control, initial = thrown()

    def final(control, young):
        varied = values | {"material": values["material"] | {"young": young}}
        stepper = stepper_of(2, varied) if by_material else thrown_stepper
        return jnp.sum(jc.simulate(stepper, control, initial=initial).displacement[-1])

    argument = 1 if by_material else 0
    pull = jax.eval_shape(
        lambda *x: jax.vjp(lambda y: final(*x[:argument], y, *x[argument + 1 :]), x[argument])[1],
        control,
        jnp.array(100.0),
    )
    leaves = [x for x in jax.tree.leaves(pull) if x.ndim and x.shape[0] == STEPS]
    n_pairs = thrown_stepper.system.normals.count
    return (STEPS, n_pairs), [(x.shape, x.dtype) for x in leaves]


def test_gradient_by_control_keeps_one_boolean_per_pair_and_step():
    step_and_pair, saved = saved_per_step(by_material=False)
    masks = [s for s in saved if s[1] == np.dtype(bool)]
    assert masks == [(step_and_pair, np.dtype(bool))]
    # Beside it only scalars of a step: its poison.
    assert [s for s in saved if s[1] != np.dtype(bool) and s[0] != (STEPS,)] == []


def test_gradient_by_material_keeps_the_states_of_the_steps():
    _, saved = saved_per_step(by_material=True)
    assert ((STEPS, thrown()[0].system.size), np.dtype(float)) in saved


def test_gradient_by_control_computes_no_cotangent_of_a_matrix():
    stepper, control, initial = thrown()

    def program(argument):
        def final(control, stepper):
            return cost(jc.simulate(stepper, control, initial=initial))

        gradient = jax.grad(final, argnums=argument, allow_int=True)
        return str(jax.make_jaxpr(gradient)(control, stepper))

    width, n_nodes = stepper.system.stiffness.columns.shape
    produced = f":f64[{width},2,{n_nodes},2] = mul"  # outer products of blocks
    assert produced not in program(0)
    assert produced in program(1)
