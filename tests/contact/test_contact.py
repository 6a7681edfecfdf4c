from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcontact as jc
from jaxcontact.contact import Guess, Status
from jaxcontact.contact.complementarity import solve_compliance

# Both solvers stop at a residual of 1e-11 of the largest violation.
KKT_TOLERANCE = 1e-10
AGREEMENT = 1e-9
N_PAIRS = 6
SOLVERS = [jc.SemismoothNewton(), jc.ProjectedGaussSeidel()]
EXAMPLES = settings(max_examples=30, deadline=None, derandomize=True)

# R of a compliance R R^T and an offset for which the active sets of Newton's method repeat with a
# period; found by a random search.
CYCLING_ROOT = np.array([[0.0, 3.0, 1.0], [3.0, -3.0, -1.0], [1.0, -2.0, -1.0]])
CYCLING_OFFSET = np.array([3.0, -1.0, -2.0])


def solve(solver, compliance, offset, guess=None, resolution=None):
    compliance, offset = jnp.asarray(compliance), jnp.asarray(offset)
    nothing = jnp.zeros(offset.shape, bool)
    return _solve(
        solver,
        compliance,
        offset,
        jnp.zeros_like(offset) if resolution is None else jnp.asarray(resolution),
        nothing if guess is None else jnp.asarray(guess),
    )


@partial(jax.jit, static_argnums=0)
def _solve(solver, compliance, offset, resolution, guess):
    return solver.solve(compliance, offset, resolution, Guess(guess))


def random_problem(seed, coupling, n=N_PAIRS):
    """A random SPD compliance, its condition growing with the coupling, and an offset"""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    compliance = np.eye(n) + coupling * root @ root.T
    scale = np.exp(rng.normal(size=n))
    return scale[:, None] * compliance * scale[None, :], rng.normal(size=n)


def kkt_violation(compliance, offset, p):
    """Sign, non-penetration and complementarity, relative to the largest violation"""
    g = compliance @ p + offset
    size = np.max(np.maximum(-offset, 0.0)) + 1e-100  # its square is a number
    diagonal = np.diagonal(compliance)
    return max(
        np.max(-diagonal * p) / size, np.max(-g) / size, np.max(np.abs(p * g * diagonal)) / size**2
    )


@pytest.mark.parametrize("solver", SOLVERS)
@EXAMPLES
@given(seed=st.integers(0, 10**6), coupling=st.floats(0.0, 3.0), guess=st.integers(0, 2**6 - 1))
def test_contact_solver_satisfies_the_kkt_conditions(solver, seed, coupling, guess):
    compliance, offset = random_problem(seed, coupling)
    bits = (guess >> np.arange(N_PAIRS)) % 2 == 1
    solution = solve(solver, compliance, offset, bits)
    p = np.asarray(solution.multiplier)
    assert int(solution.status) <= Status.FALLBACK
    assert kkt_violation(compliance, offset, p) < KKT_TOLERANCE
    np.testing.assert_array_equal(solution.active, p > 0)  # no weak contact in random problems


