"""Claims about reduced models: same structure, converging accuracy, same uses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.sparse.linalg import spsolve

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
    gram = V.T @ (full.mass.to_scipy() @ V)
    np.testing.assert_allclose(reduced.mass.to_scipy().toarray(), gram, atol=ROUNDING)
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
    for modes in (10, 30, 80):
        _, trajectory = run(problem, jc.reduce(problem.system, modes))
        errors.append(relative_error(problem, trajectory))
    assert np.all(np.diff(errors) < 0.0)
    assert errors[-1] < 3e-3


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


def outside(reduced, vector):
    """Part of free components (n_full,) outside of the reduced space in the M norm, relative"""
    V, M = np.asarray(reduced.basis.vectors), reduced.basis.mass.to_scipy()
    left = vector - V @ (V.T @ (M @ vector))
    return np.sqrt((left @ (M @ left)) / (vector @ (M @ vector)))


def static_response(system, load):
    return spsolve(system.stiffness.to_scipy().tocsc(), np.asarray(load))


def test_reduce_holds_the_responses_to_contact_and_to_loads(problem):
    full = problem.system
    pattern = problem.reference[0]
    reduced = jc.reduce(full, 15, loads=[pattern])
    push = full.normals.to_scipy().toarray()[3]
    assert outside(reduced, static_response(full, push)) < 1e-10
    assert outside(reduced, static_response(full, full.control_load(pattern))) < 1e-10
    assert reduced.size == 15 + full.normals.count + 1
    unknown = jc.reduce(full, 15)
    assert outside(unknown, static_response(full, full.control_load(pattern))) > 1e-4


def compliance(system, dt):
    """N D^-1 N^T of a step, (C, C)"""
    M, A, B, N = (
        x.to_scipy().toarray()
        for x in (system.mass, system.stiffness, system.viscosity, system.normals)
    )
    return N @ np.linalg.solve(M + 0.5 * dt * B + 0.25 * dt**2 * A, N.T)


def test_reduce_with_step_responses_has_the_compliance_of_the_full_system(problem):
    full, dt = problem.system, problem.dt
    expected = compliance(full, dt)
    stepped, static = (
        np.max(np.abs(compliance(jc.reduce(full, 15, step_responses=x), dt) - expected))
        for x in (dt, None)
    )
    assert stepped < 1e-10 * np.max(expected)
    assert static > 0.1 * np.max(expected)


def test_reduce_by_frequency_takes_all_vibrations_below(problem):
    full = problem.system
    squares = scipy.linalg.eigh(
        full.stiffness.to_scipy().toarray(), full.mass.to_scipy().toarray(), eigvals_only=True
    )
    frequencies = np.sqrt(squares) / (2.0 * np.pi)
    limit = 0.5 * (frequencies[39] + frequencies[40])
    by_frequency = jc.reduce(full, frequency=limit)
    np.testing.assert_allclose(
        by_frequency.basis.vectors, jc.reduce(full, 40).basis.vectors, atol=1e-6
    )


def test_reduce_by_tolerance_takes_more_modes_for_less_error(problem):
    loose, tight = (
        jc.reduce(problem.system, tolerance=tolerance, loads=[problem.reference[0]])
        for tolerance in (0.1, 0.01)
    )
    assert loose.size < tight.size
    assert relative_error(problem, run(problem, tight)[1]) < 0.01


def test_reduce_learns_from_trajectories(problem):
    full = jc.simulate(problem.stepper, problem.control_scale * problem.reference)
    learned = jc.reduce(problem.system, 20, training=[full])
    plain = jc.reduce(problem.system, 20)
    assert learned.size == plain.size
    errors = [relative_error(problem, run(problem, x)[1]) for x in (learned, plain)]
    assert errors[0] < 0.2 * errors[1]


def test_reduce_stays_concrete_under_jit(problem):
    @jax.jit
    def final(control):
        stepper = jc.prepare(jc.reduce(problem.system, 5), problem.dt)
        return jc.simulate(stepper, control).final.displacement

    control = problem.control_scale * problem.reference[:3]
    expected = jc.simulate(jc.prepare(jc.reduce(problem.system, 5), problem.dt), control)
    np.testing.assert_allclose(final(control), expected.final.displacement, atol=1e-12)


def test_reduce_refuses_traced_matrices(problem):
    with pytest.raises(ValueError, match="concrete matrices"):
        jax.jit(lambda system: jc.reduce(system, 5).load)(problem.system)


def test_reduced_motion_starts_from_an_admissible_state_of_the_full_model(problem):
    """The projection of a state in contact penetrates: the nearest one that does not is taken"""
    motion = jc.simulate(problem.stepper, problem.control_scale * problem.reference)
    reduced = jc.reduce(problem.system, 20)
    unknowns = np.asarray(reduced.restrict(motion.displacement))
    gaps = np.asarray(reduced.gap) - unknowns @ np.asarray(reduced.normals.weights).T
    level = int(np.argmin(np.min(gaps, axis=1)))
    assert np.min(gaps) < -1e-2
    start = jc.State(motion.displacement[level], motion.velocity[level])
    trajectory = jc.simulate(jc.prepare(reduced, problem.dt), steps=2, initial=start)
    assert np.min(trajectory.gap) > -1e-10
    difference = trajectory.displacement[0] - start.displacement
    assert np.max(np.abs(difference)) < 0.05 * np.max(np.abs(start.displacement))
    deeper = jc.State(1.05 * start.displacement, start.velocity)
    with pytest.raises(ValueError, match="penetrates the obstacle"):
        jc.simulate(jc.prepare(reduced, problem.dt), steps=2, initial=deeper)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "one of modes, frequency and tolerance"),
        ({"modes": 3, "tolerance": 0.1}, "one of modes, frequency and tolerance"),
        ({"modes": 2.5}, "between 1 and n - 1"),
        ({"frequency": -1.0}, "frequency must be positive"),
        ({"tolerance": 2.0}, "tolerance must lie between"),
        ({"modes": 3, "step_responses": 0.0}, "time step in seconds"),
        ({"modes": 3, "loads": np.zeros((4, 2))}, r"write loads=\[pattern\]"),
        ({"modes": 3, "pairs": [99]}, "numbers from 0 to"),
    ],
)
def test_reduce_says_what_is_wrong(problem, options, message):
    with pytest.raises(ValueError, match=message):
        jc.reduce(problem.system, **options)


@pytest.mark.parametrize("modes", [0, 10_000])
def test_reduce_refuses_an_impossible_number_of_modes(problem, modes):
    with pytest.raises(ValueError, match=r"between 1 and n - 1"):
        jc.reduce(problem.system, modes)


def test_reduce_refuses_a_reduced_system(problem):
    with pytest.raises(ValueError, match="reduced already"):
        jc.reduce(jc.reduce(problem.system, 5), 3)


@pytest.mark.parametrize("solver", [jc.NestedDissection(), jc.ConjugateGradient()])
def test_reduced_system_refuses_a_sparse_solver(problem, solver):
    with pytest.raises(ValueError, match=r"dense; use linear_solver=jc\.Dense"):
        jc.prepare(jc.reduce(problem.system, 5), 1e-4, linear_solver=solver)


def test_reduced_system_says_why_its_mass_cannot_be_moved(problem):
    with pytest.raises(ValueError, match=r"belong to no node; use jc\.ContactStabilized"):
        jc.prepare(jc.reduce(problem.system, 5), 1e-4, scheme=jc.RedistributedMass())


@pytest.mark.parametrize("is_reduced", [False, True])
def test_a_saved_system_is_the_same(problem, tmp_path, is_reduced):
    system = problem.system.with_pairs(np.arange(2, 9))
    system = jc.reduce(system, 5) if is_reduced else system
    system.save(tmp_path / "system.npz")
    loaded = jc.load_system(tmp_path / "system.npz")
    assert jax.tree.structure(loaded) == jax.tree.structure(system)
    jax.tree.map(np.testing.assert_array_equal, loaded, system)


def test_load_system_refuses_another_file(tmp_path):
    np.savez(tmp_path / "other.npz", values=np.zeros(3))
    with pytest.raises(ValueError, match="cannot be read as a saved System"):
        jc.load_system(tmp_path / "other.npz")
