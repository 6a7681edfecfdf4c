"""The trust-region subproblem and Newton-CG."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxcontact as jc
from jaxcontact.control.inner_product import Weighted
from jaxcontact.optimize.trust_region import conjugate_gradient_path

WEIGHTS = np.linspace(0.5, 4.0, 6)


def model(eigenvalues):
    """A Hessian with given eigenvalues in the weighted inner product, and a derivative."""
    rng = np.random.default_rng(3)
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    root = np.sqrt(WEIGHTS)[:, None]
    hessian = root * (basis @ np.diag(eigenvalues) @ basis.T) * root.T
    return jnp.asarray(hessian), jnp.asarray(rng.normal(size=6))


def path_of(hessian, derivative, radius, **options):
    options = {"tolerance": 1e-12, "max_products": 20} | options
    return conjugate_gradient_path(
        derivative, lambda p: hessian @ p, lambda d: d / WEIGHTS, radius=radius, **options
    )


def norm(step):
    return float(jnp.sqrt(jnp.sum(WEIGHTS * step**2)))


def decrease_of(hessian, derivative, step):
    return -float(derivative @ step + 0.5 * step @ hessian @ step)


def test_path_ends_at_the_newton_step_if_the_region_is_large():
    hessian, derivative = model([1, 2, 3, 4, 5, 6])
    step, decrease, is_cut = path_of(hessian, derivative, 1e3).cut(1e3)
    np.testing.assert_allclose(step, -jnp.linalg.solve(hessian, derivative), rtol=1e-9)
    assert decrease == pytest.approx(decrease_of(hessian, derivative, step))
    assert not is_cut


@pytest.mark.parametrize("eigenvalues", [[1, 2, 3, 4, 5, 6], [-2, -1, 1, 2, 3, 4]])
@pytest.mark.parametrize("radius", [0.01, 0.3, 0.6])
def test_path_for_a_smaller_region_is_the_beginning_of_the_same_path(eigenvalues, radius):
    hessian, derivative = model(eigenvalues)
    step, decrease, is_cut = path_of(hessian, derivative, 5.0).cut(radius)
    expected, _, _ = path_of(hessian, derivative, radius).cut(radius)
    np.testing.assert_allclose(step, expected, rtol=1e-12)
    assert is_cut
    assert norm(step) == pytest.approx(radius)
    assert decrease == pytest.approx(decrease_of(hessian, derivative, step))


def test_path_follows_negative_curvature_to_the_boundary():
    hessian, derivative = model([-0.2, 1, 2, 3, 4, 5])
    step, decrease, _ = path_of(hessian, derivative, 100.0).cut(100.0)
    gradient = derivative / WEIGHTS
    curvature = float(gradient @ hessian @ gradient)
    assert curvature > 0.0  # negative curvature is met behind the first segment
    cauchy = -float(derivative @ gradient) / curvature * gradient
    assert norm(step) == pytest.approx(100.0)
    assert decrease > 2.0 * decrease_of(hessian, derivative, cauchy) > 0.0


def test_newton_cg_takes_one_step_on_a_quadratic():
    hessian, derivative = model([1, 2, 3, 4, 5, 6])

    def objective(hessian, derivative, x):
        return derivative @ x + 0.5 * x @ hessian @ x

    method = jc.NewtonCG(forcing=1e-12)
    result = jc.optimize(
        Partial(objective, hessian, derivative),
        jnp.zeros(6),
        method=method,
        inner_product=Weighted(WEIGHTS),
        iterations=1,
    )
    np.testing.assert_allclose(result.control, -jnp.linalg.solve(hessian, derivative), rtol=1e-9)
    assert result.history.hessian_products[-1] <= 7  # one to linearise


def test_newton_cg_converges_superlinearly():
    def objective(x):
        return jnp.sum(jnp.cosh(x - jnp.arange(6.0))) + jnp.sum(x) ** 4 / 50.0

    product = Weighted(WEIGHTS)
    options = {"method": jc.NewtonCG(), "inner_product": product, "tolerance": 1e-13}
    norms = jc.optimize(Partial(objective), jnp.zeros(6), **options).history.gradient_norm
    assert len(norms) < 20
    assert norms[-1] < 1e-3 * norms[-2]


def test_newton_cg_leaves_a_saddle_point():
    def objective(x):
        return 0.25 * x[0] ** 4 - 0.5 * x[0] ** 2 + x[1] ** 2

    start = jnp.array([1e-3, 1.0])
    options = {"method": jc.NewtonCG(), "inner_product": Weighted(jnp.ones(2))}
    result = jc.optimize(Partial(objective), start, iterations=30, **options)
    assert result.value == pytest.approx(-0.25)