@EXAMPLES
@given(seed=st.integers(0, 10**6), coupling=st.floats(0.0, 3.0))
def test_contact_solvers_agree(seed, coupling):
    compliance, offset = random_problem(seed, coupling)
    newton, sweeps = (np.asarray(solve(s, compliance, offset).multiplier) for s in SOLVERS)
    np.testing.assert_allclose(newton, sweeps, atol=AGREEMENT * max(1.0, np.max(newton)))


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("compliance", "offset", "expected"),
    [
        ([[2.0]], [-4.0], [2.0]),
        ([[2.0]], [3.0], [0.0]),
        ([[2.0, 1.0], [1.0, 2.0]], [-3.0, -3.0], [1.0, 1.0]),
        ([[2.0, 1.0], [1.0, 2.0]], [-1.0, 1.0], [0.5, 0.0]),
        # The second pair is pushed into contact by the first.
        ([[2.0, -1.0], [-1.0, 2.0]], [-3.0, 1.0], [5 / 3, 1 / 3]),
        # The second pair is violated by the free motion, but the first one lifts it off.
        ([[2.0, 1.9], [1.9, 2.0]], [-2.0, -1.0], [1.0, 0.0]),
    ],
)
def test_contact_solver_finds_the_solution_by_hand(solver, compliance, offset, expected):
    solution = solve(solver, compliance, offset)
    assert int(solution.status) == Status.CONVERGED
    np.testing.assert_allclose(solution.multiplier, expected, atol=KKT_TOLERANCE)
    np.testing.assert_array_equal(solution.active, np.array(expected) > 0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_contact_solver_counts_weak_contact_as_active(solver):
    # Pair 0 just touches, pair 1 presses, pair 2 just touches because pair 1 presses.
    compliance = [[2.0, 0.0, 0.0], [0.0, 2.0, -1.0], [0.0, -1.0, 2.0]]
    solution = solve(solver, compliance, [0.0, -2.0, 1.0])
    np.testing.assert_allclose(solution.multiplier, [0.0, 1.0, 0.0], atol=KKT_TOLERANCE)
    np.testing.assert_array_equal(solution.active, [True, True, True])


@pytest.mark.parametrize("solver", SOLVERS)
def test_contact_solver_takes_an_offset_below_its_resolution_for_zero(solver):
    solution = solve(solver, np.eye(2), [-1e-12, 1e-12], resolution=[1e-11, 1e-11])
    assert int(solution.status) == Status.CONVERGED
    np.testing.assert_array_equal(solution.active, [True, True])


@pytest.mark.parametrize("solver", SOLVERS)
def test_contact_solver_is_positively_homogeneous(solver):
    compliance, offset = random_problem(3, 1.0)
    p = solve(solver, compliance, offset).multiplier
    for scale in (1e-12, 1e12):
        scaled = solve(solver, compliance, scale * offset).multiplier
        np.testing.assert_allclose(scaled, scale * p, rtol=AGREEMENT)


def test_newton_needs_one_set_if_it_starts_with_the_right_one():
    compliance, offset = random_problem(4, 1.0)
    cold = solve(SOLVERS[0], compliance, offset)
    assert int(cold.iterations) > 1
    warm = solve(SOLVERS[0], compliance, offset, cold.active)
    assert int(warm.iterations) == 1
    np.testing.assert_allclose(warm.multiplier, cold.multiplier, rtol=KKT_TOLERANCE)


def test_newton_on_a_cycle_falls_back_and_still_solves():
    compliance, offset = CYCLING_ROOT @ CYCLING_ROOT.T, CYCLING_OFFSET
    solution = solve(jc.SemismoothNewton(), compliance, offset)
    # The whole budget, and some pairs one at a time.
    assert 30 < int(solution.iterations) < 50
    assert int(solution.status) == Status.FALLBACK
    p = np.asarray(solution.multiplier)
    assert kkt_violation(compliance, offset, p) < KKT_TOLERANCE
    np.testing.assert_allclose(p, [0.0, 0.0, 1 / 3], atol=AGREEMENT)


def test_newton_out_of_steps_falls_back_and_still_solves():
    compliance, offset = random_problem(4, 1.0)
    solution = solve(jc.SemismoothNewton(max_steps=1), compliance, offset)
    assert int(solution.status) == Status.FALLBACK
    assert kkt_violation(compliance, offset, np.asarray(solution.multiplier)) < KKT_TOLERANCE


def test_contact_solver_out_of_budget_says_so():
    compliance, offset = random_problem(4, 1.0)
    solution = solve(jc.ProjectedGaussSeidel(max_sweeps=1), compliance, offset)
    assert int(solution.status) == Status.NOT_CONVERGED
    violation = kkt_violation(compliance, offset, np.asarray(solution.multiplier))
    assert violation > KKT_TOLERANCE
    assert float(solution.residual) > KKT_TOLERANCE


@pytest.mark.parametrize("apart", [0.0, 1e-16, 1e-12, 1e-8])
@pytest.mark.parametrize("solver", SOLVERS)
def test_contact_solver_shares_the_force_of_twin_pairs(solver, apart):
    # Pairs 0 and 1 are one contact but for rounding, 2 leans on both.
    rows = np.array([[1.0, 0.0, 0.0], [1.0, apart, 0.0], [0.5, 0.0, 1.0]])
    compliance, offset = rows @ rows.T, np.array([-1.0, -1.0, -0.2])
    solution = solve(solver, compliance, offset)
    assert int(solution.status) == Status.CONVERGED
    p = np.asarray(solution.multiplier)
    assert kkt_violation(compliance, offset, p) < KKT_TOLERANCE
    np.testing.assert_allclose(rows[:, 0] @ p, 1.0, rtol=1e-7)
    again = solve(solver, compliance, offset, solution.active)
    assert int(again.status) == Status.CONVERGED


def test_newton_solves_what_cycles_for_block_pivoting():
    # Dense random problems without the structure of elasticity: a few of a thousand cycle.
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(3000, 8, 8))
    compliance = jnp.asarray(roots @ roots.swapaxes(1, 2))
    offset = jnp.asarray(rng.normal(size=(3000, 8)))

    def solve_one(compliance, offset):
        nothing = jnp.zeros(8)
        return jc.SemismoothNewton().solve(compliance, offset, nothing, Guess(nothing > 0))

    solutions = jax.jit(jax.vmap(solve_one))(compliance, offset)
    status = np.asarray(solutions.status)
    assert np.all(status <= Status.FALLBACK)
    assert np.any(status == Status.FALLBACK)
    assert np.max(np.asarray(solutions.iterations)) < 60


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", ["compliance", "offset"])
def test_contact_solver_reports_values_that_are_not_finite(solver, bad, place):
    compliance, offset = random_problem(5, 1.0)
    if place == "offset":
        offset[2] = bad
    else:
        compliance[2, 2] = bad
    assert int(solve(solver, compliance, offset).status) == Status.NON_FINITE


