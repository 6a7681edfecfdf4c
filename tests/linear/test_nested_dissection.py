"""Claims about the nested-dissection factor: it agrees with a sparse direct solver on any graph."""

import itertools
from collections import OrderedDict
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from jaxcontact.linear.dissection import plan as dissection_plan
from jaxcontact.linear.dissection import stages as dissection_stages
from jaxcontact.linear.dissection.nested_dissection import NestedDissection
from jaxcontact.linear.triangular import invert_triangular

# Rounding of a direct solve: a few hundred ulp times a condition number below 1e4.
ROUNDING = 1e-11


def grid(shape):
    """Points and simplices (Kuhn's triangulation) of a box of nodes."""
    d, index = len(shape), np.arange(np.prod(shape)).reshape(shape)
    cells = []
    for permutation in itertools.permutations(range(d)):
        corners = np.concatenate([np.zeros((1, d), int), np.eye(d, dtype=int)[list(permutation)]])
        windows = [
            tuple(slice(o, o + m - 1) for o, m in zip(corner, shape, strict=True))
            for corner in corners.cumsum(0)
        ]
        cells.append(np.stack([index[window].ravel() for window in windows], 1))
    points = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, d)
    return points.astype(float), np.concatenate(cells)


def spd_matrix(n_points, cells, block, cell_weights, seed=0):
    """Assemble random SPD cell matrices, `block` unknowns per node, with a well-posed mass part."""
    rng = np.random.default_rng(seed)
    unknowns = (cells[:, :, None] * block + np.arange(block)).reshape(len(cells), -1)
    size = unknowns.shape[1]
    root = rng.normal(size=(len(cells), size, size))
    local = cell_weights[:, None, None] * (root @ root.swapaxes(1, 2) / size + np.eye(size))
    rows, columns = np.repeat(unknowns, size, 1).ravel(), np.tile(unknowns, (1, size)).ravel()
    n = n_points * block
    return scipy.sparse.coo_array((local.ravel(), (rows, columns)), shape=(n, n)).tocsr()


def padded_rows(matrix, dtype=np.float64):
    """The matrix in padded ELL layout, as the package stores it."""
    matrix.sort_indices()
    n, count = matrix.shape[0], np.diff(matrix.indptr)
    columns = np.tile(np.arange(n, dtype=np.int32), (count.max(), 1))
    values = np.zeros(columns.shape, dtype)
    rows = np.repeat(np.arange(n), count)
    place = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], count)
    columns[place, rows], values[place, rows] = matrix.indices, matrix.data
    return SimpleNamespace(values=jnp.asarray(values), columns=columns)


def normals_of(nodes, block, seed=1, dtype=np.float64):
    unknowns = (np.asarray(nodes, int)[:, None] * block + np.arange(block)).astype(np.int32)
    weights = np.random.default_rng(seed).normal(size=unknowns.shape)
    return SimpleNamespace(weights=jnp.asarray(weights, dtype), unknowns=unknowns)


def dense(normals, n):
    N = np.zeros((len(normals.unknowns), n))
    rows = np.arange(len(N))[:, None]
    np.add.at(N, (rows, normals.unknowns), np.asarray(normals.weights))
    return N


def problem(shape, block, with_points=True, n_contact=None, weights=None):
    """A matrix, its contact rows on the bottom nodes, and coordinates of the unknowns."""
    points, cells = grid(shape)
    weights = np.ones(len(cells)) if weights is None else weights(len(cells))
    matrix = spd_matrix(len(points), cells, block, weights)
    bottom = np.flatnonzero(points[:, -1] == 0)[:n_contact]
    coordinates = np.repeat(points, block, 0) if with_points else None
    return matrix, normals_of(bottom, block), coordinates


def relative_error(value, reference):
    return np.abs(np.asarray(value) - reference).max() / np.abs(reference).max()


def error_of_step(factor, matrix, normals, seed=2):
    """Largest relative error of solve, compliance, condense and expand."""
    n = matrix.shape[0]
    rng = np.random.default_rng(seed)
    rhs, multiplier = rng.normal(size=n), rng.normal(size=len(normals.unknowns))
    N, direct = dense(normals, n), scipy.sparse.linalg.splu(matrix.tocsc())
    partial, free = factor.condense(jnp.asarray(rhs))
    pairs = [
        (factor.solve(jnp.asarray(rhs)), direct.solve(rhs)),
        (factor.compliance, N @ direct.solve(N.T)),
        (free, N @ direct.solve(rhs)),
        (factor.expand(partial, jnp.asarray(multiplier)), direct.solve(rhs - N.T @ multiplier)),
    ]
    return max(relative_error(*pair) for pair in pairs)


