from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.kinked import DT, grazing

import jaxcontact as jc
from jaxcontact.contact import Guess

EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True)
N_PAIRS = 7
#: Rounding of W p + q with conditions up to 1e4, relative to its terms.
BALANCE = {"float64": 1e-12, "float32": 2e-5}
#: Central differences with a step of 2e-6, of which curvature and rounding leave six digits.
DIFFERENCES = 1e-6
LAWS = (jc.RelaxedContact, jc.SmoothedContact)
both_laws = pytest.mark.parametrize("law", LAWS)


@partial(jax.jit, static_argnames=("law", "max_steps"))
def solve(law, size, compliance, offset, guess, max_steps=100):
    """The solution with a law of a size: kappa of the relaxed, speed of the smoothed one"""
    nothing = jnp.zeros_like(offset)
    return law(size, max_steps).solve(compliance, offset, nothing, Guess(guess))


def random_problem(seed, coupling):
    """SPD compliance and offset; pairs of very different size, and one far off contact"""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N_PAIRS, N_PAIRS))
    scale = np.exp(2.0 * rng.normal(size=N_PAIRS))
    compliance = scale[:, None] * (np.eye(N_PAIRS) + coupling * root @ root.T) * scale[None, :]
    offset = scale * rng.normal(size=N_PAIRS)
    offset[0] = 1e6 * scale[0]
    return compliance, offset


def size_of(law, compliance, offset):
    """The size at which every pair feels the law, [J] or [m/s]"""
    speed = np.abs(offset[1:])
    if law is jc.SmoothedContact:
        return np.max(speed)
    return np.max(speed**2 / np.diagonal(compliance)[1:])


def separation_by_law(law, size, diagonal, p):
    """g of p by the law, in NumPy"""
    if law is jc.RelaxedContact:
        return size / p
    s = 0.4 * size
    return -s * np.log(-np.expm1(-diagonal * p / s))


@both_laws
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@EXAMPLES
@given(
    seed=st.integers(0, 10**6),
    coupling=st.floats(0.0, 3.0),
    decade=st.floats(-12.0, -2.0),
    guess=st.integers(0, 2**N_PAIRS - 1),
)
def test_smooth_contact_satisfies_its_law_and_the_balance(
    law, dtype, seed, coupling, decade, guess
):
    compliance, offset = random_problem(seed, coupling)
    size = size_of(law, compliance, offset) * 10.0**decade
    bits = (guess >> np.arange(N_PAIRS)) % 2 == 1
    data = (jnp.asarray(compliance, dtype), jnp.asarray(offset, dtype), jnp.asarray(bits))
    solution = solve(law, size, *data)
    assert int(solution.status) == jc.Status.CONVERGED
    p = np.asarray(solution.multiplier, float)
    assert np.all(p >= 0.0)
    # Where the force has died away the law says only that the pair is open.
    is_felt = p > 0.0
    g = separation_by_law(law, size, np.diagonal(compliance)[is_felt], p[is_felt])
    balance = compliance @ p + offset
    size_of_terms = np.abs(compliance) @ p + np.abs(offset)
    assert np.all(balance[~is_felt] > 0.0)
    assert np.max(np.abs(balance[is_felt] - g) / (size_of_terms[is_felt] + g)) < BALANCE[dtype]


def test_relaxed_contact_of_one_pair_solves_a_quadratic_equation():
    # W p^2 + q p = kappa
    for q in (-3.0, 0.0, 5.0):
        data = jnp.array([[2.0]]), jnp.array([q]), jnp.array([False])
        p = solve(jc.RelaxedContact, 0.01, *data).multiplier
        expected = (-q + np.sqrt(q**2 + 4 * 2.0 * 0.01)) / 4.0
        np.testing.assert_allclose(p, expected, rtol=1e-13)


def test_smoothed_contact_of_one_pair_is_the_softplus_of_its_free_velocity():
    for q in (-3.0, 0.0, 5.0):
        data = jnp.array([[2.0]]), jnp.array([q]), jnp.array([False])
        p = solve(jc.SmoothedContact, 1.0, *data).multiplier
        np.testing.assert_allclose(p, 0.4 / 2.0 * np.log1p(np.exp(-q / 0.4)), rtol=1e-13)


def test_relaxed_contact_tends_to_exact_contact_linearly_in_kappa():
    errors = [distance_from_exact(jc.RelaxedContact, share) for share in (1e-6, 1e-8)]
    np.testing.assert_allclose(errors[0] / errors[1], 100.0, rtol=0.1)


