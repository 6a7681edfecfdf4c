"""The gradient check and the certificate say what is the case."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.thrown_bodies import cost, grazing, thrown, value_and_gradient

import jaxcontact as jc


def weighted(trajectory):
    weight = np.random.default_rng(3).normal(size=trajectory.velocity.shape[1:])
    return jnp.sum(weight * trajectory.velocity[-1])


def simulate(control):
    stepper, _, initial, _ = grazing(2)
    return jc.simulate(stepper, control, initial=initial)


def report_at_weak_contact(cost):
    stepper, control, initial, _ = grazing(2)
    return jc.derivative_report(stepper, control, cost, initial=initial)


def objective(control):
    return weighted(simulate(control))


def test_check_calls_a_right_gradient_right():
    check = jc.check_gradient(lambda x: jnp.sum(jnp.sin(x)), jnp.arange(1.0, 5.0))
    assert check.is_right
    np.testing.assert_allclose(check.order, 2.0, atol=0.1)
    assert np.max(check.central_relative_error) <= 1e-8
    assert str(check).endswith(check.verdict)
    assert check.verdict.startswith("RIGHT")


def test_check_calls_a_wrong_gradient_wrong():
    u = jnp.arange(1.0, 5.0)
    check = jc.check_gradient(lambda x: jnp.sum(jnp.sin(x)), u, gradient=1.001 * jnp.cos(u))
    assert not check.is_right
    assert check.verdict.startswith("WRONG")


def test_check_calls_a_missing_dependence_wrong():
    def forgetful(x):
        return jnp.sum(x**2) + jax.lax.stop_gradient(jnp.sum(x**3))

    assert jc.check_gradient(forgetful, jnp.ones(3)).verdict.startswith("WRONG")


def test_check_calls_an_affine_objective_exact():
    check = jc.check_gradient(lambda x: 3.0 * x[0] - x[1] + 7.0, jnp.array([2.0, 5.0]))
    assert np.all(np.isinf(check.order))
    assert check.verdict.startswith("RIGHT")


def test_check_calls_a_constant_objective_constant():
    assert jc.check_gradient(lambda x: jnp.array(3.0), jnp.ones(3)).verdict.startswith("CONSTANT")


def test_check_calls_a_hidden_dependence_wrong():
    # The gradient is zero, the objective is not constant.
    check = jc.check_gradient(lambda x: jax.lax.stop_gradient(jnp.sum(x**2)), jnp.ones(3))
    assert check.verdict.startswith("WRONG")


@pytest.mark.parametrize(
    ("place", "claim"),
    [(0.0, "finite at u, its gradient is not"), (-1.0, "not finite at u"), (1e-5, "near u")],
)
def test_check_calls_a_nan_not_finite_and_says_where(place, claim):
    check = jc.check_gradient(lambda x: jnp.sum(jnp.sqrt(x)), jnp.full(2, place), step=2.0)
    assert check.verdict.startswith("NOT FINITE")
    assert claim in check.verdict
    assert not check.is_right


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_check_is_undecided_where_rounding_hides_the_gradient(dtype):
    u = jnp.arange(1.0, 5.0, dtype=dtype)
    offset = 1e3 / jnp.finfo(dtype).eps

    def objective(x):
        return (offset + jnp.sum(jnp.sin(x))).astype(dtype)

    for sign in (1.0, -1.0):
        check = jc.check_gradient(objective, u, gradient=sign * jnp.cos(u))
        assert check.verdict.startswith("UNDECIDED"), check
        assert not check.is_right


def test_check_in_single_precision_says_how_far_the_gradient_is_confirmed():
    u = jnp.arange(1.0, 5.0, dtype=jnp.float32)
    check = jc.check_gradient(lambda x: jnp.sum(jnp.sin(x)), u)
    assert check.is_right
    assert np.all((check.resolution > 1e-4) & (check.resolution < 0.1))
    wrong = 1.0 + 2.0 * float(np.max(check.resolution))
    check = jc.check_gradient(lambda x: jnp.sum(jnp.sin(x)), u, gradient=wrong * jnp.cos(u))
    assert not check.is_right


def test_check_calls_a_jump_a_jump():
    check = jc.check_gradient(lambda x: jnp.sum(jnp.floor(x) + x), jnp.arange(1.0, 5.0))
    assert check.verdict.startswith("JUMP")


def test_check_moves_every_array_by_its_own_size():
    # Along one direction of unit length in the moduli, the ratio would move by 1e5.
    u = {"young": jnp.array(1e8), "poisson": jnp.array(0.3)}
    gradient = {"young": jnp.cos(1.0) / 1e8, "poisson": jnp.array(0.0)}

    def objective(u):
        return jnp.sin(u["young"] / 1e8) + jnp.sin(u["poisson"])

    assert jc.check_gradient(objective, u).verdict.startswith("RIGHT")
    assert jc.check_gradient(objective, u, gradient=gradient).verdict.startswith("WRONG")


def test_check_of_a_gradient_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="shaped like u"):
        jc.check_gradient(lambda x: jnp.sum(x), jnp.ones(2), gradient=jnp.ones(3))


def test_check_calls_a_gradient_between_the_sides_a_kink():
    check = jc.check_gradient(
        lambda x: jnp.sum(jnp.abs(x - 1.0)) + jnp.sum(x), jnp.ones(1), gradient=jnp.ones(1)
    )
    assert check.verdict.startswith("KINK")


def test_check_says_that_a_kink_is_in_the_cost_if_no_contact_is_weak():
    stepper, control, initial = thrown()

    def motion(u):
        return jc.simulate(stepper, u, initial=initial)

    value, (slope, _) = value_and_gradient(stepper, control, initial)

    def kinked(u):
        return jnp.abs(cost(motion(u)) - value)

    half = 0.5 * slope
    check = jc.check_gradient(kinked, control, gradient=half, trajectory=motion, directions=0)
    assert check.verdict.startswith("KINK")
    assert "the kink is in the cost" in check.verdict


def test_check_at_weak_contact_finds_the_one_sided_derivative():
    check = jc.check_gradient(objective, grazing(2)[1], trajectory=simulate, directions=1)
    assert check.weak_contacts == 1
    assert check.contact_changes == 1
    assert check.verdict.startswith("ONE-SIDED")
    assert np.all(np.max(check.order, axis=1) >= 1.9)
    assert np.all(np.abs(np.min(check.order, axis=1) - 1.0) <= 0.1)


def test_check_of_a_vector_is_refused():
    with pytest.raises(ValueError, match="one scalar"):
        jc.check_gradient(lambda x: x, jnp.ones(2))


def test_report_at_weak_contact_locates_it():
    report = report_at_weak_contact(weighted)
    stepper, _, _, (step, pair) = grazing(2)
    np.testing.assert_array_equal(report.weak, [[step, stepper.system.contact_nodes[pair]]])
    assert not report.is_differentiable
    assert report.margin == 0.0
    assert report.forward_residual <= 1e-11
    assert report.adjoint_residual <= 1e-12
    assert report.duality_gap <= 1e-13


@pytest.mark.parametrize("factor", [1.0, -1.0])
@pytest.mark.parametrize(
    "scheme",
    [jc.ContactImplicit(), jc.ContactStabilized()],
    ids=["end of the step", "predictor"],
)
def test_report_signs_tell_a_valley_from_a_ridge(factor, scheme):
    stepper, control, initial, _ = grazing(2, scheme)

    def signed(trajectory):
        return factor * weighted(trajectory)

    report = jc.derivative_report(stepper, control, signed, initial=initial)
    assert not report.is_differentiable
    direction = jnp.asarray(np.random.default_rng(0).normal(size=control.shape))

    def one_sided(sign):
        tangent = jc.directional_derivative(stepper, control, sign * direction, initial=initial)
        return float(signed(tangent))  # the cost is linear

    # J'(d) + J'(-d) is positive across a valley.
    is_valley = one_sided(1.0) + one_sided(-1.0) > 0.0
    assert report.has_right_signs == is_valley
    assert ("ridge" in str(report)) == (not is_valley)


def test_report_of_a_nan_cost_says_so():
    def broken(trajectory):
        return jnp.sqrt(-jnp.sum(trajectory.velocity**2))

    report = report_at_weak_contact(broken)
    assert str(report).startswith("NOT FINITE")


def test_report_of_modes_that_differ_says_wrong():
    @jax.custom_jvp
    def halved(x):
        return x

    # A wrong rule: forward mode passes the tangent on, reverse mode returns half the cotangent.
    halved.defjvp(
        lambda p, t: (
            p[0],
            jax.lax.custom_linear_solve(
                lambda x: 2.0 * x, t[0], lambda _, b: b, transpose_solve=lambda _, b: 0.5 * b
            ),
        )
    )

    report = report_at_weak_contact(lambda trajectory: halved(weighted(trajectory)))
    assert "WRONG" in str(report)


def test_report_away_from_weak_contact_measures_the_margin():
    stepper, control, initial = thrown()
    report = jc.derivative_report(stepper, control, weighted, initial=initial)
    trajectory = jc.simulate(stepper, control, initial=initial)
    # The multiplier is half the impulse; its size is at least the momentum of the heaviest node.
    gap, multiplier = np.asarray(trajectory.gap), np.asarray(trajectory.contact_impulse) / 2
    momentum = stepper.system.mass.to_scipy().diagonal().max() * np.abs(trajectory.velocity).max()
    size = max(multiplier.max(), momentum)
    margins = np.maximum(gap[1:] / gap.max(), multiplier / size)
    assert report.is_differentiable
    assert report.margin == pytest.approx(margins.min())
    assert report.duality_gap <= 1e-13
    wide = jc.derivative_report(
        stepper, control, weighted, initial=initial, tolerance=1.01 * report.margin
    )
    assert len(wide.nearly_weak) == 1