@pytest.fixture(autouse=True, params=[True, False], ids=["leaves", "no leaves"])
def with_leaves(request, monkeypatch):
    """Run every test with and without the sparse coupling of the lowest fronts."""
    monkeypatch.setattr(dissection_stages, "COUPLING_COST", -np.inf if request.param else np.inf)
    monkeypatch.setattr(dissection_plan, "_PLANS", OrderedDict())
    return request.param


@pytest.mark.parametrize("with_points", [True, False])
@pytest.mark.parametrize(("shape", "block"), [((300,), 1), ((19, 14), 2), ((6, 7, 5), 3)])
def test_nested_dissection_agrees_with_sparse_direct_solver(shape, block, with_points, with_leaves):
    matrix, normals, coordinates = problem(shape, block, with_points)
    factor = NestedDissection(leaf_size=16).factorize(padded_rows(matrix), normals, coordinates)
    assert (len(factor.leaves) > 0) == with_leaves
    assert len(factor.leaves) + len(factor.stages) > 0
    assert error_of_step(factor, matrix, normals) < ROUNDING


def test_nested_dissection_leaf_size_does_not_change_the_solution(monkeypatch, with_leaves):
    # Cheap launches keep more depths of the tree and more sizes apart.
    monkeypatch.setattr(dissection_stages, "LAUNCH_COST", 1000)
    matrix, normals, coordinates = problem((11, 10), 2)
    for leaf_size in (20, 1000):
        solver = NestedDissection(leaf_size=leaf_size)
        factor = solver.factorize(padded_rows(matrix), normals, coordinates)
        assert bool(factor.leaves) == with_leaves
        assert len(factor.stages) > 0 or leaf_size == 1000
        assert error_of_step(factor, matrix, normals) < ROUNDING


def test_nested_dissection_solves_with_a_batch_of_empty_fronts(monkeypatch, with_leaves):
    # Small parts have nothing left to eliminate; cheap launches put them in a batch of their own.
    monkeypatch.setattr(dissection_stages, "LAUNCH_COST", 500)
    matrix, normals, coordinates = problem((6, 7, 5), 3)
    factor = NestedDissection(leaf_size=16).factorize(padded_rows(matrix), normals, coordinates)
    inverses = [batch.inverse for stage in factor.stages for batch in stage]
    assert with_leaves or any(inverse.size == 0 for inverse in inverses)
    assert error_of_step(factor, matrix, normals) < ROUNDING


def test_nested_dissection_of_less_than_a_leaf_is_one_front():
    matrix, normals, coordinates = problem((3, 3), 2)
    factor = NestedDissection().factorize(padded_rows(matrix), normals, coordinates)
    assert factor.leaves == factor.stages == ()
    assert error_of_step(factor, matrix, normals) < ROUNDING


def test_nested_dissection_without_contact_solves():
    matrix, normals, coordinates = problem((15, 14), 2, n_contact=0)
    factor = NestedDissection(leaf_size=16).factorize(padded_rows(matrix), normals, coordinates)
    rhs = np.random.default_rng(0).normal(size=matrix.shape[0])
    partial, free = factor.condense(jnp.asarray(rhs))
    reference = scipy.sparse.linalg.spsolve(matrix.tocsc(), rhs)
    assert factor.compliance.shape == (0, 0)
    assert free.shape == (0,)
    assert relative_error(factor.expand(partial, jnp.zeros(0)), reference) < ROUNDING


@pytest.mark.parametrize("with_points", [True, False])
def test_nested_dissection_solves_disconnected_graphs(with_points):
    matrix, normals, coordinates = problem((12, 9), 2)
    n = matrix.shape[0]
    matrix = scipy.sparse.block_diag([matrix, 3.0 * matrix, scipy.sparse.eye_array(40)]).tocsr()
    points = np.concatenate([coordinates, coordinates, np.zeros((40, 2))])
    given = points if with_points else None
    factor = NestedDissection(leaf_size=16).factorize(padded_rows(matrix), normals, given)
    assert matrix.shape[0] == 2 * n + 40
    assert error_of_step(factor, matrix, normals) < ROUNDING