def test_smoothed_contact_is_exact_contact_where_no_pair_is_within_its_range():
    assert distance_from_exact(jc.SmoothedContact, 1e-1) > 1e-3
    assert distance_from_exact(jc.SmoothedContact, 1e-4) < 1e-11


def distance_from_exact(law, share):
    """Largest difference of the multipliers, [N s], for a share of the size that all pairs feel"""
    compliance, offset = random_problem(3, 1.0)
    data = (jnp.asarray(compliance), jnp.asarray(offset), jnp.zeros(N_PAIRS, bool))
    exact = jc.SemismoothNewton().solve(data[0], data[1], jnp.zeros(N_PAIRS), Guess(data[2]))
    found = solve(law, share * size_of(law, compliance, offset), *data)
    return np.max(np.abs(found.multiplier - exact.multiplier))


@both_laws
@pytest.mark.parametrize("seed", range(10))
def test_smooth_contact_is_solved_where_pairs_lean_on_each_other(law, seed):
    # Every pair twice, up to rounding, and pressed 1e4 times harder than the law is wide.
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4))
    twice = np.repeat(root @ root.T + 0.1 * np.eye(4), 2, axis=0)
    twice = np.repeat(twice, 2, axis=1) * (1.0 + 1e-9 * np.eye(8))
    offset = -1.0 - np.repeat(rng.random(4), 2) + 1e-4 * rng.random(8)
    size = (1e-4 if law is jc.SmoothedContact else 1e-8) * size_of(law, twice, offset)
    solution = solve(law, size, twice, offset, np.zeros(8, bool))
    p = np.asarray(solution.multiplier)
    assert solution.status == jc.Status.CONVERGED
    # The forces of others may be too small for a number.
    is_felt = p > 0.0
    g = separation_by_law(law, size, np.diagonal(twice)[is_felt], p[is_felt])
    np.testing.assert_allclose((twice @ p + offset)[is_felt], g, atol=1e-9)


@both_laws
def test_smooth_contact_without_enough_steps_ends_as_not_converged(law):
    compliance, offset = random_problem(3, 3.0)
    data = (jnp.asarray(compliance), jnp.asarray(offset), jnp.zeros(N_PAIRS, bool))
    size = 1e-3 * size_of(law, compliance, offset)
    assert int(solve(law, size, *data, max_steps=1).status) == jc.Status.NOT_CONVERGED


@both_laws
@pytest.mark.parametrize("size", [-1.0, 0.0, np.nan, np.inf, jnp.float64(0.0)])
def test_smooth_contact_of_a_wrong_size_raises(law, size):
    solver, message = law(size), r"\.(kappa|speed) must be positive and finite, got .*; exact"
    with pytest.raises(ValueError, match=law.__name__ + message):
        grazing(contact_solver=solver)
    with pytest.raises(ValueError, match=law.__name__ + message):
        jc.with_contact(grazing(), solver)


@both_laws
def test_smooth_contact_without_steps_raises(law):
    with pytest.raises(ValueError, match=law.__name__ + r"\.max_steps must be 1 or more, got 0"):
        grazing(contact_solver=law(1.0, 0))


@both_laws
def test_smooth_contact_of_a_wrong_traced_size_is_not_a_number(law):
    # Far behind the wall: as a closed pair, which alone hides a wrong sign of kappa.
    data = jnp.array([[2.0]]), jnp.array([-3.0]), jnp.array([True])
    for size in (-1e-3, 0.0, np.nan, np.inf):
        solution = solve(law, size, *data)
        assert int(solution.status) == jc.Status.NON_FINITE
        assert np.isnan(solution.multiplier).all()
    assert int(solve(law, 1e-3, *data).status) == jc.Status.CONVERGED


@pytest.mark.parametrize(
    ("scheme", "steps"), [(jc.ContactImplicit(), 2.0), (jc.BackwardEuler(), 1.0)]
)
def test_relaxed_motion_has_impulse_times_gap_kappa_per_step(scheme, steps):
    kappa = 1e-3
    problem = grazing(scheme=scheme, contact_solver=jc.RelaxedContact(kappa))
    trajectory = problem.simulate(jnp.full((20, 2, 1), 10.0))
    product = trajectory.contact_impulse * trajectory.gap[1:]
    np.testing.assert_allclose(product, steps * DT * kappa, rtol=1e-9)


