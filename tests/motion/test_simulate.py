import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bodies import (
    BLOCK,
    DT,
    ELASTIC,
    VISCOUS,
    block,
    block_scene,
    discretized,
    random_control,
    random_initial,
)
from support.independent import assemble, kkt_violation
from support.independent import simulate as simulate_independently

import jaxcontact as jc
from jaxcontact.contact import Status

# What a step must reach, relative to the largest term of each condition.
KKT_TOLERANCE = 1e-10
# Two exact methods for the same motion; impacts amplify rounding errors a little.
AGREEMENT = 1e-9
STEPS = 40
EXAMPLES = settings(max_examples=12, deadline=None, derandomize=True)


def relative_difference(first, second):
    first, second = np.asarray(first), np.asarray(second)
    return np.max(np.abs(first - second)) / np.max(np.abs(second))


@pytest.fixture(scope="module")
def half_disc():
    return jc.scenes.half_disc_control(h=15 / 4)


@pytest.fixture(scope="module")
def disc_control(half_disc):
    """Close to the reference control, but without its symmetry"""
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, size=half_disc.reference.shape)
    return half_disc.control_scale * (half_disc.reference + 0.2 * noise)


@pytest.fixture(scope="module")
def disc_motion(half_disc, disc_control):
    return jc.simulate(half_disc.stepper, disc_control)


def test_half_disc_touches_leaves_and_touches_again(disc_motion):
    is_touching = np.any(disc_motion.active, axis=1).astype(int)
    assert np.sum(np.diff(is_touching) == 1) >= 2  # otherwise the tests below show little


def test_half_disc_satisfies_the_kkt_conditions_of_every_step(half_disc, disc_control, disc_motion):
    violation = kkt_violation(half_disc.system, half_disc.dt, disc_motion, disc_control)
    assert violation < KKT_TOLERANCE


def test_half_disc_moves_as_in_the_independent_program(half_disc, disc_control, disc_motion):
    mesh = half_disc.scene.mesh
    nodes = np.unique(mesh.facets["contact"])
    body = assemble(
        mesh.points, mesh.cells, np.unique(mesh.facets["clamped"]),
        [(i, np.array([0.0, -1.0]), mesh.points[i, 1] + 15.8) for i in nodes],
        young=1e8, poisson=0.3, bulk=1e4, shear=1e4,
    )  # fmt: skip
    motion = simulate_independently(body, half_disc.dt, body.control_load(np.asarray(disc_control)))
    assert np.sum(motion.impulse > 0) > 50
    assert relative_difference(disc_motion.displacement, body.lift(motion.y)) < AGREEMENT
    assert relative_difference(disc_motion.velocity, body.lift(motion.v)) < AGREEMENT
    assert relative_difference(disc_motion.contact_impulse, motion.impulse) < AGREEMENT


def test_half_disc_moves_the_same_with_both_contact_solvers(half_disc, disc_control, disc_motion):
    stepper = jc.prepare(half_disc.system, half_disc.dt, contact_solver=jc.ProjectedGaussSeidel())
    other = jc.simulate(stepper, disc_control)
    assert relative_difference(other.displacement, disc_motion.displacement) < AGREEMENT
    assert relative_difference(other.contact_impulse, disc_motion.contact_impulse) < AGREEMENT
    np.testing.assert_array_equal(other.active, disc_motion.active)


def test_half_disc_under_the_reference_control_keeps_its_mirror_symmetry(half_disc):
    points = half_disc.scene.mesh.points
    mirror = np.argmin(np.linalg.norm(points[:, None] - points[None] * [-1.0, 1.0], axis=2), axis=1)
    y = np.asarray(half_disc.target)
    assert relative_difference(y[:, mirror] * [-1.0, 1.0], y) < AGREEMENT


def test_half_disc_in_float32_stays_close_to_float64(half_disc, disc_motion, disc_control):
    system = jc.discretize(half_disc.scene, dtype=jnp.float32)
    single = jc.simulate(jc.prepare(system, half_disc.dt), disc_control.astype(jnp.float32))
    fields = (single.displacement, single.velocity, single.contact_impulse, single.time)
    assert {field.dtype for field in fields} == {np.dtype("float32")}
    # A few rounding errors of 6e-8 in each of 150 steps; measured 1.7e-5.
    assert relative_difference(single.displacement, disc_motion.displacement) < 5 * 150 * 6e-8


