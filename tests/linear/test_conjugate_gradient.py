"""Claims about conjugate gradients: the same motion and derivatives as the dense solver."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix

#: Both solvers are exact up to a relative residual of 1e-12 per step.
AGREEMENT = 1e-9
SINGLE_AGREEMENT = 1e-3
STEPS = 30
DT = 0.15


@cache
def block(dtype=jnp.float64):
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / 5)
    plane = jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.1, 1.0]))
    material = jc.KelvinVoigt(young=1.0, poisson=0.3, shear_viscosity=0.01)
    scene = jc.Scene(mesh, material, contact={"bottom": plane}, body_force=np.array([0.0, -0.1]))
    return jc.discretize(scene, dtype=dtype)


SOLVERS: dict[str, Any] = {"dense": jc.Dense(), "cg": jc.ConjugateGradient()}


@cache
def steppers():
    return {name: jc.prepare(block(), DT, linear_solver=x) for name, x in SOLVERS.items()}


def iterate(**options) -> Any:
    return jc.ConjugateGradient(**options)


def throw(system):
    rest = jnp.zeros((system.n_nodes, system.dimension), system.dtype)
    return jc.State(rest, rest.at[:, 1].set(-0.1))


def control(dtype=jnp.float64):
    system = block(dtype)
    shape = (STEPS, system.n_nodes, system.dimension)
    return 0.05 * jnp.sin(jnp.arange(np.prod(shape), dtype=system.dtype)).reshape(shape)


def objective(stepper, u):
    trajectory = jc.simulate(stepper, u, initial=throw(stepper.system))
    return jnp.sum(trajectory.displacement**2)


def assert_close(actual, expected, tolerance=AGREEMENT):
    actual, expected = np.asarray(actual), np.asarray(expected)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def test_conjugate_gradient_gives_the_motion_of_dense():
    dense, cg = (jc.simulate(s, control(), initial=throw(block())) for s in steppers().values())
    assert 0.2 < np.mean(np.any(np.asarray(dense.active), axis=1))
    for name in ("displacement", "velocity", "gap", "contact_impulse"):
        assert_close(getattr(cg, name), getattr(dense, name))
    np.testing.assert_array_equal(cg.active, dense.active)
    np.testing.assert_array_equal(cg.status, jc.Status.CONVERGED)


def test_conjugate_gradient_gives_the_gradient_of_dense():
    dense, cg = (jax.grad(objective, argnums=1)(s, control()) for s in steppers().values())
    assert_close(cg, dense)


def test_conjugate_gradient_gives_the_hessian_product_of_dense():
    direction = jnp.cos(jnp.arange(control().size, dtype=float)).reshape(control().shape)

    def product(stepper):
        gradient = jax.grad(lambda u: objective(stepper, u))
        return jax.jvp(gradient, (control(),), (direction,))[1]

    dense, cg = (product(s) for s in steppers().values())
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
    factor = steppers()["cg"].operators.problem.form.factor
    D, N = factor.matrix.to_scipy(), block().normals.to_scipy(block().size)
    active = np.arange(block().normals.count) % 2 == 0
    rhs = jnp.sin(jnp.arange(block().size, dtype=float))
    bound = jnp.cos(jnp.arange(block().normals.count, dtype=float))
    w, p = factor.solve_constrained(jnp.asarray(active), rhs, bound)
    assert_close((N @ np.asarray(w))[active], bound[active])
    assert_close(D @ np.asarray(w) + N.T @ np.asarray(p), rhs)
    assert not np.any(np.asarray(p)[~active])


#: Pairs of two unknowns each, and which of them are held.
N_PAIRS, HELD = 4, np.array([True, False, True, True])
N_UNKNOWNS = 40
PAIRS = np.arange(2 * N_PAIRS, dtype=np.int32).reshape(N_PAIRS, 2)


def chain(condition):
    """A free chain of springs on weak springs to the ground: the rigid motion is the lowest mode"""
    stiffness = 2.0 * np.eye(N_UNKNOWNS) - np.eye(N_UNKNOWNS, k=1) - np.eye(N_UNKNOWNS, k=-1)
    stiffness[0, 0] = stiffness[-1, -1] = 1.0
    return stiffness + 4.0 / condition * np.eye(N_UNKNOWNS)


def cluster(condition):
    """A random basis, most eigenvalues one and a few down to the lowest"""
    basis = np.linalg.qr(np.random.default_rng(1).normal(size=(N_UNKNOWNS, N_UNKNOWNS)))[0]
    eigenvalues = np.ones(N_UNKNOWNS)
    eigenvalues[:8] = np.logspace(0.0, -np.log10(condition), 8)
    return (basis * eigenvalues) @ basis.T


def spread(condition):
    """A random basis and as many eigenvalues in every decade: the iteration loses its way"""
    basis = np.linalg.qr(np.random.default_rng(2).normal(size=(N_UNKNOWNS, N_UNKNOWNS)))[0]
    return (basis * np.logspace(0.0, -np.log10(condition), N_UNKNOWNS)) @ basis.T


def random_problem(make, condition, data):
    """A badly scaled matrix, contact pairs, and the data of a constrained solve"""
    rng = np.random.default_rng(0)
    scale = 10.0 ** rng.uniform(-1.0, 1.0, N_UNKNOWNS // 2).repeat(2)
    matrix = scale[:, None] * make(condition) * scale
    weights = rng.normal(size=(N_PAIRS, 2))
    N = np.zeros((N_PAIRS, N_UNKNOWNS))
    N[np.arange(N_PAIRS)[:, None], PAIRS] = weights
    w, bound = rng.normal(size=N_UNKNOWNS) / scale, rng.normal(size=N_PAIRS)
    rhs = {
        "force": scale * rng.normal(size=N_UNKNOWNS),
        "velocity": matrix @ w,
        "bound": np.zeros(N_UNKNOWNS),
        "rest": N[HELD].T @ rng.normal(size=HELD.sum()),
    }[data]
    if data == "rest":
        bound = np.zeros(N_PAIRS)
    return matrix, N, ContactNormals(jnp.asarray(weights), PAIRS), scale, rhs, bound


@jax.jit
def factorize_and_solve(values, weights, rhs, bound):
    normals = ContactNormals(weights, PAIRS)
    factor = jc.ConjugateGradient().factorize(SymmetricMatrix(values, None), normals)
    return factor.solve_constrained(jnp.asarray(HELD), rhs, bound)


def error_of_a_constrained_solve(make, condition, data):
    """|w - exact| / (|w| + |rhs|) in the norms of the diagonal; NaN if the solve is"""
    matrix, N, normals, scale, rhs, bound = random_problem(make, condition, data)
    w, _ = factorize_and_solve(matrix, normals.weights, rhs, bound)
    rows = N[HELD] / scale
    saddle_point = np.block(
        [[matrix / scale[:, None] / scale, rows.T], [rows, np.zeros((len(rows), len(rows)))]]
    )
    exact = np.linalg.solve(saddle_point, np.concatenate([rhs / scale, bound[HELD]]))[:N_UNKNOWNS]
    size = np.linalg.norm(exact) + np.linalg.norm(rhs / scale)
    return np.linalg.norm(scale * np.asarray(w) - exact) / size


@pytest.mark.parametrize("data", ["force", "velocity", "bound", "rest"])
@pytest.mark.parametrize("condition", [1e2, 1e4, 1e6, 1e8])
@pytest.mark.parametrize("make", [chain, cluster, spread])
def test_conjugate_gradient_solves_badly_conditioned_constrained_problems(make, condition, data):
    # The accuracy that the solver aims at, and what conditioning leaves of it at 1e8.
    assert error_of_a_constrained_solve(make, condition, data) < max(AGREEMENT, 1e-16 * condition)


@pytest.mark.parametrize("data", ["force", "velocity", "bound"])
@pytest.mark.parametrize("condition", [1e11, 1e12, 5e12, 6e14])
@pytest.mark.parametrize("make", [chain, cluster])
def test_conjugate_gradient_beyond_its_accuracy_gives_nan(make, condition, data):
    assert np.isnan(error_of_a_constrained_solve(make, condition, data))


def test_conjugate_gradient_refuses_a_matrix_beyond_its_accuracy():
    matrix, _, normals, *_ = random_problem(chain, 5e12, "force")
    with pytest.raises(ValueError, match=r"condition of about .*e\+12"):
        jc.ConjugateGradient().factorize(SymmetricMatrix(jnp.asarray(matrix), None), normals)


def test_conjugate_gradient_of_nothing_is_zero():
    matrix, _, normals, *_ = random_problem(chain, 1e4, "force")
    w, p = factorize_and_solve(matrix, normals.weights, np.zeros(N_UNKNOWNS), np.zeros(N_PAIRS))
    assert not np.any(w)
    assert not np.any(p)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_conjugate_gradient_knows_whether_a_matrix_is_positive(sign):
    matrix, _, normals, _, rhs, bound = random_problem(chain, 1e2, "force")
    matrix[:2, :2] *= sign
    factor = jc.ConjugateGradient().factorize(SymmetricMatrix(jnp.asarray(matrix), None), normals)
    assert bool(factor.is_positive) == (sign > 0.0)
    w, _ = factorize_and_solve(matrix, normals.weights, rhs, bound)
    assert np.all(np.isfinite(w)) == (sign > 0.0)


def test_conjugate_gradient_refuses_an_indefinite_matrix_with_positive_diagonal():
    matrix, _, normals, scale, rhs, bound = random_problem(chain, 1e2, "force")
    # Shifted between its eigenvalues; the diagonal stays positive.
    matrix -= 0.5 * np.diag(scale**2)
    assert np.all(np.diag(matrix) > 0.0)
    w, _ = factorize_and_solve(matrix, normals.weights, rhs, bound)
    assert np.all(np.isnan(w))


def test_conjugate_gradient_keeps_a_heavy_body_at_rest_as_dense():
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / 5)
    plane = jc.HalfSpace(np.array([0.0, 0.0]), np.array([0.0, 1.0]))
    material = jc.KelvinVoigt(young=1e4, poisson=0.3, shear_viscosity=5e4)
    scene = jc.Scene(mesh, material, contact={"bottom": plane}, body_force=np.array([0.0, -9.81]))
    system = jc.discretize(scene)
    # Free on the ground and steps much longer than a period: condition about 3e5.
    both = [jc.prepare(system, 0.1, linear_solver=solver) for solver in SOLVERS.values()]
    settled = jc.simulate(both[0], steps=1000)
    above = settled.displacement[-1].at[:, 1].add(1e-12)  # rounding may lie below the plane
    initial = jc.State(above, jnp.zeros_like(above))

    @jax.jit
    def run(stepper, u):
        def impulse(u):
            trajectory = jc.simulate(stepper, u, initial=initial)
            return jnp.sum(trajectory.contact_impulse**2), trajectory

        return jax.value_and_grad(impulse, has_aux=True)(u)

    nothing = jnp.zeros((10, system.n_nodes, 2))
    ((_, dense), dense_slope), ((_, cg), cg_slope) = (run(s, nothing) for s in both)
    np.testing.assert_array_equal(cg.status, jc.Status.CONVERGED)
    assert_close(cg.displacement, dense.displacement)
    assert_close(cg.contact_impulse, dense.contact_impulse)
    assert_close(cg_slope, dense_slope)


def residual_of_a_solve(tolerance):
    stepper = jc.prepare(block(), DT, linear_solver=iterate(tolerance=tolerance))
    factor = stepper.operators.problem.form.factor
    rhs = jnp.sin(jnp.arange(block().size, dtype=float))
    residual = rhs - factor.matrix @ factor.solve(rhs)
    weights = factor.preconditioner
    return float(jnp.sqrt(jnp.sum(weights * residual**2) / jnp.sum(weights * rhs**2)))


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-12])
def test_conjugate_gradient_stops_at_its_tolerance(tolerance):
    # The last iteration reduces the residual by no more than a factor of 100.
    assert 0.01 * tolerance < residual_of_a_solve(tolerance) <= 1.1 * tolerance


def exhausted():
    stepper = steppers()["cg"]
    short = iterate(max_iterations=3)
    # prepare would refuse this solver at once, so the failure is put where values decide it.
    factor = short.factorize(stepper.operators.problem.matrix, block().normals)
    form = replace(stepper.operators.problem.form, factor=factor)
    operators = stepper.operators.changed(lambda _, problem: replace(problem, form=form))
    return replace(stepper, operators=operators)


def test_conjugate_gradient_out_of_iterations_is_an_error():
    with pytest.raises(jc.SolveError, match="non finite"):
        jc.simulate(exhausted(), control(), initial=throw(block()))


def test_conjugate_gradient_out_of_iterations_is_non_finite_under_jit():
    run = jax.jit(lambda stepper, u: jc.simulate(stepper, u, initial=throw(stepper.system)))
    trajectory = run(exhausted(), control())
    np.testing.assert_array_equal(trajectory.status, jc.Status.NON_FINITE)
    assert np.all(np.isnan(trajectory.displacement[1:]))


def test_conjugate_gradient_out_of_iterations_is_refused_by_prepare():
    with pytest.raises(ValueError, match="positive definite"):
        jc.prepare(block(), DT, linear_solver=iterate(max_iterations=3))


def test_conjugate_gradient_works_in_float32():
    system = block(jnp.float32)
    stepper = jc.prepare(system, DT, linear_solver=iterate())
    single = jc.simulate(stepper, control(jnp.float32), initial=throw(system))
    double = jc.simulate(steppers()["dense"], control(), initial=throw(block()))
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


def test_constraint_holds_to_rounding_after_many_iterations():
    # Cells of 1 to 30: some hundred iterations, in which the projected directions drift.
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / 5)
    flat = mesh.with_points(mesh.points * np.array([1.0, 0.03]))
    plane = jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.6, 0.8]))
    scene = jc.Scene(flat, jc.KelvinVoigt(young=1.0, poisson=0.3), contact={"bottom": plane})
    factor = jc.prepare(
        jc.discretize(scene), 3.0, linear_solver=jc.ConjugateGradient()
    ).operators.problem.form.factor
    pairs = factor.normals.count
    bound, rhs = jnp.linspace(0.0, 1.0, pairs), jnp.sin(jnp.arange(factor.matrix.size, dtype=float))
    active = jnp.arange(pairs) % 2 == 0
    w, _ = factor.solve_constrained(active, rhs, bound)
    missed = jnp.where(active, factor.normals @ w - bound, 0.0)
    assert jnp.max(jnp.abs(missed)) < 1e-14


def test_small_numbers_are_solved_for_in_float32():
    # The squares of these norms are below the smallest number of float32.
    factor = jc.prepare(
        block(jnp.float32), DT, linear_solver=jc.ConjugateGradient()
    ).operators.problem.form.factor
    rhs = jnp.sin(jnp.arange(factor.matrix.size, dtype=jnp.float32))
    unit = jnp.float32(2.0**-80)
    np.testing.assert_array_equal(factor.solve(unit * rhs), unit * factor.solve(rhs))