def test_smoothed_motion_has_forces_that_decay_with_the_gap():
    speed = 0.1
    problem = grazing(contact_solver=jc.SmoothedContact(speed))
    trajectory = problem.simulate(jnp.full((20, 2, 1), 10.0))
    s, compliance = 0.4 * speed, np.asarray(problem.stepper.contact_problem.compliance)
    force = np.exp(-compliance * np.asarray(trajectory.contact_impulse) / 2.0 / s)
    gap = np.exp(-trajectory.gap[1:] / (s * DT))
    assert np.min(force) < 0.1  # it touches
    assert np.min(gap) < 0.1  # it is open
    np.testing.assert_allclose(force + gap, 1.0, rtol=1e-9)


@jax.jit
def value(u, problem):
    return problem.objective(u)


@jax.jit
def gradient(u, problem):
    return jax.grad(problem.objective)(u)


@jax.jit
def product(u, problem, direction):
    return jax.jvp(jax.grad(problem.objective), (u,), (direction,))[1]


def disc_with(solver):
    problem = jc.scenes.half_disc_control(h=15.0 / 4, steps=40, dt=1e-4, gap=0.2)
    rng = np.random.default_rng(0)
    u = jnp.asarray(problem.reference + 0.3 * rng.normal(size=problem.reference.shape))
    direction = jnp.asarray(rng.normal(size=u.shape))
    return jc.with_contact(problem, solver), u, direction


@pytest.mark.parametrize(
    "solver", [jc.RelaxedContact(1e6), jc.RelaxedContact(1e2), jc.SmoothedContact(1e3)]
)
def test_smooth_gradient_and_hessian_product_match_differences(solver):
    problem, u, direction = disc_with(solver)
    assert float(jnp.max(problem.simulate(u).contact_impulse)) > 100.0  # there is an impact
    h = 2e-6
    ahead, behind = u + h * direction, u - h * direction
    slope = (value(ahead, problem) - value(behind, problem)) / (2 * h)
    np.testing.assert_allclose(jnp.vdot(gradient(u, problem), direction), slope, rtol=DIFFERENCES)
    change = (gradient(ahead, problem) - gradient(behind, problem)) / (2 * h)
    exact = product(u, problem, direction)
    assert float(jnp.linalg.norm(exact - change) / jnp.linalg.norm(exact)) < DIFFERENCES
    other = jnp.roll(direction, 1)
    np.testing.assert_allclose(
        jnp.vdot(other, exact), jnp.vdot(direction, product(u, problem, other)), rtol=1e-9
    )


def test_relaxed_gradient_does_not_vanish_before_touch():
    def impulse(u, problem):
        return jnp.sum(problem.simulate(u).contact_impulse)

    u = jnp.full((3, 2, 1), 0.5)
    exact = grazing()
    assert float(jnp.min(exact.simulate(u).gap)) > 0.05
    relaxed = jc.with_contact(exact, jc.RelaxedContact(1e-6))
    assert not np.any(jax.grad(impulse)(u, exact))
    assert np.all(jax.grad(impulse)(u, relaxed)[:, 1] > 0.0)  # pushing on raises the impulse


@both_laws
def test_smooth_motion_compiles_once_for_all_sizes(law):
    problem, u = grazing(), jnp.full((3, 2, 1), 10.0)
    before = value._cache_size()
    for size in (1e-2, 1e-5, 1e-9):
        value(u, jc.with_contact(problem, law(size)))
    assert value._cache_size() == before + 1


@both_laws
def test_smooth_motion_maps_over_the_size(law):
    problem, u = grazing(), jnp.full((3, 2, 1), 10.0)
    sizes = jnp.array([1e-2, 1e-5])

    def at(size):
        return jc.with_contact(problem, law(size)).objective(u)

    np.testing.assert_allclose(jax.vmap(at)(sizes), [at(size) for size in sizes], rtol=1e-13)


@both_laws
def test_with_contact_equals_a_new_preparation(law):
    u, solver = jnp.full((3, 2, 1), 10.0), law(1e-3)
    exchanged, prepared = jc.with_contact(grazing(), solver), grazing(contact_solver=solver)
    assert float(exchanged.objective(u)) == float(prepared.objective(u))
    assert exchanged.stepper.contact_solver == solver


def test_with_contact_without_a_stepper_raises():
    with pytest.raises(ValueError, match="no stepper"):
        jc.with_contact(jnp.sum, jc.RelaxedContact(1.0))


@both_laws
def test_smooth_contact_with_conjugate_gradients_raises(law):
    with pytest.raises(ValueError, match=law.__name__ + r".*prepare with contact_solver="):
        grazing(linear_solver=jc.ConjugateGradient(), contact_solver=law(1.0))