def test_nested_dissection_keeps_accuracy_with_stiffness_jumps_and_slivers():
    # Cell weights over four decades, and a random SPD cell stretched by 1e3 per node.
    matrix, normals, coordinates = problem(
        (15, 14), 2, weights=lambda m: 10.0 ** np.random.default_rng(0).uniform(-2, 2, m)
    )
    scale = np.where(np.random.default_rng(1).random(matrix.shape[0]) < 0.5, 1.0, 1e3)
    stretch = scipy.sparse.diags_array(scale)
    matrix = (stretch @ matrix @ stretch).tocsr()
    factor = NestedDissection(leaf_size=16).factorize(padded_rows(matrix), normals, coordinates)
    rhs = scale * np.random.default_rng(2).normal(size=matrix.shape[0])
    y = np.asarray(factor.solve(jnp.asarray(rhs)))
    assert bool(factor.is_positive)
    # Backward error, which does not depend on the conditioning of the matrix.
    assert np.abs((matrix @ y - rhs) / scale).max() < ROUNDING * np.abs(rhs / scale).max()
    assert error_of_step(factor, matrix, normals) < 1e-9  # condition number about 1e10


def test_nested_dissection_contact_rows_may_share_nodes_and_skip_components():
    matrix, _, coordinates = problem((15, 14), 2)
    unknowns = np.array([[0, 1, 28], [28, 2, 29], [57, 28, 0]], np.int32)
    weights = jnp.asarray(np.random.default_rng(3).normal(size=(3, 3)))
    normals = SimpleNamespace(weights=weights, unknowns=unknowns)
    factor = NestedDissection(leaf_size=16).factorize(padded_rows(matrix), normals, coordinates)
    assert error_of_step(factor, matrix, normals) < ROUNDING


def test_nested_dissection_vmap_over_values_equals_loop():
    matrix, normals, coordinates = problem((12, 9), 2)
    padded, solver = padded_rows(matrix), NestedDissection(leaf_size=16)
    rhs = jnp.asarray(np.random.default_rng(0).normal(size=matrix.shape[0]))

    def step(values):
        moved = SimpleNamespace(values=values, columns=padded.columns)
        factor = solver.factorize(moved, normals, coordinates)
        partial, free = factor.condense(rhs)
        return factor.expand(partial, free), factor.compliance

    values = jnp.array([1.0, 2.5])[:, None, None] * padded.values[None]
    together = jax.jit(jax.vmap(step))(values)
    for k, one in enumerate(values):
        for value, reference in zip(together, step(one), strict=True):
            assert relative_error(value[k], np.asarray(reference)) < ROUNDING


def test_nested_dissection_nested_vmap_over_right_hand_sides_equals_loop():
    matrix, normals, coordinates = problem((12, 9), 2)
    factor = NestedDissection(leaf_size=16).factorize(padded_rows(matrix), normals, coordinates)
    rng = np.random.default_rng(0)
    rhs = jnp.asarray(rng.normal(size=(2, 3, matrix.shape[0])))
    multiplier = jnp.asarray(rng.normal(size=(3, len(normals.unknowns))))

    def step(rhs, multiplier):
        partial, free = factor.condense(rhs)
        return factor.solve(rhs), free, factor.expand(partial, multiplier)

    together = jax.vmap(jax.vmap(step), in_axes=(0, None))(rhs, multiplier)
    for i, j in itertools.product(range(2), range(3)):
        single = step(rhs[i, j], multiplier[j])
        for value, reference in zip(together, single, strict=True):
            assert relative_error(value[i, j], np.asarray(reference)) < ROUNDING


def test_nested_dissection_vmap_over_right_hand_sides_multiplies_matrices():
    matrix, normals, coordinates = problem((12, 9), 2)
    factor = NestedDissection(leaf_size=16).factorize(padded_rows(matrix), normals, coordinates)
    batch = jnp.zeros((3, matrix.shape[0]))
    # The batch becomes the last axis once and leaves it once; plain vmap transposes every product.
    jaxpr = str(jax.make_jaxpr(jax.vmap(factor.solve))(batch))
    assert jaxpr.count("transpose[") == 2


