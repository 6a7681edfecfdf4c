import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix

# Sums of a few products of numbers of order one: a few units of the last place.
ROUNDING = 1e-13


def random_symmetric(n=7, seed=0, dtype=np.float64):
    """A random symmetric matrix with rows of different lengths, dense and as ELL"""
    rng = np.random.default_rng(seed)
    dense = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.4)
    dense = np.triu(dense, 1) + np.triu(dense, 1).T + np.diag(rng.normal(size=n))
    width = int((dense != 0).sum(axis=1).max())
    values = np.zeros((width, n), dtype)
    columns = np.tile(np.arange(n, dtype=np.int32), (width, 1))
    for row in range(n):
        (where,) = np.nonzero(dense[row])
        values[: where.size, row] = dense[row, where]
        columns[: where.size, row] = where
    assert len(set((dense != 0).sum(axis=1))) > 1  # otherwise nothing is padded
    return dense.astype(dtype), SymmetricMatrix(jnp.asarray(values), jnp.asarray(columns))


def random_normals(seed=0):
    rng = np.random.default_rng(seed)
    unknowns = np.array([[0, 1], [4, 5], [4, 5], [2, 3]], np.int32)
    return ContactNormals(jnp.asarray(rng.normal(size=(4, 2))), jnp.asarray(unknowns))


def test_symmetric_matrix_product_equals_the_dense_one():
    dense, matrix = random_symmetric()
    x = np.random.default_rng(1).normal(size=7)
    np.testing.assert_allclose(matrix @ jnp.asarray(x), dense @ x, atol=ROUNDING)


def test_symmetric_matrix_product_acts_on_columns():
    dense, matrix = random_symmetric()
    x = np.random.default_rng(1).normal(size=(7, 3))
    np.testing.assert_allclose(matrix @ jnp.asarray(x), dense @ x, atol=ROUNDING)


def test_symmetric_matrix_sums_and_multiples_are_entrywise():
    dense, matrix = random_symmetric()
    combined = (matrix + 2.5 * matrix).to_scipy().toarray()
    np.testing.assert_allclose(combined, 3.5 * dense, atol=ROUNDING)


def test_symmetric_matrix_diagonal_skips_the_padding():
    dense, matrix = random_symmetric()
    np.testing.assert_array_equal(matrix.diagonal(), np.diagonal(dense))


def test_symmetric_matrix_to_scipy_is_the_matrix_without_padded_entries():
    dense, matrix = random_symmetric()
    sparse = matrix.to_scipy()
    np.testing.assert_array_equal(sparse.toarray(), dense)
    assert sparse.nnz == np.count_nonzero(dense)


def test_symmetric_matrix_keeps_float32():
    _, matrix = random_symmetric(dtype=np.float32)
    assert (matrix @ jnp.ones(7, jnp.float32)).dtype == jnp.float32


def test_symmetric_matrix_gradient_by_the_vector_is_the_product_itself():
    dense, matrix = random_symmetric()
    x, y = jnp.asarray(np.random.default_rng(2).normal(size=(2, 7)))
    gradient = jax.grad(lambda x: jnp.dot(y, matrix @ x))(x)
    np.testing.assert_allclose(gradient, dense @ np.asarray(y), atol=ROUNDING)


def test_symmetric_matrix_gradient_by_the_vector_scatters_nothing():
    _, matrix = random_symmetric()
    backward = jax.grad(lambda x, m: jnp.sum((m @ x) ** 2))
    assert "scatter" not in str(jax.make_jaxpr(backward)(jnp.ones(7), matrix))


def test_symmetric_matrix_gradient_by_the_entries_lives_on_the_pattern():
    _, matrix = random_symmetric()
    x, y = np.random.default_rng(3).normal(size=(2, 7))

    def product(values):
        return jnp.dot(jnp.asarray(y), SymmetricMatrix(values, matrix.columns) @ jnp.asarray(x))

    expected = y[None, :] * x[np.asarray(matrix.columns)]
    np.testing.assert_allclose(jax.grad(product)(matrix.values), expected, atol=ROUNDING)


