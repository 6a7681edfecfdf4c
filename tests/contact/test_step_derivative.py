"""The derivative of one contact problem, against dense saddle-point systems."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.contact import Bound, Guess, Status, contact_problem
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix

N_UNKNOWNS, N_PAIRS = 8, 4
# Two ways to solve the same well-conditioned 12 x 12 system.
ROUNDING = 1e-11
# Central differences with the step 1e-6: rounding 1e-10, third derivatives 1e-12.
DIFFERENCE = 1e-8
UNKNOWNS = np.arange(N_UNKNOWNS, dtype=np.int32).reshape(N_PAIRS, 2)
COLUMNS = np.repeat(np.arange(N_UNKNOWNS, dtype=np.int32)[:, None], N_UNKNOWNS, axis=1)
SOLVERS = [jc.SemismoothNewton(), jc.ProjectedGaussSeidel()]


def random_data(seed=0, multiplier=(1.0, 0.0, 2.0, 0.0)):
    """D (n, n), entries of N (C, 2), r (n,), b (C,) of a problem with the given multiplier"""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N_UNKNOWNS, N_UNKNOWNS))
    matrix = np.eye(N_UNKNOWNS) + 0.3 * root @ root.T
    weights = rng.normal(size=(N_PAIRS, 2))
    rhs = rng.normal(size=N_UNKNOWNS)
    normals = dense_normals(weights)
    w = np.linalg.solve(matrix, rhs - normals.T @ np.array(multiplier))
    bound = normals @ w + (np.array(multiplier) == 0.0)
    return tuple(map(jnp.asarray, (matrix, weights, rhs, bound)))


def dense_normals(weights):
    normals = np.zeros((N_PAIRS, N_UNKNOWNS))
    np.put_along_axis(normals, UNKNOWNS, np.asarray(weights), axis=1)
    return normals


def solve(matrix, weights, rhs, bound, solver=SOLVERS[0], weak_contact=None):
    """w (n,), p (C,), active (C,) and status as a function of dense data"""
    symmetric = SymmetricMatrix((matrix + matrix.T) / 2, jnp.asarray(COLUMNS))
    normals = ContactNormals(weights, jnp.asarray(UNKNOWNS))
    factor = jc.Dense().factorize(*jax.lax.stop_gradient((symmetric, normals)))
    problem = contact_problem(symmetric, normals, factor, solver)
    problem = replace(problem, weak_contact=weak_contact)
    nothing = jnp.zeros(N_PAIRS)
    w, solution = problem.solve(rhs, Bound(bound, nothing), Guess(nothing > 0))
    return w, solution.multiplier, solution.active, solution.status


def saddle_point(data, active):
    """The symmetric matrix of (dw, dp) on the active set, (n + C, n + C)"""
    matrix, weights, *_ = (np.asarray(x) for x in data)
    normals = dense_normals(weights) * np.asarray(active)[:, None]
    corner = np.diag(np.where(active, 0.0, 1.0))
    return np.block([[matrix, normals.T], [normals, corner]])


def weighted(*data):
    """A functional of the solution that no symmetry makes simple"""
    w, p, *_ = solve(*data)
    return jnp.dot(jnp.sin(jnp.arange(1.0, N_UNKNOWNS + 1)), w) + jnp.dot(jnp.arange(1.0, 5.0), p)


def adjoint(data):
    """The adjoint (z, m) of `weighted`, with w, p and the active set, all NumPy"""
    w, p, active, _ = map(np.asarray, solve(*data))
    right = np.concatenate([np.sin(np.arange(1.0, 9.0)), np.arange(1.0, 5.0) * active])
    z, m = np.split(np.linalg.solve(saddle_point(data, active), right), [N_UNKNOWNS])
    return z, m, w, p, active


@pytest.mark.parametrize("solver", SOLVERS)
def test_step_solves_the_saddle_point_problem_of_its_active_set(solver):
    data = random_data()
    w, p, active, status = solve(*data, solver)
    _, _, rhs, bound = map(np.asarray, data)
    np.testing.assert_allclose(p, [1.0, 0.0, 2.0, 0.0], atol=ROUNDING)
    assert int(status) == Status.CONVERGED
    right = np.concatenate([rhs, np.where(active, bound, 0.0)])
    expected = np.linalg.solve(saddle_point(data, active), right)
    np.testing.assert_allclose(np.concatenate([w, p]), expected, atol=ROUNDING)


def test_step_gradient_by_right_hand_side_and_bound_is_the_adjoint():
    data = random_data()
    z, m, *_ = adjoint(data)
    by_rhs, by_bound = jax.grad(weighted, (2, 3))(*data)
    np.testing.assert_allclose(by_rhs, z, atol=ROUNDING)
    np.testing.assert_allclose(by_bound, m, atol=ROUNDING)


def test_step_gradient_by_the_matrix_is_an_outer_product():
    data = random_data()
    z, _, w, *_ = adjoint(data)
    expected = -(np.outer(z, w) + np.outer(w, z)) / 2
    np.testing.assert_allclose(jax.grad(weighted, 0)(*data), expected, atol=ROUNDING)


def test_step_gradient_by_the_normals_has_both_terms():
    data = random_data()
    z, m, w, p, _ = adjoint(data)
    expected = -(np.outer(p, z) + np.outer(m, w))
    expected = np.take_along_axis(expected, UNKNOWNS, axis=1)
    np.testing.assert_allclose(jax.grad(weighted, 1)(*data), expected, atol=ROUNDING)


@pytest.mark.parametrize("argument", [0, 1, 2, 3])
def test_step_gradient_agrees_with_central_differences(argument):
    data = random_data()
    shape = data[argument].shape
    direction = jnp.asarray(np.random.default_rng(argument).normal(size=shape))

    @jax.jit
    def along(s):
        return weighted(*data[:argument], data[argument] + s * direction, *data[argument + 1 :])

    difference = (along(1e-6) - along(-1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(along)(0.0), difference, rtol=DIFFERENCE)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_step_jvp_and_vjp_pass_the_dot_product_test(seed):
    data = random_data(seed)
    rng = np.random.default_rng(seed)
    tangents = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in data)
    cotangents = tuple(jnp.asarray(rng.normal(size=k)) for k in (N_UNKNOWNS, N_PAIRS))

    def states(*data, weak_contact=None):
        return solve(*data, weak_contact=weak_contact)[:2]

    # Forward mode belongs to a named treatment of weak contact, the default is a custom_vjp.
    _, forward = jax.jvp(partial(states, weak_contact=jc.ClosedBranch()), data, tangents)
    backward = jax.vjp(states, *data)[1](cotangents)
    left = sum(jnp.vdot(a, b) for a, b in zip(forward, cotangents, strict=True))
    right = sum(jnp.vdot(a, b) for a, b in zip(backward, tangents, strict=True))
    np.testing.assert_allclose(left, right, rtol=ROUNDING)


def test_step_hessian_product_agrees_with_differences_of_the_gradient():
    data = random_data()
    rng = np.random.default_rng(0)
    direction = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in data)

    def cost(*data):
        w, p, *_ = solve(*data)
        return jnp.sum(jnp.sin(w)) + jnp.sum(p**3)

    gradient = jax.jit(jax.grad(cost, (0, 1, 2, 3)))
    _, product = jax.jvp(gradient, data, direction)
    above, below = (
        gradient(*(x + s * d for x, d in zip(data, direction, strict=True))) for s in (1e-6, -1e-6)
    )
    for found, high, low in zip(product, above, below, strict=True):
        difference = (high - low) / 2e-6
        scale = float(jnp.max(jnp.abs(difference)))
        np.testing.assert_allclose(found, difference, atol=10 * DIFFERENCE * scale)


def test_step_under_vmap_equals_the_loop_with_its_gradients():
    data = random_data()
    shifts = jnp.asarray(np.random.default_rng(1).normal(size=(5, N_PAIRS)))

    def value_and_gradient(shift):
        return jax.value_and_grad(lambda b: weighted(*data[:3], b))(data[3] + shift)

    values, gradients = jax.vmap(value_and_gradient)(shifts)
    looped = [value_and_gradient(shift) for shift in shifts]
    assert len({tuple(np.asarray(g) != 0) for _, g in looped}) > 1  # several active sets
    for k, (value, gradient) in enumerate(looped):
        np.testing.assert_allclose(values[k], value, rtol=ROUNDING)
        np.testing.assert_allclose(gradients[k], gradient, atol=ROUNDING)


def test_step_gradients_by_different_data_of_one_compiled_program_do_not_mix():
    # JAX reads the residuals of a step by the pattern of the last gradient that was traced.
    data = random_data()
    compiled = jax.jit(lambda scale, *data: scale * weighted(*data))

    def gradient(arguments):
        return jax.grad(compiled, arguments)(1.0, *data)

    gradient((3,))
    by_matrix, by_normals = gradient((1, 2))
    _, by_rhs = gradient((0, 3))
    z, m, w, p, _ = adjoint(data)
    np.testing.assert_allclose(by_rhs, z, atol=ROUNDING)
    np.testing.assert_allclose(by_matrix, -(np.outer(z, w) + np.outer(w, z)) / 2, atol=ROUNDING)
    expected = np.take_along_axis(-(np.outer(p, z) + np.outer(m, w)), UNKNOWNS, axis=1)
    np.testing.assert_allclose(by_normals, expected, atol=ROUNDING)


def test_step_without_active_pairs_has_the_gradient_of_the_free_motion():
    matrix, weights, rhs, bound = random_data()
    gradient = jax.grad(lambda r: jnp.sum(solve(matrix, weights, r, bound + 100.0)[0]))(rhs)
    expected = np.linalg.solve(matrix, np.ones(N_UNKNOWNS))
    np.testing.assert_allclose(gradient, expected, atol=ROUNDING)


def test_step_with_all_pairs_active_moves_the_body_with_the_bound():
    matrix, weights, rhs, bound = random_data(multiplier=(1.0, 2.0, 3.0, 4.0))
    normals = dense_normals(weights)

    def normal_velocity(b):
        return jnp.asarray(normals) @ solve(matrix, weights, rhs, b)[0]

    assert np.all(solve(matrix, weights, rhs, bound)[2])
    np.testing.assert_allclose(jax.jacrev(normal_velocity)(bound), np.eye(4), atol=ROUNDING)


def test_step_gradient_in_weak_contact_counts_it_as_strong():
    matrix, weights, rhs, _ = random_data()
    normals = dense_normals(weights)
    # The free motion just touches all pairs. Its rounding error is no contact and no gap.
    touching = jnp.asarray(normals @ np.linalg.solve(matrix, rhs))
    symmetric = SymmetricMatrix(matrix, jnp.asarray(COLUMNS))
    operator = ContactNormals(weights, jnp.asarray(UNKNOWNS))
    factor = jc.Dense().factorize(symmetric, operator)
    problem = contact_problem(symmetric, operator, factor, SOLVERS[0])

    def normal_velocity(r):
        resolution = jnp.full(N_PAIRS, 1e-13)
        w, solution = problem.solve(r, Bound(touching, resolution), Guess(jnp.zeros(N_PAIRS, bool)))
        return operator @ w, solution.active

    jacobian, active = jax.jacrev(normal_velocity, has_aux=True)(rhs)
    assert np.all(active)
    np.testing.assert_allclose(jacobian, 0.0, atol=ROUNDING)


def test_step_that_is_not_solved_poisons_value_and_gradient():
    data = random_data()
    # Both active pairs are coupled, so one sweep is not enough.
    solver = jc.ProjectedGaussSeidel(max_sweeps=1)
    assert int(solve(*data, solver)[3]) == Status.NOT_CONVERGED
    value, gradients = jax.jit(
        jax.value_and_grad(lambda *data: jnp.sum(solve(*data, solver)[0]), (0, 1, 2, 3))
    )(*data)
    assert np.isnan(value)
    for gradient in gradients[2:]:
        # The bound of a pair without contact does not enter.
        assert np.any(np.isnan(gradient))


def test_step_that_is_not_solved_poisons_its_multiplier():
    data = random_data()
    solver = jc.ProjectedGaussSeidel(max_sweeps=1)
    assert np.all(np.isnan(solve(*data, solver)[1]))


def test_step_without_contact_pairs_is_a_linear_solve_with_its_gradients():
    matrix, _, rhs, _ = random_data()

    def total(matrix, rhs):
        symmetric = SymmetricMatrix((matrix + matrix.T) / 2, jnp.asarray(COLUMNS))
        nothing = ContactNormals(jnp.zeros((0, 2)), jnp.zeros((0, 2), jnp.int32))
        factor = jc.Dense().factorize(jax.lax.stop_gradient(symmetric), nothing)
        problem = contact_problem(symmetric, nothing, factor, SOLVERS[0])
        guess = Guess(jnp.zeros(0, bool))
        w, solution = problem.solve(rhs, Bound(jnp.zeros(0), jnp.zeros(0)), guess)
        return jnp.sum(jnp.sin(w)), (w, solution.status)

    (by_matrix, by_rhs), (w, status) = jax.grad(total, (0, 1), has_aux=True)(matrix, rhs)
    z = np.linalg.solve(matrix, np.cos(w))
    assert int(status) == Status.CONVERGED
    np.testing.assert_allclose(w, np.linalg.solve(matrix, rhs), atol=ROUNDING)
    np.testing.assert_allclose(by_rhs, z, atol=ROUNDING)
    np.testing.assert_allclose(by_matrix, -(np.outer(z, w) + np.outer(w, z)) / 2, atol=ROUNDING)
