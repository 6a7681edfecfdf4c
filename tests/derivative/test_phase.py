"""Gradients through an impact that converge: smooth laws, the mean over the phases, the warning."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.drops import SPEED, bar, bias_and_spread, dropped_from, final_height, slopes

import jaxcontact as jc
from jaxcontact.contact.closing_speed import closing_speed

LAWS = (jc.RelaxedContact, jc.SmoothedContact)
#: Central differences with the relative step 1e-5.
DIFFERENCE = 1e-6


@pytest.fixture(scope="module")
def drop():
    """The bar of 100 cells, (stepper, steps)"""
    return bar(100)


def with_law(drop, law):
    stepper, steps = drop
    return jc.with_contact(stepper, law.for_scene(stepper)), steps


def test_exact_gradient_through_an_impact_depends_on_the_phase_of_the_touch(drop):
    assert bias_and_spread(*drop)[1] > 0.5


@pytest.mark.parametrize(("law", "bias", "spread"), [(LAWS[0], 0.08, 0.05), (LAWS[1], 0.06, 0.015)])
def test_smooth_gradient_through_an_impact_is_the_exact_one(drop, law, bias, spread):
    found = bias_and_spread(*with_law(drop, law))
    assert abs(found[0]) < bias
    assert found[1] < spread


def test_smoothed_gradient_through_an_impact_converges(drop):
    coarse = bias_and_spread(*with_law(bar(25), jc.SmoothedContact))
    fine = bias_and_spread(*with_law(drop, jc.SmoothedContact))
    assert coarse[0] / fine[0] > 2.2
    assert coarse[1] / fine[1] > 1.5


@pytest.mark.parametrize("scheme", [jc.ContactStabilized(), jc.RedistributedMass()])
def test_smoothed_gradient_is_the_exact_one_with_every_energy_true_scheme(scheme):
    bias, spread = bias_and_spread(*with_law(bar(100, scheme=scheme), jc.SmoothedContact))
    assert abs(bias) < 0.06
    assert spread < 0.015


def test_smoothed_gradient_is_the_exact_one_at_a_small_courant_number():
    bias, spread = bias_and_spread(*with_law(bar(25, courant=0.1), jc.SmoothedContact))
    assert abs(bias) < 0.06
    assert spread < 0.015


def test_smoothed_gradient_is_the_exact_one_on_a_graded_mesh():
    x = 10.0 * np.linspace(0.0, 1.0, 61) ** 1.5
    mesh = jc.meshes.interval(10.0, h=10.0 / 60)
    graded = replace(mesh, points=x[:, None])
    # The smallest cell, at the floor, is a twelfth of the largest: Courant numbers 0.7 to 8.
    bias, spread = bias_and_spread(*with_law(bar(60, mesh=graded), jc.SmoothedContact))
    assert abs(bias) < 0.1
    assert spread < 0.015


def test_smoothed_gradient_in_single_precision_is_that_in_double(drop):
    single, steps = with_law(bar(100, dtype=jnp.float32), jc.SmoothedContact)
    double = slopes(*with_law(drop, jc.SmoothedContact))
    np.testing.assert_allclose(slopes(single, steps), double, rtol=2e-3)


def test_smoothed_gradient_by_start_speed_modulus_and_time_step_matches_differences():
    # Long flights before and after the touch, in which the force of the law underflows.
    def height(parameters, linear_solver):
        higher, speed, young, viscosity, step = parameters
        scene = jc.Scene(
            mesh=jc.meshes.interval(1.0, h=0.025),
            material=jc.KelvinVoigt(young=young, poisson=0.0, bulk_viscosity=viscosity),
            contact={"left": jc.HalfSpace(point=jnp.array([-1.0]), normal=np.array([1.0]))},
        )
        stepper = jc.prepare(jc.discretize(scene), step, linear_solver=linear_solver)
        stepper = jc.with_contact(dropped_from(stepper, higher), jc.SmoothedContact(1.0))
        ones = jnp.ones((41, 1))
        motion = jc.simulate(stepper, steps=250, initial=jc.State(0.0 * ones, -speed * ones))
        return jnp.mean(motion.displacement[-1]) + jnp.mean(motion.velocity[-1] ** 2)

    point = jnp.array([0.1, 1.0, 4.0, 1e-3, 0.0125])
    found = {}
    for solver in (jc.Dense(), jc.NestedDissection()):
        found[solver] = jax.jit(jax.grad(lambda p, s=solver: height(p, s)))(point)
    value = jax.jit(lambda p: height(p, jc.Dense()))
    steps = 1e-5 * point
    differences = [
        (value(point.at[i].add(h)) - value(point.at[i].add(-h))) / (2.0 * h)
        for i, h in enumerate(steps)
    ]
    dense, dissected = found.values()
    np.testing.assert_allclose(dense, differences, rtol=DIFFERENCE)
    np.testing.assert_allclose(dense, dissected, rtol=1e-9)


def test_smoothed_contact_at_rest_keeps_its_distance_and_its_energy():
    stepper, _ = bar(10, bulk_viscosity=300.0)
    # On the floor within the range of the law, whose speed is that of a drop from 0.01 m.
    stepper = dropped_from(stepper, 0.01 - 5.0)
    law = jc.SmoothedContact.for_scene(stepper)
    stepper = jc.with_contact(stepper, law)
    motion = jc.simulate(stepper, steps=4000)
    s = 0.4 * float(law.speed)
    # exp(-d p / s) + exp(-gap / (s dt)) = 1 with the weight times dt / 2 as multiplier p.
    p = 100.0 * float(stepper.dt) / 2.0
    pushed = float(stepper.contact_problem.compliance[0]) * p / s
    expected = -s * float(stepper.dt) * np.log(-np.expm1(-pushed))
    np.testing.assert_allclose(motion.gap[-100:, 0], expected, rtol=1e-6)
    ledger = jc.energy(stepper, motion)
    assert np.max(np.abs(ledger.residual)) < 1e-12 * np.max(ledger.total)


def test_phase_mean_is_the_mean_over_one_period(drop):
    stepper, _ = drop
    objective = jax.tree_util.Partial(partial_height, stepper)
    mean = jc.phase_mean(objective, SPEED, phases=4)
    step = SPEED * float(stepper.dt)
    value, slope = jax.jit(jax.value_and_grad(mean))(0.0)
    each = [
        jax.value_and_grad(partial_height, argnums=1)(dropped_from(stepper, x * step), 0.0)
        for x in (-0.375, -0.125, 0.125, 0.375)
    ]
    np.testing.assert_allclose(value, np.mean([v for v, _ in each]), rtol=1e-12)
    np.testing.assert_allclose(slope, np.mean([g for _, g in each]), rtol=1e-9)


@jax.jit
def partial_height(stepper, higher):
    return final_height(stepper, 720, higher)


def test_phase_mean_finds_the_speed_of_the_free_flight(drop):
    objective = jax.tree_util.Partial(partial_height, drop[0])
    np.testing.assert_allclose(jc.phase_mean(objective).speed, SPEED, rtol=1e-12)


def test_phase_mean_without_stepper_or_phases_raises(drop):
    with pytest.raises(ValueError, match="no stepper"):
        jc.phase_mean(jnp.sum, 1.0)
    with pytest.raises(ValueError, match="phases must be 1 or more"):
        jc.phase_mean(jax.tree_util.Partial(partial_height, drop[0]), phases=0)


def test_check_warns_of_the_phase_and_not_of_a_smoothed_gradient(drop):
    def check(stepper):
        objective = jax.tree_util.Partial(partial_height, stepper)
        return jc.check_gradient(objective, jnp.array(0.1), directions=0, n_steps=3)

    rigid, smooth = check(drop[0]), check(with_law(drop, jc.SmoothedContact)[0])
    assert rigid.closing_speed == smooth.closing_speed == pytest.approx(SPEED)
    assert rigid.phase_spread > 0.5
    assert smooth.phase_spread < 0.02
    assert "PHASE: " in str(rigid)
    assert "SmoothedContact.for_scene(stepper, speed=10)" in str(rigid)
    assert "PHASE: " not in str(smooth)


def test_check_without_a_stepper_or_a_touch_says_nothing_of_the_phase():
    check = jc.check_gradient(lambda x: jnp.sum(x**2), jnp.ones(2), directions=0, n_steps=3)
    assert check.phase_spread is None
    assert "phase" not in str(check)


def test_report_says_how_much_the_derivative_depends_on_the_phase(drop):
    def report(stepper):
        return jc.derivative_report(
            stepper, None, lambda motion: jnp.mean(motion.displacement[-1]), steps=720
        )

    rigid, smooth = report(drop[0]), report(with_law(drop, jc.SmoothedContact)[0])
    assert rigid.closing_speed == pytest.approx(SPEED, rel=0.01)
    assert smooth.closing_speed == pytest.approx(SPEED, rel=0.05)
    assert rigid.phase_spread > 0.5
    assert smooth.phase_spread < 0.05
    assert rigid.distance == 0.0
    assert 1e-6 < smooth.distance < 1e-2
    assert "PHASE: " in str(rigid)
    assert "from the motion of exact contact" in str(smooth)


def test_closing_speed_of_a_motion_is_that_of_the_fall(drop):
    stepper, steps = drop
    motion = jc.simulate(stepper, steps=steps)
    assert float(motion.closing_speed) == pytest.approx(SPEED, rel=0.01)
    assert float(jc.simulate(stepper, steps=8).closing_speed) == 0.0
    with pytest.raises(ValueError, match="save_every=1"):
        _ = jc.simulate(stepper, steps=steps, save_every=2).closing_speed


def thrown(clamped=()):
    scene = jc.Scene(
        mesh=jc.meshes.rectangle((2.0, 1.0), h=0.5),
        material=jc.KelvinVoigt(young=100.0, poisson=0.3, density=2.0),
        clamped=clamped,
        contact={"bottom": jc.HalfSpace(point=np.array([0.0, -0.2]), normal=np.array([0.0, 1.0]))},
        body_force=np.array([3.0, -8.0]),
        traction={"top": np.array([0.0, -2.0])},
    )
    return jc.prepare(jc.discretize(scene), 0.02)


def test_for_scene_finds_the_speed_of_the_free_flight():
    # Load 8 + 2 per mass 2: 5 m/s^2 over 0.2 m.
    stepper = thrown()
    assert float(closing_speed(stepper, None, None)) == pytest.approx(np.sqrt(2.0))
    assert float(jc.SmoothedContact.for_scene(stepper).speed) == pytest.approx(np.sqrt(2.0))
    ones = jnp.ones_like(stepper.system.points)
    initial = jc.State(0.1 * ones, -3.0 * ones)
    expected = np.sqrt(9.0 + 2.0 * 5.0 * 0.3)
    assert float(closing_speed(stepper, initial, None)) == pytest.approx(expected)
    assert float(jc.SmoothedContact.for_scene(stepper, speed=7.0).speed) == 7.0


def test_for_scene_of_a_closed_gap_takes_a_drop_from_the_size_of_the_scene():
    stepper = dropped_from(thrown(), -0.2)
    assert float(closing_speed(stepper, None, None)) == pytest.approx(np.sqrt(2.0 * 5.0 * 2.0))


def test_for_scene_of_relaxed_contact_is_the_energy_that_a_pair_has_within_a_step():
    stepper = thrown()
    mass = np.mean(1.0 / np.diagonal(stepper.contact_problem.form.factor.compliance))
    law = jc.RelaxedContact.for_scene(stepper)
    assert float(law.kappa) == pytest.approx(0.05 * 2.0 * mass)


@pytest.mark.parametrize("law", LAWS)
def test_for_scene_without_a_flight_or_with_a_wrong_speed_raises(law):
    with pytest.raises(ValueError, match=r"give speed=, .* trajectory\.closing_speed"):
        law.for_scene(thrown(clamped=("top",)))
    for speed in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="speed must be positive and finite"):
            law.for_scene(thrown(), speed=speed)


def test_for_scene_under_jit_is_the_same_and_not_a_number_without_a_flight():
    stepper = thrown()

    @jax.jit
    def speed(load):
        moved = replace(stepper, system=replace(stepper.system, load=load))
        return jc.SmoothedContact.for_scene(moved).speed

    np.testing.assert_allclose(speed(stepper.system.load), np.sqrt(2.0))
    assert np.isnan(speed(0.0 * stepper.system.load))
    with pytest.raises(ValueError, match="mesh is traced; give speed="):
        jax.jit(jc.SmoothedContact.for_scene)(stepper)