def test_symmetric_matrix_jvp_is_the_product_rule():
    _, matrix = random_symmetric()
    _, other = random_symmetric()
    x, x_dot = jnp.asarray(np.random.default_rng(4).normal(size=(2, 7)))
    values_dot = jnp.sin(matrix.values)
    _, tangent = jax.jvp(
        lambda v, x: SymmetricMatrix(v, matrix.columns) @ x,
        (matrix.values, x),
        (values_dot, x_dot),
    )
    expected = matrix @ x_dot + SymmetricMatrix(values_dot, other.columns) @ x
    np.testing.assert_allclose(tangent, expected, atol=ROUNDING)


@pytest.mark.parametrize("mode", ["forward over reverse", "reverse over reverse"])
def test_symmetric_matrix_hessian_of_its_energy_is_the_matrix(mode):
    dense, matrix = random_symmetric()
    outer = {"forward over reverse": jax.jacfwd, "reverse over reverse": jax.jacrev}[mode]
    hessian = outer(jax.grad(lambda x: 0.5 * jnp.dot(x, matrix @ x)))(jnp.ones(7))
    np.testing.assert_allclose(hessian, dense, atol=ROUNDING)


@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
def test_symmetric_matrix_second_derivative_by_entries_and_vector_is_that_of_a_plain_sum(outer):
    _, matrix = random_symmetric()
    x = jnp.linspace(-1.0, 1.0, 7)

    def along_a_curve(product):
        return lambda s: jnp.sum(jnp.tanh(product(s**3 * matrix.values, jnp.sin(s) * x)))

    def plain(values, x):
        return jnp.sum(values * x[matrix.columns], axis=0)

    def ours(values, x):
        return SymmetricMatrix(values, matrix.columns) @ x

    expected = jax.hessian(along_a_curve(plain))(1.3)
    np.testing.assert_allclose(outer(jax.grad(along_a_curve(ours)))(1.3), expected, rtol=ROUNDING)


def test_symmetric_matrix_gradient_by_the_vector_can_be_differentiated_by_the_entries():
    _, matrix = random_symmetric()
    x = jnp.linspace(-1.0, 1.0, 7)

    def energy(values, x):
        return jnp.sum(jnp.tanh(SymmetricMatrix(values, matrix.columns) @ x))

    by_values = jax.jacrev(jax.grad(energy, 1), 0)(matrix.values, x)
    by_x = jax.jacrev(jax.grad(energy, 0), 1)(matrix.values, x)
    np.testing.assert_allclose(by_values, jnp.moveaxis(by_x, -1, 0), atol=ROUNDING)


def test_symmetric_matrix_vmap_over_vectors_and_entries_equals_the_loop():
    _, matrix = random_symmetric()
    values = matrix.values[None] * jnp.arange(1.0, 4.0)[:, None, None]
    x = jnp.asarray(np.random.default_rng(5).normal(size=(3, 7)))

    def gradient(v, x):
        return jax.grad(lambda x: jnp.sum(jnp.sin(SymmetricMatrix(v, matrix.columns) @ x)))(x)

    looped = jnp.stack([gradient(v, row) for v, row in zip(values, x, strict=True)])
    np.testing.assert_allclose(jax.vmap(gradient)(values, x), looped, atol=ROUNDING)


def test_contact_normals_product_equals_the_dense_one():
    normals = random_normals()
    y = np.random.default_rng(6).normal(size=8)
    dense = normals.to_scipy(8).toarray()
    assert dense.shape == (normals.count, 8)
    np.testing.assert_allclose(normals @ jnp.asarray(y), dense @ y, atol=ROUNDING)


def test_contact_normals_transpose_adds_pairs_that_share_a_node():
    normals = random_normals()
    p = np.random.default_rng(7).normal(size=4)
    dense = normals.to_scipy(8).toarray()
    transposed = normals.transposed_product(jnp.asarray(p), 8)
    np.testing.assert_allclose(transposed, dense.T @ p, atol=ROUNDING)