@pytest.mark.parametrize("solver", SOLVERS)
def test_contact_solver_in_float32_agrees_with_float64(solver):
    compliance, offset = random_problem(6, 1.0)
    exact = solve(solver, compliance, offset)
    single = solve(solver, compliance.astype(np.float32), offset.astype(np.float32))
    assert single.multiplier.dtype == jnp.float32
    assert int(single.status) == Status.CONVERGED
    # Rounding of the data (6e-8) times the condition number of the problem (about 100).
    size = np.max(exact.multiplier)
    np.testing.assert_allclose(single.multiplier, exact.multiplier, atol=1e-5 * size)
    np.testing.assert_array_equal(single.active, exact.active)


@pytest.mark.parametrize("solver", SOLVERS)
def test_contact_solver_under_vmap_equals_the_loop(solver):
    problems = [random_problem(seed, 1.0) for seed in range(8)]
    compliance, offset = (jnp.asarray(np.stack(x)) for x in zip(*problems, strict=True))
    nothing = jnp.zeros((8, N_PAIRS))
    together = jax.vmap(solver.solve)(compliance, offset, nothing, Guess(nothing > 0))
    for k, problem in enumerate(problems):
        alone = solve(solver, *problem)
        np.testing.assert_allclose(together.multiplier[k], alone.multiplier, atol=KKT_TOLERANCE)
        assert int(together.status[k]) == int(alone.status)
        assert int(together.iterations[k]) == int(alone.iterations)


def test_contact_solver_without_contact_returns_no_force():
    for solver in SOLVERS:
        solution = solve(solver, random_problem(7, 1.0)[0], np.linspace(1.0, 2.0, N_PAIRS))
        assert not np.any(solution.multiplier)
        assert not np.any(solution.active)
        assert float(solution.residual) == 0.0


@pytest.mark.parametrize("softness", [None, np.linspace(0.1, 0.6, N_PAIRS)])
def test_solve_compliance_solves_the_rows_of_the_set(softness):
    compliance, rhs = random_problem(8, 1.0)
    active = np.array([True, False, True, True, False, False])
    soft = np.zeros(N_PAIRS) if softness is None else softness
    found = solve_compliance(
        jnp.asarray(compliance),
        jnp.asarray(active),
        None if softness is None else jnp.asarray(softness),
        jnp.where(active, rhs, 0.0),
    )
    block = (compliance + np.diag(soft))[np.ix_(active, active)]
    np.testing.assert_allclose(found[active], np.linalg.solve(block, rhs[active]), rtol=1e-12)
    assert not np.any(np.asarray(found)[~active])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jc.SemismoothNewton(max_steps=0), "max_steps must be 1 or more, got 0"),
        (lambda: jc.SemismoothNewton(max_sweeps=-1), "max_sweeps must not be negative, got -1"),
        (lambda: jc.ProjectedGaussSeidel(max_sweeps=0), "max_sweeps must be 1 or more, got 0"),
    ],
)
def test_contact_solver_without_an_iteration_is_refused_when_it_is_made(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_semismooth_newton_may_do_without_sweeps():
    assert jc.SemismoothNewton(max_steps=1, max_sweeps=0).max_sweeps == 0