random_scenes = given(
    young=st.floats(10.0, 1000.0),
    poisson=st.floats(-0.4, 0.45),
    viscosity=st.floats(0.01, 1.0),
    density=st.floats(0.3, 3.0),
    gap=st.floats(0.05, 0.2),
    slope=st.floats(-0.5, 0.5),
    dt=st.floats(0.005, 0.05),
    seed=st.integers(0, 1000),
)


@EXAMPLES
@random_scenes
def test_simulate_satisfies_the_kkt_conditions_on_random_scenes(
    young, poisson, viscosity, density, gap, slope, dt, seed
):
    material = jc.KelvinVoigt(
        young=young,
        poisson=poisson,
        bulk_viscosity=viscosity,
        shear_viscosity=viscosity,
        density=density,
    )
    stepper = block(material, gap=gap, normal=(slope, 1.0), dt=dt)
    control = random_control(STEPS, seed, size=density)
    motion = jc.simulate(stepper, control, initial=random_initial(seed))
    assert kkt_violation(stepper.system, dt, motion, control) < KKT_TOLERANCE


@EXAMPLES
@given(slope=st.floats(-0.5, 0.5), seed=st.integers(0, 1000))
def test_simulate_moves_the_same_with_both_contact_solvers(slope, seed):
    control, initial = random_control(STEPS, seed), random_initial(seed)
    newton, sweeps = (
        jc.simulate(block(normal=(slope, 1.0), contact_solver=solver), control, initial=initial)
        for solver in (jc.SemismoothNewton(), jc.ProjectedGaussSeidel())
    )
    assert np.any(newton.active)
    assert relative_difference(newton.displacement, sweeps.displacement) < AGREEMENT


@pytest.mark.parametrize("dimension", [1, 3])
def test_simulate_satisfies_the_kkt_conditions_in_other_dimensions(dimension):
    mesh, side = {
        1: (jc.meshes.interval(2.0, h=0.5), "left"),
        3: (jc.meshes.box((1.0, 1.0, 1.0), h=0.5), "bottom"),
    }[dimension]
    up = np.eye(dimension)[-1]
    plane = jc.HalfSpace(-0.1 * up, up)
    system = jc.discretize(jc.Scene(mesh, VISCOUS, contact={side: plane}, body_force=-10 * up))
    motion = jc.simulate(jc.prepare(system, DT), steps=STEPS)
    assert np.any(motion.active)
    assert not np.all(motion.active)
    assert kkt_violation(system, DT, motion) < KKT_TOLERANCE


def test_simulate_records_what_belongs_together():
    stepper, control = block(), random_control(STEPS)
    motion = jc.simulate(stepper, control, initial=random_initial())
    system = stepper.system
    assert motion.displacement.shape == motion.velocity.shape == (STEPS + 1, BLOCK.n_nodes, 2)
    assert motion.contact_impulse.shape == motion.active.shape == (STEPS, 5)
    assert motion.iterations.shape == motion.status.shape == (STEPS,)
    np.testing.assert_allclose(motion.time, DT * np.arange(STEPS + 1))
    contact = np.asarray(motion.displacement)[:, system.contact_nodes]
    gap = np.asarray(system.gap) + contact[:, :, 1]
    np.testing.assert_allclose(motion.gap, gap, atol=1e-15)
    np.testing.assert_array_equal(motion.active, np.abs(motion.gap[1:]) < 1e-14)
    assert not np.any(motion.contact_impulse[~np.asarray(motion.active)])
    assert np.all(np.asarray(motion.status) == Status.CONVERGED)
    np.testing.assert_array_equal(motion.final.displacement, motion.displacement[-1])
    np.testing.assert_array_equal(motion.final.velocity, motion.velocity[-1])


def test_simulate_without_control_is_simulate_with_a_zero_control():
    stepper = block()
    free = jc.simulate(stepper, steps=STEPS)
    held = jc.simulate(stepper, jnp.zeros((STEPS, BLOCK.n_nodes, 2)), steps=STEPS)
    assert relative_difference(free.displacement, held.displacement) < AGREEMENT