def test_contact_normals_gradient_by_the_vector_is_the_transpose():
    normals = random_normals()
    p = jnp.asarray(np.random.default_rng(8).normal(size=4))
    gradient = jax.grad(lambda y: jnp.dot(p, normals @ y))(jnp.ones(8))
    np.testing.assert_allclose(gradient, normals.transposed_product(p, 8), atol=ROUNDING)


def random_blocks(d, n_nodes=6):
    """A random symmetric matrix of d x d blocks, dense and as ELL; rows of different lengths"""
    pattern, scalar = random_symmetric(n_nodes)
    rng = np.random.default_rng(d)
    dense = rng.normal(size=(n_nodes, d, n_nodes, d)) * (pattern != 0)[:, None, :, None]
    dense = dense + dense.transpose(2, 3, 0, 1)
    columns = np.asarray(scalar.columns)
    values = np.zeros((len(columns), d, n_nodes, d))
    for row in range(n_nodes):
        for slot in range(np.count_nonzero(pattern[row])):
            values[slot, :, row] = dense[row, :, columns[slot, row]].T
    matrix = SymmetricMatrix(jnp.asarray(values.reshape(-1, n_nodes * d)), scalar.columns)
    return dense.reshape(n_nodes * d, n_nodes * d), matrix


@pytest.mark.parametrize("d", [1, 2, 3])
def test_matrix_of_blocks_is_the_dense_one(d):
    dense, matrix = random_blocks(d)
    x = np.random.default_rng(1).normal(size=(6 * d, 4))
    np.testing.assert_allclose(matrix @ jnp.asarray(x[:, 0]), dense @ x[:, 0], atol=ROUNDING)
    np.testing.assert_allclose(matrix @ jnp.asarray(x), dense @ x, atol=ROUNDING)
    many = jax.vmap(lambda x: matrix @ x, in_axes=1, out_axes=1)(jnp.asarray(x))
    np.testing.assert_allclose(many, dense @ x, atol=ROUNDING)
    np.testing.assert_array_equal(matrix.to_dense(), dense)
    np.testing.assert_array_equal(matrix.to_scipy().toarray(), dense)
    np.testing.assert_array_equal(matrix.diagonal(), np.diagonal(dense))


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("r", [None, 2, 6])
def test_gradient_by_the_entries_of_blocks_is_the_outer_product_on_the_pattern(d, r):
    _, matrix = random_blocks(d)
    shape = (6 * d,) if r is None else (6 * d, r)
    x, y = jnp.asarray(np.random.default_rng(2).normal(size=(2, *shape)))

    def product(values):
        return jnp.sum(y * (SymmetricMatrix(values, matrix.columns) @ x))

    def dense_product(values):
        return jnp.sum(y * (SymmetricMatrix(values, matrix.columns).to_dense() @ x))

    np.testing.assert_allclose(
        jax.grad(product)(matrix.values), jax.grad(dense_product)(matrix.values), atol=ROUNDING
    )


@pytest.mark.parametrize("d", [1, 2, 3])
def test_componentwise_matrix_is_the_kronecker_product_with_the_identity(d):
    scalar_dense, scalar = random_symmetric()
    dense, matrix = np.kron(scalar_dense, np.eye(d)), ComponentwiseMatrix(scalar, d)
    x = np.random.default_rng(1).normal(size=(7 * d, 4))
    np.testing.assert_allclose(matrix @ jnp.asarray(x[:, 0]), dense @ x[:, 0], atol=ROUNDING)
    np.testing.assert_allclose(matrix @ jnp.asarray(x), dense @ x, atol=ROUNDING)
    np.testing.assert_array_equal(matrix.to_scipy().toarray(), dense)
    np.testing.assert_array_equal(matrix.diagonal(), np.diagonal(dense))
    np.testing.assert_array_equal((matrix + matrix.expand()).to_dense(), 2.0 * dense)


def test_contact_normals_ask_for_a_size_that_nobody_told():
    with pytest.raises(ValueError, match=r"pass to_scipy\(n\)"):
        random_normals().to_scipy()
