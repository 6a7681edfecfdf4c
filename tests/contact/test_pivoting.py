"""The compliance solved for a set of pairs: exchanged, refined, made anew when worn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcontact as jc
from jaxcontact.contact import Guess, Status, pivoting

N_PAIRS = 7
SETS = st.lists(st.integers(0, 2**N_PAIRS - 1), min_size=1, max_size=12)
pivot = jax.jit(pivoting.pivot)
solve = jax.jit(pivoting.solve)


def compliance_of(seed, stiffest=1e4):
    """SPD with pairs of very different stiffness."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((N_PAIRS, N_PAIRS))
    scale = np.geomspace(1.0, stiffest, N_PAIRS) ** -0.5
    return jnp.asarray(scale[:, None] * (A @ A.T + N_PAIRS * np.eye(N_PAIRS)) * scale)


def pairs_of(bits):
    return jnp.asarray((bits >> np.arange(N_PAIRS)) % 2 == 1)


def expected_transform(W, pairs):
    W, A = np.asarray(W), np.flatnonzero(np.asarray(pairs))
    B = np.setdiff1d(np.arange(N_PAIRS), A)
    inverse = np.linalg.inv(W[np.ix_(A, A)])
    S = np.zeros_like(W)
    S[np.ix_(A, A)] = -inverse
    S[np.ix_(A, B)] = inverse @ W[np.ix_(A, B)]
    S[np.ix_(B, A)] = S[np.ix_(A, B)].T
    S[np.ix_(B, B)] = W[np.ix_(B, B)] - W[np.ix_(B, A)] @ S[np.ix_(A, B)]
    return S


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), sets=SETS)
def test_exchanges_and_factorisations_give_the_principal_pivot_transform(seed, sets):
    W = compliance_of(seed)
    pivoted = pivoting.unpivoted(W)
    for bits in sets:
        pairs = pairs_of(bits)
        pivoted = pivot(pivoted, W, pairs)
        size = np.sqrt(np.abs(np.diag(pivoted.matrix)))
        error = (pivoted.matrix - expected_transform(W, pairs)) / np.outer(size, size)
        assert np.array_equal(pivoted.pairs, pairs)
        # The transform is that of W with the shift 1.6e-10; solutions are refined.
        assert np.max(np.abs(error)) < 1e-9


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), sets=SETS)
def test_the_solution_on_a_set_is_exact_to_rounding(seed, sets):
    W = compliance_of(seed)
    q = jnp.asarray(np.random.default_rng(seed + 1).standard_normal(N_PAIRS))
    pivoted = pivoting.unpivoted(W)
    for bits in sets:
        pairs = pairs_of(bits)
        pivoted = pivot(pivoted, W, pairs)
        p, pivoted = solve(pivoted, W, q)
        A = np.asarray(pairs)
        assert np.all(np.asarray(p)[~A] == 0.0)
        size = 1.0 + np.max(np.abs(np.diag(W) * p))
        assert np.max(np.abs(W @ p + q)[A], initial=0.0) < 1e-14 * size


def test_one_pair_more_is_an_exchange_and_many_are_a_factorisation():
    W = compliance_of(0)
    one = pivot(pivoting.unpivoted(W), W, pairs_of(0b1))
    assert one.exchanges == 1
    assert pivot(one, W, pairs_of(0b1)).exchanges == 1
    assert pivot(one, W, pairs_of(0b1111111)).exchanges == 0


@pytest.mark.parametrize(("n_due", "is_nested"), [(0, False), (1, False), (20, False), (5, True)])
@pytest.mark.parametrize("own_compliance", [False, True])
def test_a_batch_is_what_each_of_its_scenes_is(n_due, own_compliance, is_nested):
    n = 20
    W = jnp.stack([compliance_of(seed if own_compliance else 0) for seed in range(n)])
    start = jax.lax.map(lambda w: pivoting.pivot(pivoting.unpivoted(w), w, pairs_of(0b1)), W)
    due = np.random.default_rng(0).permutation(n) < n_due
    far, near = pairs_of(0b1101001), pairs_of(0b1001)
    pairs = jnp.stack([far if is_far else near for is_far in due])
    expected = jax.lax.map(lambda x: pivoting.pivot(*x), (start, W, pairs))

    batched, axes = pivoting.pivot, (0, 0 if own_compliance else None, 0)
    if is_nested:
        start, pairs = jax.tree.map(lambda x: x.reshape(4, 5, *x.shape[1:]), (start, pairs))
        W = W.reshape(4, 5, *W.shape[1:])
        batched = jax.vmap(batched, in_axes=axes)
    W = W if own_compliance else compliance_of(0)
    result = jax.jit(jax.vmap(batched, in_axes=axes))(start, W, pairs)
    result = jax.tree.map(lambda x, like: x.reshape(like.shape), result, expected)
    assert np.sum(expected.exchanges == 0) == n_due
    np.testing.assert_array_equal(result.exchanges, expected.exchanges)
    np.testing.assert_array_equal(result.pairs, expected.pairs)
    scale = np.abs(expected.matrix).max(axis=(1, 2), keepdims=True)
    assert np.max(np.abs(result.matrix - expected.matrix) / scale) < 1e-14


def test_a_worn_transform_is_noticed_and_made_anew():
    W = compliance_of(0)
    pairs = pairs_of(0b1011)
    kept = pivot(pivot(pivoting.unpivoted(W), W, pairs_of(0b11)), W, pairs)
    assert kept.exchanges > 0
    q = -jnp.diag(W)
    _, fine = solve(kept, W, q)
    assert fine.exchanges == kept.exchanges
    _, worn = solve(kept._replace(matrix=kept.matrix * (1.0 + 1e-6)), W, q)
    assert worn.exchanges == pivoting.WORN
    assert pivot(worn, W, pairs).exchanges == 0


@pytest.mark.parametrize("noise", [1e-12, 1e-6, 1e-2, np.nan])
def test_newton_solves_whatever_became_of_the_kept_transform(noise):
    W = compliance_of(3)
    solver = jc.SemismoothNewton()
    q = jnp.asarray(np.random.default_rng(3).standard_normal(N_PAIRS))
    nothing = jnp.zeros(N_PAIRS)
    right = solver.solve(W, q, nothing, Guess(pairs_of(0)))
    kept = right.workspace
    assert 0 < np.count_nonzero(right.active) < N_PAIRS
    spoilt = kept._replace(matrix=kept.matrix * (1.0 + noise), exchanges=jnp.int32(1))
    again = solver.solve(W, q, nothing, Guess(right.active, spoilt))
    assert again.status == Status.CONVERGED
    np.testing.assert_allclose(again.multiplier, right.multiplier, rtol=1e-12)