def test_simulate_continues_from_a_state_as_if_it_had_never_stopped():
    stepper, control = block(), random_control(STEPS)
    whole = jc.simulate(stepper, control)
    first = jc.simulate(stepper, control[:15])
    second = jc.simulate(stepper, control[15:], initial=first.final)
    assert np.any(first.active[-1])  # it is cut while in contact
    assert relative_difference(second.displacement, whole.displacement[15:]) < AGREEMENT


def test_simulate_one_step_is_the_first_of_many():
    stepper, control = block(), random_control(STEPS)
    one = jc.simulate(stepper, control[:1])
    assert one.displacement.shape == (2, BLOCK.n_nodes, 2)
    many = jc.simulate(stepper, control)
    np.testing.assert_allclose(one.displacement, many.displacement[:2], atol=1e-15)


def test_simulate_free_fall_is_a_parabola():
    # Constant force: the trapezoidal rule is exact, and a rigid motion has no elastic force.
    motion = jc.simulate(block(gap=100.0), steps=STEPS)
    fall = -5.0 * np.asarray(motion.time) ** 2
    expected = np.zeros(motion.displacement.shape) + fall[:, None, None] * np.array([0.0, 1.0])
    np.testing.assert_allclose(motion.displacement, expected, atol=1e-12)
    assert not np.any(motion.active)


def test_simulate_body_at_rest_on_the_ground_stays_there():
    motion = jc.simulate(block(gap=0.0, force=(0.0, 0.0)), steps=STEPS)
    assert not np.any(motion.displacement)
    assert not np.any(motion.contact_impulse)
    assert np.all(motion.active)  # weak contact


def test_simulate_changes_the_momentum_by_loads_and_impulses_only():
    stepper, control = block(normal=(0.3, 1.0)), random_control(STEPS)
    motion = jc.simulate(stepper, control)
    system = stepper.system
    mass = system.nodal_mass.to_scipy().toarray()  # the density is one
    momentum = np.einsum("ab,tbi->ti", mass, np.asarray(motion.velocity))
    load = np.einsum("ab,tbi->ti", mass, np.asarray(control)) + 2.0 * np.array([0.0, -10.0])
    push = np.asarray(motion.contact_impulse) @ -np.asarray(system.normals.weights)
    np.testing.assert_allclose(np.diff(momentum, axis=0), DT * load + push, atol=1e-11)


def test_simulate_rotated_scene_moves_as_the_rotated_body():
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    control = random_control(STEPS)
    upright = jc.simulate(block(), control)
    scene = block_scene(
        mesh=BLOCK.with_points(BLOCK.points @ turn.T),
        normal=turn @ [0.0, 1.0],
        force=turn @ [0.0, -10.0],
    )
    rotated = jc.simulate(jc.prepare(discretized(scene), DT), control @ turn.T)
    assert np.any(upright.active)
    assert relative_difference(rotated.displacement @ turn, upright.displacement) < AGREEMENT


def test_simulate_flat_drop_brings_all_contact_nodes_down_together():
    # Without Poisson's effect the block is a bundle of equal bars.
    motion = jc.simulate(block(jc.KelvinVoigt(young=100.0, poisson=0.0)), steps=STEPS)
    counts = np.sum(motion.active, axis=1)
    assert counts[np.argmax(counts > 0)] == 5


def test_simulate_tiny_viscosity_is_almost_none():
    control = random_control(STEPS)
    almost = jc.KelvinVoigt(young=100.0, poisson=0.3, shear_viscosity=1e-12)
    elastic, nearly = (jc.simulate(block(m), control) for m in (ELASTIC, almost))
    assert relative_difference(nearly.displacement, elastic.displacement) < 1e-8


def test_simulate_body_without_contact_set_flies_through():
    scene = jc.Scene(BLOCK, VISCOUS, body_force=np.array([0.0, -10.0]))
    motion = jc.simulate(jc.prepare(jc.discretize(scene), DT), steps=STEPS)
    assert motion.contact_impulse.shape == (STEPS, 0)
    assert motion.gap.shape == (STEPS + 1, 0)
    np.testing.assert_allclose(motion.displacement[-1, :, 1], -5.0 * (STEPS * DT) ** 2)