def test_nested_dissection_keeps_single_precision():
    matrix, normals, coordinates = problem((19, 14), 2)
    normals = normals_of(normals.unknowns[:, 0] // 2, 2, dtype=np.float32)
    padded = padded_rows(matrix, np.float32)
    factor = NestedDissection(leaf_size=16).factorize(padded, normals, coordinates)
    rhs = np.random.default_rng(0).normal(size=matrix.shape[0])
    y = factor.solve(jnp.asarray(rhs, jnp.float32))
    assert y.dtype == factor.compliance.dtype == jnp.float32
    assert relative_error(y, scipy.sparse.linalg.spsolve(matrix.tocsc(), rhs)) < 1e-4


def test_nested_dissection_refactorised_under_jit_reuses_the_plan(monkeypatch):
    matrix, normals, coordinates = problem((12, 9), 2)
    padded, solver = padded_rows(matrix), NestedDissection(leaf_size=16)
    rhs = jnp.asarray(np.random.default_rng(0).normal(size=matrix.shape[0]))
    expected = solver.factorize(padded, normals, coordinates).solve(rhs)
    monkeypatch.setattr(dissection_plan, "build_plan", None)  # a second symbolic phase would fail

    @jax.jit
    def refactorise_and_solve(values):
        moved = SimpleNamespace(values=values, columns=padded.columns)
        return solver.factorize(moved, normals, coordinates).solve(rhs)

    assert relative_error(refactorise_and_solve(padded.values), np.asarray(expected)) < ROUNDING


def test_nested_dissection_flags_an_indefinite_matrix():
    matrix, normals, coordinates = problem((12, 9), 2)
    solver = NestedDissection(leaf_size=16)
    assert bool(solver.factorize(padded_rows(matrix), normals, coordinates).is_positive)
    for pivot in (0, matrix.shape[0] // 2, matrix.shape[0] - 1):
        flipped = matrix.copy()
        flipped[pivot, pivot] = -1.0
        factor = solver.factorize(padded_rows(flipped), normals, coordinates)
        assert not bool(factor.is_positive)
        assert np.isnan(factor.solve(jnp.ones(matrix.shape[0]))).any()


def test_nested_dissection_refuses_a_traced_pattern():
    matrix, normals, coordinates = problem((3, 3), 2)
    padded = padded_rows(matrix)

    def factorize(columns):
        traced = SimpleNamespace(values=padded.values, columns=columns)
        return NestedDissection().factorize(traced, normals, coordinates).compliance

    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(factorize)(padded.columns)


def test_dissection_plan_of_a_grid_has_fill_of_order_n_log_n():
    entries = {}
    for m in (32, 64):
        matrix, normals, coordinates = problem((m, m), 1, n_contact=0)
        columns = padded_rows(matrix).columns
        plan = dissection_plan.build_plan(columns, normals.unknowns, coordinates, 16)
        entries[m] = plan.n_factor_entries
        # 31/4 n log2 n is the count for the exact nested dissection of a square grid (George 1973).
        assert entries[m] < 7.75 * m**2 * np.log2(m)
        assert dissection_plan.stored_bytes(plan, 8) > 8 * entries[m]
    assert entries[64] < 4 * np.log2(64) / np.log2(32) * 1.1 * entries[32]


@pytest.mark.parametrize("s", [1, 2, 33, 300])
def test_inverse_of_a_triangular_matrix_times_the_matrix_is_the_identity(s):
    L = np.tril(np.random.default_rng(s).normal(size=(2, s, s))) / s
    L += 2.0 * np.eye(s)
    inverse = invert_triangular(jnp.asarray(L))
    np.testing.assert_allclose(inverse @ L, np.broadcast_to(np.eye(s), L.shape), atol=1e-13)
    np.testing.assert_array_equal(np.triu(inverse, 1), 0.0)


@pytest.mark.parametrize("leaf_size", [0, -8, 16.0, "32"])
def test_nested_dissection_refuses_a_leaf_size_that_is_no_positive_integer(leaf_size):
    with pytest.raises(ValueError, match="leaf_size must be a positive integer"):
        NestedDissection(leaf_size=leaf_size)
