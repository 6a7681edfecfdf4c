"""Claims about reduced models: same structure, converging accuracy, same uses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.control.inner_product import nodal_norms

#: M-orthonormality and other identities of the projection, relative to one.
ROUNDING = 1e-12


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=15 / 10, gap=0.4, steps=100)


def relative_error(problem, trajectory):
    norms = lambda y: jnp.sum(nodal_norms(problem.system.nodal_mass, y))  # noqa: E731
    difference = trajectory.displacement - problem.target
    return float(jnp.sqrt(norms(difference) / norms(problem.target)))


def run(problem, system):
    stepper = jc.prepare(system, problem.dt)
    return stepper, jc.simulate(stepper, problem.control_scale * problem.reference)


def test_reduce_is_the_galerkin_projection(problem):
    full = problem.system
    reduced = jc.reduce(full, 20)
    V = np.asarray(reduced.basis.vectors)
    A = full.stiffness.to_scipy().toarray()
    np.testing.assert_allclose(reduced.mass.values, np.eye(V.shape[1]), atol=ROUNDING)
    expected = V.T @ A @ V
    np.testing.assert_allclose(
        reduced.stiffness.values, expected, atol=ROUNDING * np.abs(expected).max()
    )
    assert reduced.normals.to_scipy().shape == (reduced.normals.count, reduced.size)
    y = jnp.linspace(0.0, 1.0, V.shape[1])
    np.testing.assert_allclose(reduced.normals @ y, full.normals @ (V @ y), atol=ROUNDING)


def test_reduce_restricts_what_it_lifts(problem):
    reduced = jc.reduce(problem.system, 20)
    q = jnp.cos(jnp.arange(reduced.size, dtype=float))
    np.testing.assert_allclose(reduced.restrict(reduced.lift(q)), q, atol=ROUNDING)


def test_reduce_converges_with_the_number_of_modes(problem):
    errors = []
    for modes in (10, 20, 40, 80):
        _, trajectory = run(problem, jc.reduce(problem.system, modes))
        errors.append(relative_error(problem, trajectory))
    assert np.all(np.diff(errors) < 0.0)
    assert errors[-1] < 3e-3


def test_reduce_needs_the_contact_responses(problem):
    with_responses = run(problem, jc.reduce(problem.system, 30))[1]
    without = run(problem, jc.reduce(problem.system, 41, contact_responses=False))[1]
    assert relative_error(problem, without) > 2.0 * relative_error(problem, with_responses)


def test_reduce_keeps_the_energy_ledger(problem):
    stepper, trajectory = run(problem, jc.reduce(problem.system, 20))
    ledger = jc.energy(stepper, trajectory, problem.control_scale * problem.reference)
    assert np.max(np.abs(ledger.residual)) < 1e-12 * np.max(ledger.total)


def test_reduced_gradient_agrees_with_central_differences(problem):
    stepper = jc.prepare(jc.reduce(problem.system, 20), problem.dt)
    cost = problem.cost()

    def objective(u):
        return cost(jc.simulate(stepper, problem.control_scale * u), u)

    u = 0.7 * problem.reference
    direction = jnp.cos(jnp.arange(u.size, dtype=float)).reshape(u.shape)
    slope = jnp.vdot(jax.grad(objective)(u), direction)
    step = 1e-4
    difference = (objective(u + step * direction) - objective(u - step * direction)) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-7)


def test_reduce_accepts_a_free_body():
    mesh = jc.meshes.rectangle((2.0, 1.0), h=0.25)
    obstacle = jc.HalfSpace(np.array([0.0, -0.1]), np.array([0.0, 1.0]))
    material = jc.KelvinVoigt(young=10.0, poisson=0.3)
    system = jc.discretize(jc.Scene(mesh, material, contact={"bottom": obstacle}))
    reduced = jc.reduce(system, 10)
    frequencies = np.linalg.eigvalsh(reduced.stiffness.values)
    assert np.all(np.abs(frequencies[:3]) < 1e-8 * frequencies[-1])


@pytest.mark.parametrize("modes", [0, 10_000])
def test_reduce_refuses_an_impossible_number_of_modes(problem, modes):
    with pytest.raises(ValueError, match=r"between 1 and n - 1"):
        jc.reduce(problem.system, modes)


def test_reduce_refuses_a_reduced_system(problem):
    with pytest.raises(ValueError, match="reduced already"):
        jc.reduce(jc.reduce(problem.system, 5), 3)


def test_reduced_system_refuses_a_sparse_factorisation(problem):
    with pytest.raises(ValueError, match=r"dense; use linear_solver=jc\.Dense"):
        jc.prepare(jc.reduce(problem.system, 5), 1e-4, linear_solver=jc.NestedDissection())