def test_simulate_a_plane_as_a_ball_of_huge_radius_is_the_plane():
    radius = 1e7
    ball = jc.Ball(np.array([1.0, -0.1 - radius]), radius)
    scene = jc.Scene(BLOCK, VISCOUS, contact={"bottom": ball}, body_force=np.array([0.0, -10.0]))
    round_floor = jc.simulate(jc.prepare(jc.discretize(scene), DT), steps=STEPS)
    flat_floor = jc.simulate(block(), steps=STEPS)
    # The ball falls off by 1/(2 radius); contact times shift by about as much.
    assert relative_difference(round_floor.displacement, flat_floor.displacement) < 1e-5


def corner_scene(floor, wall):
    contact = {"bottom": floor, "left": wall}
    return jc.Scene(BLOCK, VISCOUS, contact=contact, body_force=np.array([-10.0, -10.0]))


def test_simulate_into_a_corner_touches_both_obstacles():
    floor = jc.HalfSpace(np.array([0.0, -0.1]), np.array([0.0, 1.0]))
    wall = jc.HalfSpace(np.array([-0.1, 0.0]), np.array([1.0, 0.0]))
    system = jc.discretize(corner_scene(floor, wall))
    motion = jc.simulate(jc.prepare(system, DT), steps=STEPS)
    (corner,) = np.flatnonzero(np.all(BLOCK.points == 0.0, axis=1))
    pairs = np.flatnonzero(system.contact_nodes == corner)
    assert np.any(np.all(motion.active[:, pairs], axis=1))
    assert kkt_violation(system, DT, motion) < KKT_TOLERANCE


def test_simulate_survives_two_contact_sets_that_share_a_node_and_an_obstacle():
    plane = jc.HalfSpace(np.array([-0.1, -0.1]), np.array([1.0, 1.0]))
    system = jc.discretize(corner_scene(plane, plane))
    motion = jc.simulate(jc.prepare(system, DT), steps=STEPS)
    assert np.any(motion.active)
    assert kkt_violation(system, DT, motion) < KKT_TOLERANCE


