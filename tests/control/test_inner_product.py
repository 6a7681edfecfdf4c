import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, VISCOUS

import jaxcontact as jc
from jaxcontact.control.inner_product import L2, nodal_norms

DT = 0.02
# The mass solve stops at 1e-14; its matrix has a condition number of about ten.
SOLVE_TOLERANCE = 1e-12


@pytest.fixture(scope="module")
def system():
    # The clamped nodes carry control, too.
    return jc.discretize(jc.Scene(BLOCK, VISCOUS, clamped=("left",)))


def random_field(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def dense(system):
    return system.nodal_mass.to_scipy().toarray()


def test_control_dot_is_the_integral_over_time_and_body(system):
    first, second = random_field(3, 15, 2), random_field(3, 15, 2, seed=1)
    expected = DT * np.einsum("tai,ab,tbi->", first, dense(system), second)
    np.testing.assert_allclose(jc.control_dot(system, DT, first, second), expected)


def test_control_dot_of_ones_is_duration_times_area(system):
    ones = jnp.ones((4, 15, 2)) * jnp.array([1.0, 0.0])[None, None, :]
    np.testing.assert_allclose(jc.control_dot(system, DT, ones, ones), 4 * DT * 2.0)


def test_nodal_norms_are_squared_l2_norms(system):
    fields = random_field(3, 15, 2)
    expected = np.einsum("tai,ab,tbi->t", fields, dense(system), fields)
    np.testing.assert_allclose(nodal_norms(system.nodal_mass, fields), expected)


def test_l2_riesz_represents_the_derivative(system):
    derivative, direction = random_field(3, 15, 2), random_field(3, 15, 2, seed=1)
    gradient = L2(system, DT).riesz(derivative)
    found = jc.control_dot(system, DT, gradient, direction)
    np.testing.assert_allclose(found, jnp.vdot(derivative, direction), rtol=SOLVE_TOLERANCE)


def test_l2_riesz_is_the_dense_solve(system):
    derivative = random_field(3, 15, 2)
    expected = np.linalg.solve(dense(system), np.asarray(derivative)) / DT
    gradient = L2(system, DT).riesz(derivative)
    np.testing.assert_allclose(gradient, expected, atol=SOLVE_TOLERANCE * np.max(expected))


def test_l2_riesz_is_accurate_in_steps_of_any_size(system):
    # Late steps of a long horizon have little influence, but their gradient counts as much.
    derivative = random_field(3, 15, 2) * jnp.array([1.0, 1e-8, 1e-16])[:, None, None]
    gradient = L2(system, DT).riesz(derivative)
    for k in range(3):
        expected = np.linalg.solve(dense(system), np.asarray(derivative[k])) / DT
        error = np.max(np.abs(gradient[k] - expected))
        assert error < 1e-9 * np.max(np.abs(expected)), k


def test_l2_riesz_of_zero_is_zero(system):
    assert not np.any(L2(system, DT).riesz(jnp.zeros((2, 15, 2))))


def test_l2_riesz_keeps_float32():
    single = jc.discretize(jc.Scene(BLOCK, VISCOUS), dtype=jnp.float32)
    derivative = random_field(3, 15, 2).astype(jnp.float32)
    gradient = L2(single, DT).riesz(derivative)
    assert gradient.dtype == jnp.float32
    expected = np.linalg.solve(dense(single), np.asarray(derivative)) / DT
    np.testing.assert_allclose(gradient, expected, atol=1e-4 * np.max(expected))


def test_l2_value_and_grad_of_half_the_square_is_the_control_itself(system):
    u = random_field(3, 15, 2)
    value, gradient = jc.l2_value_and_grad(
        lambda u: 0.5 * jc.control_dot(system, DT, u, u), system, DT
    )(u)
    np.testing.assert_allclose(value, 0.5 * jc.control_dot(system, DT, u, u))
    np.testing.assert_allclose(gradient, u, atol=SOLVE_TOLERANCE)


def test_l2_value_and_grad_does_not_depend_on_the_time_step(system):
    # The same objective of a control that is constant in time, with few and with many steps.
    target = random_field(15, 2)

    def gradient(steps):
        dt = 0.24 / steps

        def objective(u):
            return dt * jnp.sum(nodal_norms(system.nodal_mass, (u - target[None]) ** 3))

        u = jnp.zeros((steps, 15, 2))
        return jc.l2_value_and_grad(objective, system, dt)(u)[1]

    np.testing.assert_allclose(gradient(2)[0], gradient(6)[0], rtol=1e-10)


def test_l2_value_and_grad_works_under_jit(system):
    u = random_field(3, 15, 2)
    evaluate = jc.l2_value_and_grad(lambda u: jnp.sum(jnp.sin(u)), system, DT)
    _, plain = evaluate(u)
    _, jitted = jax.jit(evaluate)(u)
    np.testing.assert_allclose(jitted, plain, atol=1e-10)
