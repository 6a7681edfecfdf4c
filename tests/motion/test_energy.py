import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bodies import DT, ELASTIC, VISCOUS, block, random_control, random_initial

import jaxcontact as jc

# How exactly the ledger must balance, relative to the largest energy of the run.
LEDGER_TOLERANCE = 1e-10
# Energies are sums of positive terms that rounding can move by a few units of the last place.
ROUNDING = 1e-13
STEPS = 40
EXAMPLES = settings(max_examples=12, deadline=None, derandomize=True)

random_scenes = given(
    young=st.floats(10.0, 1000.0),
    poisson=st.floats(-0.4, 0.45),
    bulk=st.floats(0.0, 1.0),
    shear=st.floats(0.01, 1.0),
    density=st.floats(0.3, 3.0),
    slope=st.floats(-0.5, 0.5),
    dt=st.floats(0.005, 0.05),
    seed=st.integers(0, 1000),
)


@EXAMPLES
@random_scenes
def test_energy_ledger_is_an_identity_on_random_scenes(
    young, poisson, bulk, shear, density, slope, dt, seed
):
    material = jc.KelvinVoigt(
        young=young, poisson=poisson, bulk_viscosity=bulk, shear_viscosity=shear, density=density
    )
    stepper = block(material, normal=(slope, 1.0), dt=dt)
    control = random_control(STEPS, seed, size=density)
    motion = jc.simulate(stepper, control, initial=random_initial(seed))
    energy = jc.energy(stepper, motion, control)
    assert np.max(np.abs(energy.residual)) < LEDGER_TOLERANCE * np.max(energy.total)


@EXAMPLES
@random_scenes
def test_energy_never_grows_without_load_on_random_scenes(
    young, poisson, bulk, shear, density, slope, dt, seed
):
    material = jc.KelvinVoigt(
        young=young, poisson=poisson, bulk_viscosity=bulk, shear_viscosity=shear, density=density
    )
    stepper = block(material, normal=(slope, 1.0), dt=dt, force=(0.0, 0.0))
    initial = random_initial(seed)
    falling = jc.State(initial.displacement, initial.velocity - jnp.array([[0.0, 3.0]]))
    energy = jc.energy(stepper, jc.simulate(stepper, steps=STEPS, initial=falling))
    top = np.max(energy.total)
    assert np.max(np.diff(energy.total)) < ROUNDING * top
    assert np.min(energy.viscous_loss) > -ROUNDING * top
    assert np.min(energy.impact_loss) > -ROUNDING * top


@pytest.mark.parametrize("material", [ELASTIC, VISCOUS])
def test_energy_ledger_is_an_identity_with_and_without_viscosity(material):
    stepper, control = block(material), random_control(STEPS)
    motion = jc.simulate(stepper, control)
    energy = jc.energy(stepper, motion, control)
    assert np.any(motion.active)
    assert np.max(np.abs(energy.residual)) < LEDGER_TOLERANCE * np.max(energy.total)
    assert np.any(energy.viscous_loss) == (material is VISCOUS)


def test_energy_ledger_of_the_half_disc_is_an_identity():
    problem = jc.scenes.half_disc_control(h=15 / 4)
    control = problem.control_scale * problem.reference
    energy = jc.energy(problem.stepper, problem.simulate(problem.reference), control)
    assert np.max(np.abs(energy.residual)) < LEDGER_TOLERANCE * np.max(energy.total)
    assert np.sum(energy.impact_loss) > 1e-4 * np.max(energy.total)  # the ledger has entries


def test_energy_records_the_residual_of_a_wrong_control():
    stepper, control = block(), random_control(STEPS)
    motion = jc.simulate(stepper, control)
    energy = jc.energy(stepper, motion, 2.0 * control)
    assert np.max(np.abs(energy.residual)) > 1e-3 * np.max(energy.total)


def test_energy_is_that_of_the_matrices():
    stepper, control = block(), random_control(STEPS)
    motion = jc.simulate(stepper, control)
    energy, system = jc.energy(stepper, motion, control), stepper.system
    y, v = (np.asarray(system.restrict(x)) for x in (motion.displacement, motion.velocity))
    kinetic = 0.5 * np.sum(v * (v @ system.mass.to_scipy()), axis=1)
    elastic = 0.5 * np.sum(y * (y @ system.stiffness.to_scipy()), axis=1)
    np.testing.assert_allclose(energy.kinetic, kinetic, rtol=1e-12)
    np.testing.assert_allclose(energy.elastic, elastic, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(energy.total, kinetic + elastic, rtol=1e-12)


def test_energy_work_in_free_fall_is_force_times_way():
    stepper = block(gap=100.0)
    energy = jc.energy(stepper, jc.simulate(stepper, steps=STEPS))
    height = 5.0 * (DT * np.arange(STEPS + 1)) ** 2
    # The weight is density 1 times area 2 times 10.
    np.testing.assert_allclose(energy.work, 20.0 * np.diff(height), rtol=1e-10)
    np.testing.assert_allclose(energy.kinetic, 20.0 * height, rtol=1e-10, atol=1e-12)


def test_energy_is_lost_at_impact_only_in_steps_that_close_a_gap():
    stepper = block(ELASTIC, force=(0.0, 0.0))
    down = jnp.zeros((stepper.system.n_nodes, 2)).at[:, 1].set(-2.0)
    motion = jc.simulate(stepper, steps=STEPS, initial=jc.State(0.0 * down, down))
    energy = jc.energy(stepper, motion)
    before = np.concatenate([np.zeros((1, 5), bool), np.asarray(motion.active)[:-1]])
    closes = np.any(np.asarray(motion.active) & ~before, axis=1)
    top = np.max(energy.total)
    assert np.any(closes)
    assert np.max(np.abs(energy.impact_loss[~closes])) < ROUNDING * top
    assert np.max(energy.impact_loss[closes]) > 1e-3 * top


def test_energy_in_float32_balances_to_single_precision():
    stepper = block(dtype=jnp.float32)
    control = random_control(STEPS).astype(jnp.float32)
    energy = jc.energy(stepper, jc.simulate(stepper, control), control)
    assert energy.residual.dtype == jnp.float32
    # A few dozen rounding errors of 6e-8 in each sum.
    assert np.max(np.abs(energy.residual)) < 1e-5 * np.max(energy.total)


def test_energy_of_a_batch_equals_the_loop():
    stepper = block()
    controls = jnp.stack([random_control(STEPS, seed) for seed in range(2)])

    def lost(control):
        return jc.energy(stepper, jc.simulate(stepper, control), control).impact_loss

    looped = np.stack([lost(control) for control in controls])
    together = jax.vmap(lost)(controls)
    np.testing.assert_allclose(together, looped, atol=1e-10 * np.max(looped))


def test_energy_of_some_of_the_states_is_refused():
    stepper = block()
    motion = jc.simulate(stepper, steps=STEPS, save_every=2)
    with pytest.raises(ValueError, match=r"21 states of 40 steps.*simulate it with save_every=1"):
        jc.energy(stepper, motion)
