"""Every mode of differentiation, users' own JAX code in front, and what a gradient costs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.thrown_bodies import STEPS, cost, motion, parameters, stepper_of

import jaxcontact as jc

#: The same derivative by two modes.
ROUNDING = 1e-10
#: Central differences of gradients with the step 1e-5.
DIFFERENCE = 1e-6
VALUES = parameters(2)
STEPPER = stepper_of(2, VALUES)
INITIAL = jc.State(VALUES["displacement"], VALUES["velocity"])
CONTROL = VALUES["control"]


def value(control, stepper=STEPPER, initial=INITIAL, weak_contact=None):
    return cost(jc.simulate(stepper, control, initial=initial, weak_contact=weak_contact))


GRADIENT = jax.jit(jax.grad(value))(CONTROL)


def random_like(x, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=x.shape))


def relative(a, b):
    return float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b))


def test_gradient_by_vjp_and_by_jvp_and_without_jit_agree():
    direction = random_like(CONTROL)
    _, pull = jax.vjp(value, CONTROL)
    assert relative(pull(jnp.array(1.0))[0], GRADIENT) <= ROUNDING
    for choice in (jc.ClosedBranch(), jc.OpenBranch(), jc.CriticalCone()):
        _, forward = jax.jvp(
            lambda u, choice=choice: value(u, weak_contact=choice), (CONTROL,), (direction,)
        )
        check_same(forward, direction)


def check_same(forward, direction):
    scale = float(jnp.linalg.norm(GRADIENT) * jnp.linalg.norm(direction))
    assert abs(float(forward) - float(jnp.vdot(GRADIENT, direction))) <= ROUNDING * scale


def test_forward_mode_without_a_named_treatment_of_weak_contact_is_refused():
    with pytest.raises(TypeError, match=r"weak_contact=jc\.ClosedBranch\(\)"):
        jax.jvp(value, (CONTROL,), (CONTROL,))


def test_jacobian_by_rows_and_by_columns_agree():
    def by_nodes(heights):
        lift = jnp.zeros_like(CONTROL).at[:, :3, 1].add(heights)
        return final_of(CONTROL + lift)

    def final_of(control):
        trajectory = jc.simulate(STEPPER, control, initial=INITIAL, weak_contact=jc.ClosedBranch())
        return jnp.concatenate([trajectory.velocity[-1, :3].ravel(), trajectory.gap[-1]])

    rows = jax.jacrev(by_nodes)(jnp.zeros((1, 3)))
    columns = jax.jacfwd(by_nodes)(jnp.zeros((1, 3)))
    np.testing.assert_allclose(rows, columns, atol=ROUNDING * float(jnp.max(jnp.abs(rows))))


def test_gradient_under_vmap_over_controls_equals_the_loop():
    controls = jnp.stack([CONTROL, 0.5 * CONTROL, -CONTROL])
    batched = jax.vmap(jax.grad(value))(controls)
    for control, gradient in zip(controls, batched, strict=True):
        assert relative(gradient, jax.grad(value)(control)) <= ROUNDING


def test_hessian_product_is_the_difference_of_gradients_and_symmetric():
    first, second = random_like(CONTROL, 1), random_like(CONTROL, 2)
    hessian = jax.jit(lambda d: jax.jvp(jax.grad(value), (CONTROL,), (d,))[1])
    product, other = hessian(first), hessian(second)
    h = 1e-5
    difference = (jax.grad(value)(CONTROL + h * first) - jax.grad(value)(CONTROL - h * first)) / (
        2 * h
    )
    assert relative(difference, product) <= DIFFERENCE
    scale = float(jnp.linalg.norm(product) * jnp.linalg.norm(second))
    assert abs(float(jnp.vdot(product, second) - jnp.vdot(other, first))) <= ROUNDING * scale


def test_second_derivative_by_material_agrees_in_every_mode_and_with_differences():
    def of(theta):
        material = VALUES["material"] | {"young": 100.0 * theta[0], "density": 1.3 * theta[1]}
        return cost(motion(2, VALUES | {"material": material}))

    one = jnp.ones(2)
    forward = jax.jit(jax.jacfwd(jax.grad(of)))(one)
    reverse = jax.jit(jax.jacrev(jax.grad(of)))(one)
    np.testing.assert_allclose(forward, forward.T, rtol=1e-8)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8)
    h = 1e-5
    gradient = jax.jit(jax.grad(of))
    columns = [(gradient(one + h * e) - gradient(one - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(forward, jnp.stack(columns, axis=1), rtol=1e-5)


def test_gradient_with_checkpoints_is_the_same_at_weak_contact_choices_too():
    def checkpointed(control, choice):
        return cost(
            jc.simulate(
                STEPPER,
                control,
                initial=INITIAL,
                checkpoint=jc.Checkpoint(),
                weak_contact=choice,
            )
        )

    for choice in (jc.ClosedBranch(), jc.OpenBranch(), jc.AlongDirection(CONTROL)):
        assert relative(jax.grad(checkpointed)(CONTROL, choice), GRADIENT) <= ROUNDING


def test_gradient_of_a_network_as_control_is_right():
    rng = np.random.default_rng(0)
    shape = CONTROL.shape
    parameters = {
        "inner": jnp.asarray(rng.normal(size=(2, 4))),
        "outer": jnp.asarray(0.1 * rng.normal(size=(4, shape[1] * 2))),
    }
    time = jnp.linspace(0.0, 1.0, STEPS)

    def objective(parameters):
        features = jnp.stack([time, jnp.ones_like(time)], axis=1)
        control = jnp.tanh(features @ parameters["inner"]) @ parameters["outer"]
        return value(control.reshape(shape))

    check = jc.check_gradient(objective, parameters, directions=1, n_steps=5)
    assert check.is_right, check
    assert np.max(check.central_relative_error) <= DIFFERENCE


def test_gradient_of_a_boundary_control_of_few_numbers_is_right():
    top = np.unique(STEPPER.system.contact_nodes)

    def objective(pulses):
        control = jnp.zeros_like(CONTROL).at[:, top, 1].add(jnp.repeat(pulses, STEPS // 4)[:, None])
        return value(control)

    check = jc.check_gradient(objective, jnp.array([1.0, -2.0, 3.0, 0.5]), n_steps=5)
    assert check.is_right, check


def saved_per_step(by_material):
    """Shapes of what the backward pass keeps of every step"""
    vertical = (STEPS, STEPPER.system.normals.count)

    def final(control, young):
        values = VALUES | {"material": VALUES["material"] | {"young": young}}
        stepper = stepper_of(2, values) if by_material else STEPPER
        return jnp.sum(jc.simulate(stepper, control, initial=INITIAL).displacement[-1])

    argument = 1 if by_material else 0
    pull = jax.eval_shape(
        lambda *x: jax.vjp(lambda y: final(*x[:argument], y, *x[argument + 1 :]), x[argument])[1],
        CONTROL,
        jnp.array(100.0),
    )
    leaves = [x for x in jax.tree.leaves(pull) if x.ndim and x.shape[0] == STEPS]
    return vertical, [(x.shape, x.dtype) for x in leaves]


def test_gradient_by_control_keeps_one_boolean_per_pair_and_step():
    vertical, saved = saved_per_step(by_material=False)
    masks = [s for s in saved if s[1] == np.dtype(bool)]
    assert masks == [(vertical, np.dtype(bool))]
    # Beside it only scalars of a step: its poison.
    assert [s for s in saved if s[1] != np.dtype(bool) and s[0] != (STEPS,)] == []


def test_gradient_by_material_keeps_the_states_of_the_steps():
    n = STEPPER.system.size
    _, saved = saved_per_step(by_material=True)
    assert ((STEPS, n), np.dtype(float)) in saved


def test_gradient_by_control_computes_no_cotangent_of_a_matrix():
    def program(argument):
        def final(control, stepper):
            return value(control, stepper)

        gradient = jax.grad(final, argnums=argument, allow_int=True)
        return str(jax.make_jaxpr(gradient)(CONTROL, STEPPER))

    width, n_nodes = STEPPER.system.stiffness.columns.shape
    produced = f":f64[{width},2,{n_nodes},2] = mul"  # outer products of blocks
    assert produced not in program(0)
    assert produced in program(1)
