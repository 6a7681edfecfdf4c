"""Two bodies in motion: momentum, exact bars, mirror images, gradients across the contact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.two_bodies import RUBBER, momenta, round_bodies, stacked, thrown, touching

import jaxcontact as jc

SCHEMES = [jc.ContactImplicit(), jc.ContactStabilized(), jc.BackwardEuler()]
# Momentum and energy: some hundred steps of some hundred sums.
KEPT = 1e-12
SPEED = 0.1


def body_velocities(scene, system, velocity):
    """Mean velocity of every body of a row of bars, (bodies,)"""
    momentum = system.mass.scalar.to_scipy() @ np.asarray(velocity)[:, 0]
    return np.bincount(scene.mesh.components(), momentum)


def impact_of_bars(n, n_resting=1, scheme=None):
    """The first bar comes after half a step; the motion ends when the last bar has left"""
    scene = jc.scenes.bars(n_resting, h=1.0 / n, gap=0.5 * SPEED / n)
    system = jc.discretize(scene)
    stepper = jc.prepare(system, 1.0 / n, scheme=scheme)
    steps = round((n_resting + 1.5) * n)
    motion = jc.simulate(stepper, steps=steps, initial=thrown(scene, "bar0", [SPEED]))
    return scene, stepper, motion


def test_bars_exchange_their_velocities():
    left_over = []
    for n in (50, 100):
        scene, stepper, motion = impact_of_bars(n)
        velocities = body_velocities(scene, stepper.system, motion.final.velocity)
        left_over.append(velocities[0] / SPEED)
        momentum = momenta(stepper.system, motion, scene.mesh.points)[:, 0]
        assert np.max(np.abs(momentum - SPEED)) < 1e-11 * SPEED
        ledger = jc.energy(stepper, motion)
        assert np.max(np.abs(ledger.residual)) < KEPT * ledger.total[0]
    # Exact is zero; the error of the energy is of first order and stays in both bars.
    assert left_over[0] < 1.2e-2
    assert left_over[1] < 7.0e-3


def test_bars_press_with_half_the_impedance():
    _, stepper, motion = impact_of_bars(50, scheme=jc.ContactStabilized())
    pressure = np.asarray(jc.contact_pressure(stepper, motion))[:, 0]
    assert np.mean(pressure[5:95]) == pytest.approx(0.5 * SPEED, rel=5e-3)
    assert np.count_nonzero(motion.active) == pytest.approx(100, abs=5)


def test_cradle_hands_the_velocity_to_the_last_bar():
    scene, stepper, motion = impact_of_bars(40, n_resting=3)
    velocities = body_velocities(scene, stepper.system, motion.final.velocity)
    np.testing.assert_allclose(velocities / SPEED, [0.0, 0.0, 0.0, 1.0], atol=0.025)
    last_closed = np.flatnonzero(motion.active[:, 2])[-1]
    assert last_closed == pytest.approx(4 * 40, abs=2)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_mirrored_bodies_move_as_one_on_a_plane(scheme):
    h, steps, dt = jc.scenes.RADIUS / 6, 130, 5e-5
    one, two = (
        jc.discretize(scene(h)) for scene in (jc.scenes.half_disc, jc.scenes.two_half_discs)
    )
    down = jnp.broadcast_to(jnp.array([0.0, -1e6]), (steps, one.n_nodes, 2))
    alone = jc.simulate(jc.prepare(one, dt, scheme=scheme), down)
    both = jc.simulate(jc.prepare(two, dt, scheme=scheme), jnp.concatenate([down, -down], axis=1))
    assert np.count_nonzero(np.any(alone.active, axis=1)) > 40
    upper = both.displacement[:, : one.n_nodes]
    size = np.max(np.abs(alone.displacement))
    np.testing.assert_allclose(upper, alone.displacement, atol=1e-12 * size)
    np.testing.assert_allclose(both.gap, 2.0 * alone.gap, atol=1e-12 * size)
    largest = np.max(alone.contact_impulse)
    np.testing.assert_allclose(both.contact_impulse, alone.contact_impulse, atol=KEPT * largest)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_free_discs_keep_momentum_and_angular_momentum(scheme):
    scene = jc.scenes.two_discs(h=0.25, gap=0.01)
    system = jc.discretize(scene)
    stepper = jc.prepare(system, 0.02, scheme=scheme)
    initial = thrown(scene, "small", [0.02, -0.05])
    motion = jc.simulate(stepper, steps=500, initial=initial)
    assert np.count_nonzero(np.any(motion.active, axis=1)) > 100
    kept = momenta(system, motion, scene.mesh.points)
    assert np.max(np.abs(kept - kept[0])) < KEPT * np.max(np.abs(kept[0]))
    ledger = jc.energy(stepper, motion)
    assert np.max(np.abs(ledger.residual)) < KEPT * ledger.total[0]
    assert np.all(np.diff(ledger.total) < KEPT * ledger.total[0])


STEPS, DT = 20, 0.02
ROUND = touching(round_bodies(), "ball/contact", "floor/contact")
CONTROL = jnp.asarray(np.random.default_rng(3).normal(size=(STEPS, ROUND.mesh.n_nodes, 2)))
VALUES = {
    "control": CONTROL,
    "ball": jnp.asarray(100.0),
    "floor": jnp.asarray(200.0),
    "points": jnp.asarray(ROUND.mesh.points),
}


def round_motion(values):
    materials = {
        name: jc.KelvinVoigt(young=values[name], poisson=0.3) for name in ("ball", "floor")
    }
    mesh = ROUND.mesh.with_points(values["points"])
    system = jc.discretize(jc.Scene(mesh, materials, contact=ROUND.contact))
    stepper = jc.prepare(system, DT, scheme=jc.ContactStabilized())
    return jc.simulate(stepper, values["control"], initial=thrown(ROUND, "ball", [0.1, -1.0]))


@jax.jit
def round_cost(values):
    motion = round_motion(values)
    return jnp.sum(motion.final.displacement**2) + jnp.sum(motion.contact_impulse**2)


@pytest.fixture(scope="module")
def round_gradient():
    return jax.jit(jax.grad(round_cost))(VALUES)


@pytest.mark.parametrize("name", list(VALUES))
def test_gradient_across_two_bodies_is_the_difference_quotient(round_gradient, name):
    rng, value = np.random.default_rng(4), VALUES[name]
    direction = jnp.asarray(rng.choice([-1.0, 1.0], size=value.shape))
    step = 1e-5 * float(jnp.max(jnp.abs(value)))
    ahead, behind = (round_cost(VALUES | {name: value + s * direction}) for s in (step, -step))
    slope = jnp.vdot(round_gradient[name], direction)
    np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * step), rtol=1e-5)


#: A block is thrown at another one that stands on clamped nodes; coupled rows of other widths.
BLOCKS = touching(stacked(1 / 3, 1 / 2, gap=0.01), clamped=("lower/bottom",))


@pytest.fixture(scope="module")
def blocks():
    return jc.discretize(BLOCKS)


def fall_of(system, **options):
    stepper = jc.prepare(system, 0.05, scheme=jc.ContactStabilized(), **options)
    initial = thrown(BLOCKS, "upper", [0.1, -0.3])
    return stepper, jc.simulate(stepper, steps=20, initial=initial)


@pytest.fixture(scope="module")
def fall(blocks):
    stepper, motion = fall_of(blocks)
    assert np.count_nonzero(motion.active) > 20
    return stepper, motion


def test_adjoint_across_two_bodies_is_the_transpose(fall):

    def cost(trajectory):
        return jnp.sum(trajectory.displacement[-1] ** 2)

    initial = thrown(BLOCKS, "upper", [0.1, -0.3])
    report = jc.derivative_report(fall[0], None, cost, steps=20, initial=initial)
    assert report.duality_gap < 1e-10
    assert report.adjoint_residual < 1e-10


@pytest.mark.parametrize(
    "options",
    [
        {"linear_solver": jc.Dense()},
        {"linear_solver": jc.NestedDissection(leaf_size=8)},
        {"linear_solver": jc.ConjugateGradient()},
        {"contact_solver": jc.ProjectedGaussSeidel(max_sweeps=10_000)},
    ],
    ids=["dense", "dissection", "gradients", "gauss-seidel"],
)
def test_solvers_agree_on_two_bodies(blocks, fall, options):
    found = fall_of(blocks, **options)[1].displacement
    np.testing.assert_allclose(found, fall[1].displacement, atol=1e-9)


def test_reduced_model_of_two_bodies_follows_the_full_one(blocks, fall):
    reduced = jc.reduce(blocks, modes=32)
    found = fall_of(reduced)[1].displacement
    size = np.max(np.abs(fall[1].displacement))
    assert reduced.size < blocks.size - 5
    np.testing.assert_allclose(found, fall[1].displacement, atol=2e-2 * size)


def test_trapezoidal_keeps_the_momentum_of_two_bodies():
    scene = touching(round_bodies(), "ball/contact", "floor/contact")
    system = jc.discretize(scene)
    stepper = jc.prepare(system, 0.1, scheme=jc.Trapezoidal())
    motion = jc.simulate(stepper, steps=40, initial=thrown(scene, "ball", [0.0, -0.1]))
    assert np.any(motion.active)
    kept = momenta(system, motion, scene.mesh.points)
    assert np.max(np.abs(kept - kept[0])) < KEPT * np.max(np.abs(kept[0]))


def test_bodies_that_penetrate_at_the_start_are_refused():
    scene = touching(stacked(1 / 3, 1 / 2, gap=-0.02))
    stepper = jc.prepare(jc.discretize(scene), 0.05)
    with pytest.raises(ValueError, match=r"penetrates .* at 3 contact nodes.* 0.02 m"):
        jc.simulate(stepper, steps=1)


def test_static_bodies_share_a_uniform_pressure():
    # Pressed together by 0.1 in all, no lateral strain: each body takes half of it.
    elastic = jc.KelvinVoigt(young=2.0, poisson=0.0)
    held = ("lower/bottom", "upper/top")
    scene = touching(stacked(1 / 3, 1 / 2, angle=0.3), material=elastic, clamped=held)
    system = jc.discretize(scene)
    solution = jc.solve_static(system.with_gap(system.gap - 0.1))
    np.testing.assert_allclose(solution.contact_pressure, 0.1, rtol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(solution.displacement[system.contact_nodes], axis=1), 0.05, rtol=1e-9
    )


def test_static_round_bodies_meet_as_hertz_says_on_other_meshes():
    # Two half discs of one radius against each other are one against the plane between them.
    radius, depth, n = 15.0, 0.3, 24
    upper = jc.meshes.half_disc(radius, h=radius / n)
    lower = jc.meshes.half_disc(radius, h=1.5 * radius / n)
    lower = lower.moved(np.diag([-1.0, -1.0]), [0.0, -2.0 * radius])
    down, plane = np.array([0.0, -1.0]), jc.HalfSpace([0.0, -radius], [0.0, 1.0])
    two = jc.Scene(
        jc.join({"upper": upper, "lower": lower}),
        RUBBER,
        clamped=("upper/clamped", "lower/clamped"),
        contact={"upper/contact": jc.Facets("lower/contact", along=down)},
    )
    one = jc.Scene(upper, RUBBER, clamped=("clamped",), contact={"contact": plane})

    def pressed(scene, depth):
        system = jc.discretize(scene)
        return jc.solve_static(system.with_gap(system.gap - depth))

    alone, both = pressed(one, depth), pressed(two, 2.0 * depth)
    load = np.sum(both.contact_force)
    np.testing.assert_allclose(load, np.sum(alone.contact_force), rtol=5e-3)
    # Hertz: half-width a^2 = 4 P R / (pi E), with R and E of both bodies together.
    modulus = RUBBER.young / (1.0 - RUBBER.poisson**2) / 2.0
    width = np.sqrt(4.0 * load * 0.5 * radius / (np.pi * modulus))
    x = two.mesh.points[jc.discretize(two).contact_nodes, 0]
    expected = 2.0 * load / (np.pi * width) * np.sqrt(np.maximum(1.0 - (x / width) ** 2, 0.0))
    error = np.linalg.norm(both.contact_pressure - expected) / np.linalg.norm(expected)
    assert error < 0.05


def test_outputs_take_two_bodies(fall, tmp_path):
    stepper, motion = fall
    force = np.asarray(jc.contact_force(motion))
    pressure = np.asarray(jc.contact_pressure(stepper, motion))
    np.testing.assert_allclose(pressure @ stepper.system.contact_area, force, rtol=1e-12)
    assert 0.0 < float(jc.contact_time(motion, force_scale=1e-3)) < motion.time[-1]
    pytest.importorskip("matplotlib")
    jc.plot.plot_mesh(BLOCKS.mesh, motion.displacement[-1])
    jc.plot.plot_contact_force(stepper.system, motion, 20)
    jc.plot.plot_active_set(stepper.system, motion)
    files = jc.export.write_time_series(
        tmp_path / "two.pvd", BLOCKS.mesh, stepper.system, motion, every=10
    )
    assert len(files) == 4


def test_scene_of_two_rubber_bodies_survives_a_rebuild():
    scene = touching(stacked(1 / 3, 1 / 2))
    again = jax.tree.map(lambda x: x, scene)
    assert again.contact["upper/bottom"] == jc.Facets("lower/top")
    np.testing.assert_array_equal(jc.discretize(again).gap, jc.discretize(scene).gap)
    assert scene.material is RUBBER
