"""Loads, obstacles and supports that change in time: exact cases, the ledger, derivatives."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from support.bodies import SCHEMES, VISCOUS
from support.two_bodies import FACES, stacked

import jaxcontact as jc

DT, STEPS = 0.01, 20
# Some ten steps of sums over 50 unknowns.
ROUNDING = 1e-12
SLOW = pytest.mark.slow
#: Every scheme, the default in the fast pass.
FIRST_FAST = [SCHEMES[0], *(pytest.param(x, marks=SLOW) for x in SCHEMES[1:])]


def press_scene(**changes):
    """A block that its top pushes on another one, which lies just above a floor"""
    floor = jc.HalfSpace(np.array([0.0, -0.005]), np.array([0.0, 1.0]))
    fields = {
        "mesh": stacked(0.5, 0.5, gap=0.01),
        "material": VISCOUS,
        "clamped": ("upper/top",),
        "contact": {"upper/bottom": jc.Facets("lower/top"), "lower/bottom": floor},
    }
    return jc.Scene(**fields | changes)


@cache
def press(scheme=None, dtype=jnp.float64):
    system = jax.jit(lambda: jc.discretize(press_scene(), dtype=dtype))()
    return jc.prepare(system, DT, scheme=scheme)


def everything(stepper, steps=STEPS):
    """A schedule of all kinds: press and floor meet the lower block, which is pushed about"""

    def at(function, levels=False):
        return jc.sample(function, stepper, steps, levels=levels)

    return jc.Schedule(
        traction={"lower/left": at(lambda t: jnp.stack([1.0 + t, jnp.sin(9.0 * t)]))},
        pressure={"lower/right": at(lambda t: 1.0 + jnp.cos(8.0 * t))},
        body_force=at(lambda t: jnp.stack([0.3 * t, -1.0])),
        obstacle={"lower/bottom": at(lambda t: jnp.stack([0.1 * t, 0.1 * t + t**2]), levels=True)},
        motion={"upper/top": at(lambda t: jnp.stack([0.1 * t, -0.4 * t - t**2]), levels=True)},
    )


def moving_wall(n, speed, scheme):
    """A wall that meets a resting bar within the first step"""
    wall = jc.HalfSpace(np.array([-0.3 * speed / n]), np.array([1.0]))
    bar = jc.meshes.interval(1.0, h=1.0 / n)
    scene = jc.Scene(bar, jc.KelvinVoigt(young=1.0, poisson=0.0), contact={"left": wall})
    stepper = jc.prepare(jc.discretize(scene), 1.0 / n, scheme=scheme)
    way = jc.sample(lambda t: jnp.array([speed]) * t, stepper, 3 * n, levels=True)
    return stepper, jc.Schedule(obstacle={"left": way})


def mean_velocity(system, velocity):
    mass = np.ravel(system.mass.scalar.to_scipy().sum(axis=0))
    return mass @ np.asarray(velocity)[:, 0] / mass.sum()


@pytest.mark.parametrize("scheme", SCHEMES[:3])
def test_moving_wall_throws_a_bar_with_twice_its_speed(scheme):
    stepper, schedule = moving_wall(50, 0.1, scheme)
    motion = jc.simulate(stepper, schedule=schedule)
    assert mean_velocity(stepper.system, motion.final.velocity) == pytest.approx(0.2, rel=0.015)
    ledger = jc.energy(stepper, motion)
    assert np.max(np.abs(ledger.residual)) < ROUNDING * ledger.total[-1]
    lost = np.sum(ledger.impact_loss + ledger.numerical_loss)
    assert np.sum(ledger.work) == pytest.approx(float(ledger.total[-1] + lost))
    assert np.min(ledger.impact_loss) > -1e-15
    assert np.min(motion.gap) > -1e-15
    thin = jc.simulate(stepper, schedule=schedule, save_every=50)
    np.testing.assert_allclose(thin.gap, motion.gap[::50], atol=1e-15)


@pytest.mark.parametrize(
    "scheme", [*SCHEMES[:3], *(pytest.param(x, marks=SLOW) for x in SCHEMES[3:])]
)
def test_moving_wall_is_a_moving_bar_seen_from_elsewhere(scheme):
    stepper, schedule = moving_wall(12, 0.1, scheme)
    motion = jc.simulate(stepper, schedule=schedule)
    flying = jnp.full((stepper.system.n_nodes, 1), -0.1)
    other = jc.simulate(stepper, steps=36, initial=jc.State(0.0 * flying, flying))
    assert np.any(motion.active)
    way = 0.1 * np.asarray(motion.time)[:, None, None]
    np.testing.assert_allclose(motion.displacement, other.displacement + way, atol=ROUNDING)
    np.testing.assert_allclose(motion.gap, other.gap, atol=ROUNDING)
    np.testing.assert_allclose(motion.contact_impulse, other.contact_impulse, atol=ROUNDING)


def test_loads_constant_in_time_are_those_of_the_scene():
    pull, weight = np.array([1.0, -0.5]), np.array([0.2, -1.0])
    schedule = jc.Schedule(
        traction={"lower/left": np.tile(pull, (STEPS, 1))},
        pressure={"lower/right": np.full(STEPS, 0.7)},
        body_force=np.tile(weight, (STEPS, 1)),
    )
    loads = {"lower/left": pull, "lower/right": np.array([-0.7, 0.0])}
    scene = press_scene(traction=loads, body_force=weight)
    expected = jc.simulate(jc.prepare(jc.discretize(scene), DT), steps=STEPS)
    motion = jc.simulate(press(), schedule=schedule)
    assert np.any(motion.active)
    np.testing.assert_allclose(motion.displacement, expected.displacement, atol=1e-15)
    np.testing.assert_allclose(motion.velocity, expected.velocity, atol=1e-13)


@pytest.mark.parametrize("scheme", FIRST_FAST)
def test_energy_balances_with_the_work_of_everything_that_moves(scheme):
    stepper = press(scheme)
    motion = jc.simulate(stepper, schedule=everything(stepper))
    ledger = jc.energy(stepper, motion)
    assert np.all(np.any(np.asarray(motion.active), axis=0))
    assert np.max(np.abs(ledger.residual)) < ROUNDING * np.max(ledger.total)
    np.testing.assert_allclose(np.diff(ledger.total), ledger.change, atol=ROUNDING)
    if scheme in SCHEMES[:2]:
        assert np.max(np.abs(ledger.numerical_loss)) < 1e-3 * np.max(ledger.total)


@pytest.mark.parametrize("scheme", FIRST_FAST)
def test_body_follows_its_clamped_set_rigidly(scheme):
    far = jc.HalfSpace(np.array([0.0, -9.0]), np.array([0.0, 1.0]))
    mesh = jc.meshes.rectangle((1.0, 0.5), h=0.25)
    scene = jc.Scene(mesh, VISCOUS, clamped=("top",), contact={"bottom": far})
    stepper = jc.prepare(jc.discretize(scene), DT, scheme=scheme)
    speed = np.array([0.3, -0.2])
    way = jc.sample(lambda t: speed * t, stepper, STEPS, levels=True)
    flying = jnp.broadcast_to(jnp.asarray(speed), mesh.points.shape)
    initial = jc.State(0.0 * flying, flying)
    motion = jc.simulate(stepper, schedule=jc.Schedule(motion={"top": way}), initial=initial)
    np.testing.assert_allclose(motion.velocity, np.tile(flying, (STEPS + 1, 1, 1)), atol=1e-13)
    np.testing.assert_allclose(motion.displacement, jnp.tile(way[:, None], (1, 15, 1)), atol=1e-14)
    ledger = jc.energy(stepper, motion)
    kinetic = 0.5 * 0.5 * speed @ speed
    np.testing.assert_allclose(ledger.kinetic, kinetic, rtol=1e-13)
    for flow in (ledger.elastic, ledger.work, ledger.residual, ledger.viscous_loss):
        assert np.max(np.abs(flow)) < 1e-13


def test_moved_support_equals_an_elimination_of_all_nodes():
    block = jc.meshes.rectangle((1.0, 0.5), h=0.25)
    regions = {"stiff": np.arange(5), "soft": np.arange(5, block.n_cells)}
    mesh = jc.Mesh.from_arrays(block.points, block.cells, block.facets, regions)
    material = {"stiff": replace(VISCOUS, young=300.0, density=2.0), "soft": VISCOUS}
    stepper = jc.prepare(jc.discretize(jc.Scene(mesh, material, clamped=("top", "bottom"))), DT)
    way = jc.sample(lambda t: jnp.stack([t, 0.2 * jnp.sin(9.0 * t)]), stepper, STEPS, levels=True)
    motion = jc.simulate(stepper, schedule=jc.Schedule(motion={"top": way}))

    free_body = jc.discretize(jc.Scene(mesh, material))
    M, A, B = (
        x.to_scipy().toarray() for x in (free_body.mass, free_body.stiffness, free_body.viscosity)
    )
    top, bottom = (np.unique(mesh.facets[name]) for name in ("top", "bottom"))
    held = np.concatenate([(2 * nodes[:, None] + [0, 1]).ravel() for nodes in (top, bottom)])
    free = np.setdiff1d(np.arange(len(M)), held)
    g = np.zeros((STEPS + 1, held.size))
    g[:, : 2 * top.size] = np.tile(way, (1, top.size))
    rate = np.gradient(g, DT, axis=0, edge_order=2)
    y, v = np.zeros((2, free.size))
    ff, fc = np.ix_(free, free), np.ix_(free, held)
    D = M + DT / 2 * B + DT**2 / 4 * A
    for k in range(STEPS):
        pull = A[fc] @ (g[k] + g[k + 1]) / 2 + B[fc] @ (g[k + 1] - g[k]) / DT
        pull += M[fc] @ (rate[k + 1] - rate[k]) / DT
        w = np.linalg.solve(D[ff], M[ff] @ v - DT / 2 * (A[ff] @ y + pull))
        y, v = y + DT * w, 2 * w - v
    np.testing.assert_allclose(np.ravel(motion.displacement[-1])[free], y, atol=ROUNDING)
    np.testing.assert_allclose(np.ravel(motion.displacement[-1])[held], g[-1], atol=1e-15)
    np.testing.assert_allclose(np.ravel(motion.velocity[-1])[held], rate[-1], atol=ROUNDING)
    ledger = jc.energy(stepper, motion)
    x, u = np.ravel(motion.displacement[-1]), np.ravel(motion.velocity[-1])
    assert ledger.elastic[-1] == pytest.approx(0.5 * x @ A @ x, rel=1e-12)
    assert ledger.kinetic[-1] == pytest.approx(0.5 * u @ M @ u, rel=1e-12)
    assert np.max(np.abs(ledger.residual)) < ROUNDING * ledger.total[-1]


def test_moved_clamped_body_is_a_moved_obstacle():
    mesh = stacked(0.25, 0.125, 1, gap=0.01)
    slave, master = FACES[1]
    plane = jc.HalfSpace(np.array([1.0]), np.array([1.0]))
    motions = []
    for obstacle, clamped in ((jc.Facets(master), (master,)), (plane, ())):
        scene = jc.Scene(mesh, VISCOUS, clamped=clamped, contact={slave: obstacle})
        stepper = jc.prepare(jc.discretize(scene), DT)
        way = jc.sample(lambda t: jnp.array([2.0]) * t, stepper, STEPS, levels=True)
        moves = {"motion": {master: way}} if clamped else {"obstacle": {slave: way}}
        motions.append(jc.simulate(stepper, schedule=jc.Schedule(**moves)))
    upper = np.unique(mesh.cells[mesh.regions["upper"]])
    first, second = (np.asarray(motion.displacement)[:, upper] for motion in motions)
    assert np.any(motions[0].active)
    np.testing.assert_allclose(first, second, atol=ROUNDING)
    np.testing.assert_allclose(motions[0].gap, motions[1].gap, atol=ROUNDING)


@jax.jit
def cost_of(schedule, stepper):
    motion = jc.simulate(stepper, schedule=schedule)
    weight = jnp.linspace(1.0, 2.0, motion.displacement[-1].size).reshape(-1, 2)
    return jnp.sum(weight * motion.displacement[-1]) + jnp.sum(motion.contact_impulse**2)


def test_derivative_by_every_amplitude_is_right():
    stepper = press()
    schedule = everything(stepper)
    report = jc.check_gradient(lambda x: cost_of(x, stepper), schedule)
    assert report.verdict == jc.Verdict.RIGHT, report
    assert np.all(np.abs(report.order - 2.0) < 0.1)


def test_adjoint_of_the_schedule_passes_the_dot_product_test():
    stepper = press()
    schedule, rng = everything(stepper), np.random.default_rng(0)
    directions = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), schedule)

    def positions(schedule):
        motion = jc.simulate(stepper, schedule=schedule, weak_contact=jc.ClosedBranch())
        return motion.displacement, motion.contact_impulse

    @jax.jit
    def products(schedule, direction):
        values, forward = jax.jvp(positions, (schedule,), (direction,))
        back = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size) * 1.0).reshape(x.shape), values)
        gradient = jax.vjp(positions, schedule)[1](back)[0]

        def dot(x, y):
            pairs = zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True)
            return sum(jnp.sum(a * b) for a, b in pairs)

        return dot(forward, back), dot(direction, gradient)

    forward, backward = map(float, products(schedule, directions))
    assert forward == pytest.approx(backward, rel=1e-10)


def test_directional_derivative_by_a_schedule_is_that_of_differences():
    stepper, schedule = moving_wall(12, 0.1, None)

    def final(factor):
        scaled = jax.tree.map(lambda x: factor * x, schedule)
        return jc.simulate(stepper, schedule=scaled).displacement[-1]

    tangent = jc.directional_derivative(
        stepper, None, schedule=schedule, schedule_direction=schedule
    )
    step = 1e-6
    central = (final(1.0 + step) - final(1.0 - step)) / (2.0 * step)
    np.testing.assert_allclose(tangent.displacement[-1], central, atol=1e-8)
    with pytest.raises(ValueError, match="shapes of the schedule"):
        jc.directional_derivative(
            stepper, None, schedule=schedule, schedule_direction=jc.Schedule(gap=np.zeros((37, 1)))
        )


def test_no_array_holds_every_unknown_of_every_step():
    stepper, steps = press(), 60
    schedule = everything(stepper, steps)

    def run(schedule):
        return jc.simulate(stepper, schedule=schedule, save_every=steps).displacement[-1]

    def sizes(jaxpr):
        for equation in jaxpr.eqns:
            yield from (np.prod(x.aval.shape) for x in equation.outvars)
            for inner in jaxprs_in_params(equation.params):
                yield from sizes(inner)

    n = stepper.system.size
    jaxpr = jax.make_jaxpr(jax.grad(lambda x: jnp.sum(run(x))))(schedule).jaxpr
    # Two recorded states of displacement and velocity, and the matrices of the system.
    matrix = max(np.size(x) for x in jax.tree.leaves(stepper))
    assert max(sizes(jaxpr)) <= max(4 * n, matrix) < steps * n


def test_jit_batch_checkpoint_and_thinned_states_agree():
    stepper = press()
    schedule = everything(stepper)
    motion = jc.simulate(stepper, schedule=schedule)
    factors = jnp.array([1.0, 0.7])

    @jax.jit
    def final(stepper, factor):
        scaled = jax.tree.map(lambda x: factor * x, schedule)
        return jc.simulate(stepper, schedule=scaled).displacement[-1]

    batch = jax.vmap(final, (None, 0))(stepper, factors)
    np.testing.assert_allclose(batch[0], motion.final.displacement, atol=ROUNDING)
    np.testing.assert_allclose(batch[1], final(stepper, 0.7), atol=ROUNDING)
    thin = jc.simulate(stepper, schedule=schedule, save_every=5, checkpoint=jc.Checkpoint(2))
    for name in ("displacement", "velocity", "gap"):
        every = np.asarray(getattr(motion, name))[::5]
        np.testing.assert_allclose(getattr(thin, name), every, atol=ROUNDING)


def test_schedule_works_in_single_precision():
    single, double = press(dtype=jnp.float32), press()
    motion = jc.simulate(single, schedule=everything(single))
    expected = jc.simulate(double, schedule=everything(double))
    assert motion.displacement.dtype == jnp.float32
    np.testing.assert_allclose(motion.displacement, expected.displacement, atol=1e-5)


def test_reduced_model_that_spans_everything_follows_a_schedule():
    slave, master = FACES[1]
    scene = jc.Scene(
        stacked(0.25, 0.25, 1, gap=0.01),
        VISCOUS,
        clamped=("upper/right",),
        contact={slave: jc.Facets(master)},
    )
    system = jc.discretize(scene)
    reduced = jc.reduce(system, system.size - 1)
    motions, schedule = [], None
    for each in (system, reduced):
        stepper = jc.prepare(each, DT)
        if schedule is None:
            way = jc.sample(lambda t: jnp.array([-0.5]) * t, stepper, STEPS, levels=True)
            schedule = jc.Schedule(motion={"upper/right": way}, pressure={master: np.ones(STEPS)})
        motions.append(jc.simulate(stepper, schedule=schedule))
        assert np.max(np.abs(jc.energy(stepper, motions[-1]).residual)) < ROUNDING
    assert np.any(motions[0].active)
    np.testing.assert_allclose(motions[1].displacement, motions[0].displacement, atol=1e-11)
    some = system.with_pairs([])
    with pytest.raises(ValueError, match="pairs that are taken to stay open"):
        jc.simulate(jc.prepare(some, DT), schedule=schedule)


def test_saved_system_follows_a_schedule(tmp_path):
    stepper = press()
    stepper.system.save(tmp_path / "press.npz")
    loaded = jc.prepare(jc.load_system(tmp_path / "press.npz"), DT)
    motions = [jc.simulate(x, schedule=everything(x)) for x in (stepper, loaded)]
    np.testing.assert_array_equal(motions[0].displacement, motions[1].displacement)


def test_motion_goes_on_from_its_last_state():
    stepper = press()
    way = jc.sample(lambda t: jnp.stack([0.0 * t, -0.3 * t]), stepper, STEPS, levels=True)
    whole = jc.simulate(stepper, schedule=jc.Schedule(motion={"upper/top": way}))
    half = STEPS // 2
    parts = [jc.Schedule(motion={"upper/top": x}) for x in (way[: half + 1], way[half:])]
    first = jc.simulate(stepper, schedule=parts[0])
    second = jc.simulate(stepper, schedule=parts[1], initial=first.final)
    np.testing.assert_allclose(second.displacement, whole.displacement[half:], atol=ROUNDING)


def test_sample_takes_middles_or_levels_of_any_function():
    stepper = press()
    middles = jc.sample(lambda t: t, stepper, 3)
    np.testing.assert_allclose(middles, DT * np.array([0.5, 1.5, 2.5]))
    levels = jc.sample(lambda t: np.array([np.sin(t), 1.0]), stepper, 3, levels=True)
    np.testing.assert_allclose(levels[:, 0], np.sin(DT * np.arange(4)))
    field = jc.sample(lambda t: t * stepper.system.points, stepper, 2)
    assert field.shape == (2, *stepper.system.points.shape)
    slope = jax.jacobian(lambda a: jc.sample(lambda t: a * t, stepper, 2))(1.0)
    np.testing.assert_allclose(slope, DT * np.array([0.5, 1.5]))
    with pytest.raises(ValueError, match="positive whole number"):
        jc.sample(lambda t: t, stepper, 0)


ROWS, LEVELS = np.zeros((STEPS, 2)), np.zeros((STEPS + 1, 2))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"traction": {"left": ROWS}}, r"traction names 'left'.*facet set.*'lower/left'"),
        ({"motion": {"lower/top": LEVELS}}, r"'lower/top', which is not a clamped.*'upper/top'"),
        ({"obstacle": {"upper/bottom": LEVELS}}, r"not a contact set with a rigid.*'lower/bottom'"),
        ({"traction": {"lower/left": ROWS[:, :1]}}, r"must have shape \(T, 2\), got \(20, 1\)"),
        ({"pressure": {"lower/left": ROWS}}, r"must have shape \(T,\), got"),
        ({"motion": {"upper/top": LEVELS[:, 0]}}, r"must have shape \(T\+1, 2\)"),
        ({"body_force": np.full((STEPS, 2), np.nan)}, "body_force holds values that are not"),
        ({"body_force": ROWS, "motion": {"upper/top": ROWS}}, r"one number of steps.*'body_force'"),
        ({"traction": ROWS}, "traction must be a mapping"),
        ({}, "one number of steps"),
        ({"gap": LEVELS}, r"gap must have shape \(T\+1, 6\)"),
    ],
)
def test_wrong_schedules_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        jc.simulate(press(), schedule=jc.Schedule(**fields))


def test_schedule_of_another_length_than_the_control_is_refused():
    stepper, schedule = press(), jc.Schedule(body_force=ROWS)
    control = jnp.zeros((3, *stepper.system.points.shape))
    for options in ({"control": control}, {"steps": 3}):
        with pytest.raises(ValueError, match="schedule is for 20 steps, but the motion has 3"):
            jc.simulate(stepper, schedule=schedule, **options)
    with pytest.raises(ValueError, match=r"schedule must be a jc\.Schedule"):
        jc.simulate(stepper, schedule={"body_force": ROWS})


def test_what_cannot_move_by_itself_is_refused():
    mesh = jc.meshes.rectangle((1.0, 0.5), h=0.25)
    floor = jc.HalfSpace(np.array([0.0, -0.1]), np.array([0.0, 1.0]))
    corner = jc.discretize(jc.Scene(mesh, VISCOUS, clamped=("top", "left")))
    with pytest.raises(ValueError, match="'top' shares nodes with another clamped set"):
        jc.simulate(jc.prepare(corner, DT), schedule=jc.Schedule(motion={"top": LEVELS}))
    shared = jc.discretize(jc.Scene(mesh, VISCOUS, contact={"bottom": floor, "left": floor}))
    with pytest.raises(ValueError, match="meet the obstacle of another contact set"):
        jc.simulate(jc.prepare(shared, DT), schedule=jc.Schedule(obstacle={"left": LEVELS}))


def test_start_that_the_moved_floor_penetrates_is_refused():
    way = LEVELS + np.array([0.0, 0.01])
    with pytest.raises(ValueError, match="penetrates the obstacle at 3 contact nodes"):
        jc.simulate(press(), schedule=jc.Schedule(obstacle={"lower/bottom": way}))
