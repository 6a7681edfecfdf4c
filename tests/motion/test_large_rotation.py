"""Bodies that turn by any angle: conservation, contact, ledger and what is refused."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.turning import (
    DT,
    MESHES,
    SCHEMES,
    SIDES,
    elastic,
    hit,
    initial_of,
    parameters,
    rotation,
    stepper_of,
)

import jaxcontact as jc

IMPLICIT, STABILIZED, EULER = SCHEMES

#: The sweeps end at 1e-13 of the velocity; a ledger is relative to the energy at the start.
LEDGER = 1e-12


def flight(dimension, steps, scheme=IMPLICIT, dt=DT):
    values = elastic(parameters(dimension)) | {"dt": dt}
    stepper = stepper_of(dimension, values, scheme, is_flight=True)
    return stepper, jc.simulate(stepper, steps=steps, initial=initial_of(values))


def check_conservation(dimension, steps, tolerance):
    stepper, motion = flight(dimension, steps)
    total = np.asarray(jc.energy(stepper, motion).total)
    ledger = jc.momentum(stepper, motion)
    spin = np.asarray(ledger.angular)
    assert np.ptp(total) <= tolerance * total[0]
    assert np.max(np.abs(spin - spin[0])) <= tolerance * np.max(np.abs(spin[0]))
    linear = np.asarray(ledger.linear)
    assert np.max(np.abs(linear - linear[0])) <= tolerance * np.max(np.abs(linear[0]))
    return motion


@pytest.mark.parametrize("dimension", [2, 3])
def test_free_flight_keeps_energy_and_both_momenta(dimension):
    motion = check_conservation(dimension, 300, 2e-12)
    # It has turned far from the angles of a linear model.
    assert np.trace(np.asarray(motion.rotation[0, 0]).T @ np.asarray(motion.rotation[-1, 0])) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_long_free_flight_keeps_energy_and_both_momenta(dimension):
    check_conservation(dimension, 10_000, 1e-10)


@pytest.mark.parametrize("dimension", [2, 3])
def test_free_flight_does_not_know_the_axes(dimension):
    stepper, motion = flight(dimension, 60)
    Q, points = rotation(dimension, 2.0), np.asarray(MESHES[dimension].points)
    place = points + np.asarray(motion.displacement)
    turned = jc.State(place[0] @ Q.T - points, motion.velocity[0] @ Q.T)
    other = jc.simulate(stepper, steps=60, initial=turned)
    np.testing.assert_allclose(points + other.displacement[-1], place[-1] @ Q.T, atol=1e-12)
    np.testing.assert_allclose(other.rotation[-1, 0], Q @ motion.rotation[-1, 0], atol=1e-12)


def test_free_flight_converges_with_order_two():
    reference = flight(2, 960, dt=DT / 16)[1].displacement[-1]
    errors = [
        float(jnp.linalg.norm(flight(2, 60 * k, dt=DT / k)[1].displacement[-1] - reference))
        for k in (2, 4)
    ]

    assert 3.5 < errors[0] / errors[1] < 5.0
    assert errors[1] < 2e-3


def test_rigid_body_turns_and_flies_as_one():
    values = parameters(2)
    points = np.asarray(MESHES[2].points)
    spin, velocity = 0.02, np.array([0.3, 0.2])
    arm = points - points.mean(axis=0)
    start = jc.State(None, velocity + spin * arm @ np.array([[0.0, 1.0], [-1.0, 0.0]]))
    stepper = stepper_of(2, elastic(values) | {"dt": 1.0}, IMPLICIT, is_flight=True)
    motion = jc.simulate(stepper, steps=50, initial=start)
    time = np.asarray(motion.time)
    angle = np.arctan2(motion.rotation[:, 0, 1, 0], motion.rotation[:, 0, 0, 0])
    np.testing.assert_allclose(angle, spin * time, rtol=2e-4, atol=1e-15)
    centre = points.mean(axis=0) + time[:, None] * velocity
    np.testing.assert_allclose(motion.centre[:, 0], centre, atol=1e-11)


@pytest.mark.parametrize(
    ("dimension", "floor"), [(2, "plane"), (3, "plane"), (2, "ball"), (2, "bowl")]
)
@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda x: type(x).__name__)
def test_hit_balances_energy_and_momentum_and_does_not_penetrate(dimension, scheme, floor):
    stepper, control, motion = hit(dimension, scheme, floor)
    ledger = jc.energy(stepper, motion, control)
    start = float(ledger.total[0])
    assert bool(jnp.any(motion.strong))
    assert float(motion.gap.min()) > -1e-14
    assert float(jnp.max(jnp.abs(ledger.residual))) <= LEDGER * start
    assert float(jnp.max(ledger.change - ledger.work)) <= LEDGER * start
    assert float(jnp.min(ledger.impact_loss)) >= -LEDGER * start
    momenta = jc.momentum(stepper, motion, control)
    size = float(jnp.max(jnp.abs(momenta.angular)))
    assert float(jnp.max(jnp.abs(momenta.linear_residual))) <= 1e-12 * size
    if scheme != EULER:
        assert float(jnp.max(jnp.abs(momenta.angular_residual))) <= 1e-12 * size


def test_sweeps_are_few():
    _, _, motion = hit(2, STABILIZED)
    assert float(jnp.mean(motion.iterations)) <= 5.5


def test_clamped_bodies_run_as_without_frames():
    mesh = MESHES[2]

    def motion(large_rotation):
        scene = jc.Scene(
            mesh,
            jc.KelvinVoigt(young=1e5, poisson=0.3, density=1000.0),
            clamped=("top",),
            contact={"bottom": jc.HalfSpace([0.0, -0.01], [0.0, 1.0])},
            body_force=[0.0, -5e4],
            large_rotation=large_rotation,
        )
        stepper = jc.prepare(jc.discretize(scene), 1e-3, scheme=STABILIZED)
        return jc.simulate(stepper, steps=40)

    with_frames, without = motion(True), motion(False)
    assert bool(jnp.any(without.strong))
    assert np.array_equal(with_frames.displacement, without.displacement)
    assert np.array_equal(with_frames.contact_impulse, without.contact_impulse)


def test_bodies_side_by_side_move_as_alone():
    """A clamped one as without frames, two free ones each as in a scene of its own"""
    mesh = MESHES[2]
    parts = {
        "held": mesh.moved(translation=[5.0, 0.0]),
        "first": mesh,
        "second": mesh.moved(rotation(2), [-5.0, 0.0]),
    }
    material = jc.KelvinVoigt(young=1e5, poisson=0.3, bulk_viscosity=10.0, density=1000.0)
    floor = jc.HalfSpace([0.0, -0.002], [0.0, 1.0])
    rng = np.random.default_rng(0)
    velocity = {name: rng.normal(size=part.points.shape) for name, part in parts.items()}
    velocity["held"][np.unique(mesh.facets["top"])] = 0.0

    def scene(mesh, prefixes, **options):
        contact = dict.fromkeys((f"{name}/bottom" for name in prefixes), floor)
        return jc.Scene(mesh, material, contact=contact, body_force=[0.0, -9810.0], **options)

    def motion(scene, velocity):
        stepper = jc.prepare(jc.discretize(scene), DT, scheme=STABILIZED)
        return jc.simulate(stepper, steps=40, initial=jc.State(None, velocity))

    clamped = {"clamped": ("held/top",)}
    together = motion(
        scene(jc.join(parts), ("held", "first", "second"), large_rotation=True, **clamped),
        np.concatenate(list(velocity.values())),
    )
    assert together.rotation.shape == (41, 2, 2, 2)
    at = 0
    for name, part in parts.items():
        options = clamped if name == "held" else {"large_rotation": True}
        alone = motion(scene(jc.join({name: part}), (name,), **options), velocity[name])
        assert bool(jnp.any(alone.strong))
        shown = together.displacement[:, at : at + part.n_nodes]
        np.testing.assert_allclose(shown, alone.displacement, atol=1e-11)
        at += part.n_nodes


def test_small_rotation_is_the_small_displacement_model():
    """Without spin the difference is of the order of strain times displacement"""
    points = np.asarray(MESHES[2].points)

    def end(scale, large_rotation):
        scene = jc.Scene(
            MESHES[2],
            jc.KelvinVoigt(young=1e6, poisson=0.3, density=1000.0),
            large_rotation=large_rotation,
        )
        stepper = jc.prepare(jc.discretize(scene), DT)
        wave = scale * np.stack([np.cos(np.pi * points[:, 0]), 0.0 * points[:, 1]], axis=1)
        return jc.simulate(stepper, steps=30, initial=jc.State(wave)).displacement[-1]

    for scale in (1e-2, 1e-3):
        difference = jnp.max(jnp.abs(end(scale, True) - end(scale, False)))
        assert 0.0 < float(difference) < 5.0 * scale**2


def test_batch_of_motions_is_each_of_them():
    values = parameters(2)
    stepper = stepper_of(2, values, STABILIZED)
    control = values["control"]
    speeds = jnp.array([0.9, 1.0, 1.1])

    @jax.jit
    def end(speed):
        start = jc.State(values["displacement"], speed * values["velocity"])
        return jc.simulate(stepper, control, initial=start).displacement[-1]

    together = jax.vmap(end)(speeds)
    alone = jnp.stack([end(speed) for speed in speeds])
    np.testing.assert_allclose(together, alone, atol=1e-11)


def test_step_is_a_step_of_simulate():
    stepper, control, motion = hit(2, STABILIZED)
    k = int(np.argmax(np.any(motion.strong, axis=1)))
    state = jc.State(motion.displacement[k], motion.velocity[k])
    after, record = jc.step(stepper, state, control[k])
    np.testing.assert_allclose(after.displacement, motion.displacement[k + 1], atol=1e-12)
    np.testing.assert_allclose(record.contact_impulse, motion.contact_impulse[k], rtol=1e-9)


def test_float32_keeps_its_digits_far_from_the_origin():
    values = elastic(parameters(2))
    values = values | {"displacement": values["displacement"] + 100.0}
    stepper = stepper_of(2, values, STABILIZED, is_flight=True, dtype=jnp.float32)
    motion = jc.simulate(stepper, steps=200, initial=initial_of(values))
    total = np.asarray(jc.energy(stepper, motion).total)
    assert motion.displacement.dtype == jnp.float32
    assert np.ptp(total) <= 1e-4 * total[0]


def test_step_too_long_for_the_sweeps_is_no_result():
    values = elastic(parameters(2, spin=300.0))
    stepper = stepper_of(2, values | {"dt": 0.05}, IMPLICIT, is_flight=True)
    with pytest.raises(jc.SolveError, match=r"not converged|non finite"):
        jc.simulate(stepper, steps=5, initial=initial_of(values))


def block(**options):
    usual = {"contact": {"bottom": jc.HalfSpace([0.0, -1.0], [0.0, 1.0])}, "large_rotation": True}
    return jc.Scene(MESHES[2], jc.KelvinVoigt(young=1e6, poisson=0.3), **usual | options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rollers": {"left": None}}, "rollers"),
        ({"contact": {"bottom": jc.Along(jc.HalfSpace([0.0, -1.0], [0.0, 1.0]))}}, "Along"),
    ],
)
def test_scene_refuses_what_cannot_turn(options, message):
    with pytest.raises(ValueError, match=message):
        jc.discretize(block(**options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scheme": jc.Trapezoidal()}, "Trapezoidal"),
        ({"scheme": jc.RedistributedMass()}, "RedistributedMass"),
        ({"linear_solver": jc.ConjugateGradient()}, "NestedDissection"),
        ({"contact_solver": jc.SmoothedContact(1.0)}, "compliance"),
    ],
)
def test_prepare_refuses_what_cannot_turn(options, message):
    with pytest.raises(ValueError, match=message):
        jc.prepare(jc.discretize(block()), DT, **options)


@pytest.mark.parametrize(
    "call",
    [
        lambda system, stepper: jc.reduce(system, 4),
        lambda system, stepper: system.with_pairs([0]),
        lambda system, stepper: jc.solve_static(system),
        lambda system, stepper: jc.simulate(
            stepper, steps=2, schedule=jc.Schedule(pressure={"top": jnp.ones(2)})
        ),
        lambda system, stepper: jc.simulate(stepper, steps=2, weak_contact=jc.CriticalCone()),
        lambda system, stepper: jc.linearization_error(block(), jc.simulate(stepper, steps=2)),
    ],
)
def test_functions_of_small_displacements_are_refused(call):
    system = jc.discretize(block())
    with pytest.raises(ValueError, match="large_rotation"):
        call(system, jc.prepare(system, DT))


def test_stress_is_that_of_the_deformation_in_the_axes_of_the_body():
    scene, points = block(), np.asarray(MESHES[2].points)
    stretch = 1e-3 * points @ np.array([[1.0, 0.5], [0.5, -0.3]])
    turned = (points + stretch) @ rotation(2, 2.0).T - points + 3.0
    np.testing.assert_allclose(
        jc.stress(scene, turned).cells, jc.stress(scene, stretch).cells, atol=1e-6
    )
    with pytest.raises(ValueError, match="large_rotation"):
        jc.stress(scene, turned, turned)


def test_small_displacements_warn_of_a_body_that_turns():
    points = np.asarray(MESHES[2].points)
    two = jc.join({"still": MESHES[2], "spins": MESHES[2].moved(translation=[3.0, 0.0])})
    material = jc.KelvinVoigt(young=1e6, poisson=0.3, density=1000.0)
    stepper = jc.prepare(jc.discretize(jc.Scene(two, material)), DT)
    velocity = np.zeros(two.points.shape)
    arm = points - points.mean(axis=0)
    velocity[len(points) :] = 3.0 * arm @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    start = jc.State(None, velocity)
    with pytest.warns(UserWarning, match=r"body 1 .* 5 degrees at step 32, .*large_rotation"):
        jc.simulate(stepper, steps=60, initial=start)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jc.simulate(stepper, steps=20, initial=start)


def test_frames_are_asked_for_where_there_are_none():
    system = jc.discretize(block(large_rotation=False))
    motion = jc.simulate(jc.prepare(system, DT), steps=1)
    with pytest.raises(ValueError, match="large_rotation"):
        _ = motion.rotation
    with pytest.raises(ValueError, match="large_rotation"):
        jc.momentum(jc.prepare(system, DT), motion)


def test_state_that_penetrates_where_it_is_turned_is_refused():
    values = parameters(2)
    start = initial_of(values)
    low = replace(start, displacement=start.displacement - jnp.array([[0.0, 0.5]]))
    with pytest.raises(ValueError, match="penetrates"):
        jc.simulate(stepper_of(2, values, STABILIZED), steps=1, initial=low)


def test_sides_name_the_whole_boundary():
    assert set(SIDES[3]) == set(MESHES[3].facets)
