"""Claims about conjugate gradients: the same motion and derivatives as the dense solver."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

#: Both solvers are exact up to a relative residual of 1e-12 per step.
AGREEMENT = 1e-9
SINGLE_AGREEMENT = 1e-3
STEPS = 30
DT = 0.15


def make_system(dtype=jnp.float64):
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / 5)
    plane = jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.1, 1.0]))
    material = jc.KelvinVoigt(young=1.0, poisson=0.3, shear_viscosity=0.01)
    scene = jc.Scene(mesh, material, contact={"bottom": plane}, body_force=np.array([0.0, -0.1]))
    return jc.discretize(scene, dtype=dtype)


SYSTEM = make_system()
SOLVERS: dict[str, Any] = {"dense": jc.Dense(), "cg": jc.ConjugateGradient()}
STEPPERS = {name: jc.prepare(SYSTEM, DT, linear_solver=solver) for name, solver in SOLVERS.items()}


def iterate(**options) -> Any:
    return jc.ConjugateGradient(**options)


def throw(system):
    rest = jnp.zeros((system.n_nodes, system.dimension), system.dtype)
    return jc.State(rest, rest.at[:, 1].set(-0.1))


def control(system=SYSTEM):
    shape = (STEPS, system.n_nodes, system.dimension)
    return 0.05 * jnp.sin(jnp.arange(np.prod(shape), dtype=system.dtype)).reshape(shape)


def objective(stepper, u):
    trajectory = jc.simulate(stepper, u, initial=throw(stepper.system))
    return jnp.sum(trajectory.displacement**2)


def assert_close(actual, expected, tolerance=AGREEMENT):
    actual, expected = np.asarray(actual), np.asarray(expected)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def test_conjugate_gradient_gives_the_motion_of_dense():
    dense, cg = (jc.simulate(s, control(), initial=throw(SYSTEM)) for s in STEPPERS.values())
    assert 0.2 < np.mean(np.any(np.asarray(dense.active), axis=1))
    for name in ("displacement", "velocity", "gap", "contact_impulse"):
        assert_close(getattr(cg, name), getattr(dense, name))
    np.testing.assert_array_equal(cg.active, dense.active)
    np.testing.assert_array_equal(cg.status, jc.Status.CONVERGED)


def test_conjugate_gradient_gives_the_gradient_of_dense():
    dense, cg = (jax.grad(objective, argnums=1)(s, control()) for s in STEPPERS.values())
    assert_close(cg, dense)


def test_conjugate_gradient_gives_the_hessian_product_of_dense():
    direction = jnp.cos(jnp.arange(control().size, dtype=float)).reshape(control().shape)

    def product(stepper):
        gradient = jax.grad(lambda u: objective(stepper, u))
        return jax.jvp(gradient, (control(),), (direction,))[1]

    dense, cg = (product(s) for s in STEPPERS.values())
    assert_close(cg, dense)


@pytest.mark.slow
def test_conjugate_gradient_gives_the_material_gradient_of_dense():
    def by_stiffness(solver):
        def misfit(young):
            material = jc.KelvinVoigt(young=young, poisson=0.3)
            mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / 3)
            plane = jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.1, 1.0]))
            system = jc.discretize(jc.Scene(mesh, material, contact={"bottom": plane}))
            stepper = jc.prepare(system, DT, linear_solver=solver)
            trajectory = jc.simulate(stepper, steps=STEPS, initial=throw(system))
            return jnp.sum(trajectory.displacement**2)

        return jax.grad(misfit)(1.0)

    dense, cg = (by_stiffness(solver) for solver in SOLVERS.values())
    assert_close(cg, dense)


def test_conjugate_gradient_holds_a_fixed_active_set():
    factor = STEPPERS["cg"].operators.problem.factor
    D, N = factor.matrix.to_scipy(), SYSTEM.normals.to_scipy(SYSTEM.size)
    active = np.arange(SYSTEM.normals.count) % 2 == 0
    rhs = jnp.sin(jnp.arange(SYSTEM.size, dtype=float))
    bound = jnp.cos(jnp.arange(SYSTEM.normals.count, dtype=float))
    w, p = factor.solve_constrained(jnp.asarray(active), rhs, bound)
    assert_close((N @ np.asarray(w))[active], bound[active])
    assert_close(D @ np.asarray(w) + N.T @ np.asarray(p), rhs)
    assert not np.any(np.asarray(p)[~active])


def residual_of_a_solve(tolerance):
    stepper = jc.prepare(SYSTEM, DT, linear_solver=iterate(tolerance=tolerance))
    factor = stepper.operators.problem.factor
    rhs = jnp.sin(jnp.arange(SYSTEM.size, dtype=float))
    residual = rhs - factor.matrix @ factor.solve(rhs)
    weights = factor.preconditioner
    return float(jnp.sqrt(jnp.sum(weights * residual**2) / jnp.sum(weights * rhs**2)))


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-12])
def test_conjugate_gradient_stops_at_its_tolerance(tolerance):
    # The last iteration reduces the residual by no more than a factor of 100.
    assert 0.01 * tolerance < residual_of_a_solve(tolerance) <= 1.1 * tolerance


def test_conjugate_gradient_refuses_contact_sets_that_share_a_node():
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / 3)
    plane = jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.0, 1.0]))
    wall = jc.HalfSpace(np.array([-0.01, 0.0]), np.array([1.0, 0.0]))
    material = jc.KelvinVoigt(young=1.0, poisson=0.3)
    system = jc.discretize(jc.Scene(mesh, material, contact={"bottom": plane, "left": wall}))
    with pytest.raises(ValueError, match="common nodes"):
        jc.prepare(system, DT, linear_solver=iterate())


def exhausted():
    stepper = STEPPERS["cg"]
    short = iterate(max_iterations=3)
    # prepare would refuse this solver at once, so the failure is put where values decide it.
    factor = short.factorize(stepper.operators.problem.matrix, SYSTEM.normals)
    problem = replace(stepper.operators.problem, factor=factor)
    return replace(stepper, operators=replace(stepper.operators, problem=problem))


def test_conjugate_gradient_out_of_iterations_is_an_error():
    with pytest.raises(jc.SolveError, match="non finite"):
        jc.simulate(exhausted(), control(), initial=throw(SYSTEM))


def test_conjugate_gradient_out_of_iterations_is_non_finite_under_jit():
    run = jax.jit(lambda stepper, u: jc.simulate(stepper, u, initial=throw(stepper.system)))
    trajectory = run(exhausted(), control())
    np.testing.assert_array_equal(trajectory.status, jc.Status.NON_FINITE)
    assert np.all(np.isnan(trajectory.displacement[1:]))


def test_conjugate_gradient_out_of_iterations_is_refused_by_prepare():
    with pytest.raises(ValueError, match="positive definite"):
        jc.prepare(SYSTEM, DT, linear_solver=iterate(max_iterations=3))


def test_conjugate_gradient_works_in_float32():
    system = make_system(jnp.float32)
    stepper = jc.prepare(system, DT, linear_solver=iterate())
    single = jc.simulate(stepper, control(system), initial=throw(system))
    double = jc.simulate(STEPPERS["dense"], control(), initial=throw(SYSTEM))
    assert single.displacement.dtype == jnp.float32
    np.testing.assert_array_equal(single.status, jc.Status.CONVERGED)
    assert_close(single.displacement, double.displacement, SINGLE_AGREEMENT)


@pytest.mark.parametrize(
    "options",
    [
        {"tolerance": 0.0},
        {"tolerance": -1e-8},
        {"tolerance": 0.1},
        {"tolerance": float("nan")},
        {"max_iterations": 0},
        {"max_iterations": 10.5},
    ],
)
def test_conjugate_gradient_refuses_options_that_cannot_work(options):
    (name,) = options
    with pytest.raises(ValueError, match=f"{name} must be"):
        jc.ConjugateGradient(**options)
