"""The gradient check and the certificate say what is the case."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thrown_bodies import cost, grazing, parameters, stepper_of

import jaxcontact as jc

STEPPER, CONTROL, INITIAL, PLACE = grazing(2)


def weighted(trajectory):
    weight = np.random.default_rng(3).normal(size=trajectory.velocity.shape[1:])
    return jnp.sum(weight * trajectory.velocity[-1])


def simulate(control):
    return jc.simulate(STEPPER, control, initial=INITIAL)


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


def test_check_calls_a_nan_not_finite():
    check = jc.check_gradient(lambda x: jnp.sum(jnp.sqrt(x)), jnp.zeros(2))
    assert check.verdict.startswith("NOT FINITE")
    assert not check.is_right


def test_check_calls_a_gradient_between_the_sides_a_kink():
    check = jc.check_gradient(
        lambda x: jnp.sum(jnp.abs(x - 1.0)) + jnp.sum(x), jnp.ones(1), gradient=jnp.ones(1)
    )
    assert check.verdict.startswith("KINK")


def test_check_at_weak_contact_finds_the_one_sided_derivative():
    check = jc.check_gradient(objective, CONTROL, trajectory=simulate, directions=1)
    assert check.weak_contacts == 1
    assert check.contact_changes == 1
    assert check.verdict.startswith("ONE-SIDED")
    assert np.all(np.max(check.order, axis=1) >= 1.9)
    assert np.all(np.abs(np.min(check.order, axis=1) - 1.0) <= 0.1)


def test_check_of_a_vector_is_refused():
    with pytest.raises(ValueError, match="one scalar"):
        jc.check_gradient(lambda x: x, jnp.ones(2))


def test_report_at_weak_contact_locates_it():
    report = jc.derivative_report(STEPPER, CONTROL, weighted, initial=INITIAL)
    step, pair = PLACE
    np.testing.assert_array_equal(report.weak, [[step, STEPPER.system.contact_nodes[pair]]])
    assert not report.is_differentiable
    assert report.margin == 0.0
    assert report.forward_residual <= 1e-11
    assert report.adjoint_residual <= 1e-12
    assert report.duality_gap <= 1e-13


@pytest.mark.parametrize("factor", [1.0, -1.0])
def test_report_signs_tell_a_valley_from_a_ridge(factor):
    def signed(trajectory):
        return factor * weighted(trajectory)

    report = jc.derivative_report(STEPPER, CONTROL, signed, initial=INITIAL)
    direction = jnp.asarray(np.random.default_rng(0).normal(size=CONTROL.shape))

    def one_sided(sign):
        choice = jc.CriticalCone()

        def value(u):
            return signed(jc.simulate(STEPPER, u, initial=INITIAL, weak_contact=choice))

        return float(jax.jvp(value, (CONTROL,), (sign * direction,))[1])

    # J'(d) + J'(-d) is positive across a valley.
    is_valley = one_sided(1.0) + one_sided(-1.0) > 0.0
    assert report.has_right_signs == is_valley
    assert ("ridge" in str(report)) == (not is_valley)


def test_report_away_from_weak_contact_measures_the_margin():
    values = parameters(2)
    initial = jc.State(values["displacement"], values["velocity"])
    stepper = stepper_of(2, values)
    report = jc.derivative_report(stepper, values["control"], cost, initial=initial)
    trajectory = jc.simulate(stepper, values["control"], initial=initial)
    gap, impulse = np.asarray(trajectory.gap[1:]), np.asarray(trajectory.contact_impulse)
    margins = np.maximum(gap / gap.max(), impulse / impulse.max())
    assert report.is_differentiable
    assert report.margin == pytest.approx(margins.min())
    assert report.duality_gap <= 1e-13
    wide = jc.derivative_report(
        stepper, values["control"], cost, initial=initial, tolerance=1.01 * report.margin
    )
    assert len(wide.nearly_weak) == 1