@pytest.mark.parametrize("argument", ["control", "initial state"])
def test_simulate_under_vmap_equals_the_loop(argument):
    stepper = block()
    controls = jnp.stack([random_control(STEPS, seed) for seed in range(3)])
    states = [random_initial(seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    if argument == "control":
        together = jax.jit(jax.vmap(lambda u: jc.simulate(stepper, u)))(controls)
        alone = [jc.simulate(stepper, u) for u in controls]
    else:
        together = jax.jit(jax.vmap(lambda s: jc.simulate(stepper, controls[0], initial=s)))(
            stacked
        )
        alone = [jc.simulate(stepper, controls[0], initial=s) for s in states]
    for k, motion in enumerate(alone):
        assert relative_difference(together.displacement[k], motion.displacement) < AGREEMENT
        np.testing.assert_array_equal(together.active[k], motion.active)


def test_simulate_under_jit_with_the_stepper_as_argument_equals_simulate():
    stepper, control = block(), random_control(STEPS)
    jitted = jax.jit(jc.simulate)(stepper, control)
    plain = jc.simulate(stepper, control)
    assert relative_difference(jitted.displacement, plain.displacement) < AGREEMENT


def test_simulate_compiles_nothing_for_new_values(caplog):
    jc.simulate(block(), random_control(STEPS, 0), initial=random_initial(0))
    others = block(jc.KelvinVoigt(young=50.0, poisson=0.1, shear_viscosity=1.0), gap=0.2)
    control, initial = random_control(STEPS, 1), random_initial(1)
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        jc.simulate(others, control, initial=initial)
        assert not [r for r in caplog.records if "Compiling" in r.getMessage()]
        jc.simulate(others, control[:-3], initial=initial)
        assert [r for r in caplog.records if "Compiling" in r.getMessage()]


def test_scene_of_a_new_shape_compiles_in_few_programs(caplog):
    scene = block_scene(mesh=jc.meshes.rectangle((2.5, 1.0), h=0.5))
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        jc.simulate(jc.prepare(jc.discretize(scene), DT), steps=1)
    programs = [r for r in caplog.records if "Compiling" in r.getMessage()]
    # One after the other its operations are 160 programs, of which some may be there already.
    assert 5 < len(programs) < 25


def wave_error(dt, time=0.4):
    """Distance of a clamped vibrating bar to its exact semi-discrete motion"""
    mesh = jc.meshes.interval(2.0, h=0.5)
    system = jc.discretize(jc.Scene(mesh, ELASTIC, clamped=("left",)))
    M, A = (m.to_scipy().toarray() for m in (system.mass, system.stiffness))
    values, modes = np.linalg.eig(np.linalg.solve(M, A))
    start = np.array([0.01, 0.03, 0.02, 0.04])
    coefficients = np.linalg.solve(modes, start)
    exact = modes @ (np.cos(np.sqrt(values) * time) * coefficients)
    y = system.lift(jnp.asarray(start))
    steps = round(time / dt)
    motion = jc.simulate(jc.prepare(system, dt), steps=steps, initial=jc.State(y, 0.0 * y))
    return np.max(np.abs(system.restrict(motion.displacement[-1]) - exact))


def test_simulate_vibration_without_contact_converges_with_order_two():
    errors = np.array([wave_error(dt) for dt in (4e-3, 2e-3, 1e-3)])
    rates = np.log2(errors[:-1] / errors[1:])
    assert np.all(np.abs(rates - 2.0) < 0.05), rates
    # The phase error (omega dt)^2/12 per radian of the highest mode, omega = sqrt(12) c/h = 80/s,
    # in 0.4 s at an amplitude of 0.02 m.
    assert errors[-1] < (80.0 * 1e-3) ** 2 / 12 * 80.0 * 0.4 * 0.02, errors


N_CELLS = 200
PHASE = 0.5


@pytest.fixture(scope="module")
def bar_impact():
    """P2 at the Courant number one; the wall is touched in the middle of the third step"""
    bar = jc.reference.FreeBar(gap=0.0)
    cell = float(bar.length) / N_CELLS
    dt = cell / float(bar.wave_speed())
    gap = float(bar.impact_speed) * dt * (2 + PHASE)
    mesh = jc.meshes.interval(float(bar.length), h=cell)
    material = jc.KelvinVoigt(young=bar.young, poisson=0.0, density=bar.density)
    wall = jc.HalfSpace(np.array([-gap]), np.array([1.0]))
    system = jc.discretize(jc.Scene(mesh, material, contact={"left": wall}))
    stepper = jc.prepare(system, dt)
    rest = jnp.zeros((mesh.n_nodes, 1))
    # Contact lasts 2 N_CELLS steps.
    motion = jc.simulate(stepper, steps=2 * N_CELLS + 60, initial=jc.State(rest, rest - 10.0))
    return bar, stepper, motion


def test_bar_impact_has_the_exact_impulse(bar_impact):
    bar, _, motion = bar_impact
    # A step is 1/400 of the contact: four of them.
    np.testing.assert_allclose(np.sum(motion.contact_impulse), bar.impulse(), rtol=0.01)


def test_bar_impact_rebounds_with_the_speed_of_impact(bar_impact):
    bar, stepper, motion = bar_impact
    assert not np.any(motion.active[-1])
    system = stepper.system
    mass = np.asarray(system.mass.to_scipy().sum(axis=0))
    mean_velocity = mass @ np.asarray(system.restrict(motion.velocity[-1])) / np.sum(mass)
    np.testing.assert_allclose(mean_velocity, bar.rebound_velocity(), rtol=0.01)


def test_bar_impact_loses_the_energy_of_the_first_touch_exactly(bar_impact):
    _, stepper, motion = bar_impact
    total = np.asarray(jc.energy(stepper, motion).total)
    losses = -np.diff(total) / total[0]
    expected = float(jc.reference.first_touch_loss(PHASE, 1.0, N_CELLS))
    first = int(np.argmax(np.any(motion.active, axis=1)))
    assert first == 2
    np.testing.assert_allclose(losses[first], expected, rtol=1e-6)
    # At this phase nothing else is lost.
    np.testing.assert_allclose(1.0 - total[-1] / total[0], expected, rtol=1e-6)
