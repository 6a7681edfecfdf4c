"""Gradients by everything in a scene, by every scheme, and where those of contact usually break."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.independent import assemble, tracking_gradient
from support.independent import simulate as simulate_independently
from support.thrown_bodies import (
    DT,
    MESHES,
    STEPS,
    cost,
    motion,
    parameters,
    stepper_of,
    thrown,
    unloaded,
    up,
    value_and_gradient,
)

import jaxcontact as jc

#: Taylor remainders fall by 4 +- 7 % per halved step: order 2 +- 0.1.
ORDER = 0.1
#: Error of central differences, beside their rounding: third derivatives at the step 1e-5.
DIFFERENCE = 1e-6
#: Rounding of the cost, of about a thousand additions, relative to its size.
ROUNDING = 64 * np.finfo(float).eps
#: Two ways to add the same numbers.
AGREEMENT = 1e-10


@cache
def scene_gradient(dimension, scheme, obstacle):
    """Values and the program of cost and gradient, from the values of a scene to the motion"""

    def value(values):
        return cost(motion(dimension, values, scheme))

    return parameters(dimension, obstacle), jax.jit(jax.value_and_grad(value))


def check_every_parameter(dimension, scheme=None, obstacle="plane"):
    values, evaluate = scene_gradient(dimension, scheme, obstacle)
    leaves, structure = jax.tree.flatten(values)
    paths = jax.tree_util.tree_flatten_with_path(values)[0]
    rng = np.random.default_rng(0)
    base, gradient = evaluate(values)
    base = float(base)
    assert np.any(gradient["obstacle"]["center" if obstacle == "ball" else "point"]), "no contact"
    for i, ((path, leaf), slope) in enumerate(zip(paths, jax.tree.leaves(gradient), strict=True)):
        name = jax.tree_util.keystr(path)
        size = max(float(jnp.max(jnp.abs(leaf))), 1e-2)
        direction = jnp.asarray(size * rng.choice([-1.0, 1.0], size=leaf.shape))
        if name in ("['points']", "['obstacle']['center']", "['obstacle']['radius']"):
            # Lengths, to be compared with the gap and not with the size of the body.
            direction = 0.02 * direction

        def at(h, i=i, direction=direction):
            moved = [*leaves[:i], leaves[i] + h * direction, *leaves[i + 1 :]]
            return float(evaluate(jax.tree.unflatten(structure, moved))[0])

        derivative = float(jnp.vdot(slope, direction))
        assert np.isfinite(derivative), name
        h = 1e-5
        central = (at(h) - at(-h)) / (2 * h)
        bound = DIFFERENCE * abs(derivative) + ROUNDING * abs(base) / h
        assert abs(central - derivative) <= bound, (name, central, derivative)

        # Large steps may cross a kink, small ones drown in rounding: look just above rounding.
        steps = 4e-4 * 0.5 ** np.arange(11)
        remainders = np.array([abs(at(h) - base - h * derivative) for h in steps])
        # Trapezoidal amplifies rounding at contact.
        amplification = 80 if isinstance(scheme, jc.Trapezoidal) else 20
        floor = amplification * ROUNDING * max(abs(base), abs(derivative))
        usable = remainders[: int(np.argmax(np.append(remainders <= floor, True)))]
        is_cut = usable.size < steps.size
        if usable.size < 3 or (is_cut and usable[-1] > 16 * floor):
            continue  # affine along this parameter, up to the next kink
        orders = np.log2(usable[:-1] / usable[1:])[-2:]
        assert np.all(np.abs(orders - 2.0) <= ORDER), (name, orders)


SLOW = pytest.mark.slow
EVERY_OBSTACLE = [
    (1, "plane"),
    (2, "plane"),
    (3, "ball"),
    pytest.param(2, "ball", marks=SLOW),
    pytest.param(3, "plane", marks=SLOW),
]


@pytest.mark.parametrize(("dimension", "obstacle"), EVERY_OBSTACLE)
def test_gradient_by_every_parameter_is_exact(dimension, obstacle):
    check_every_parameter(dimension, obstacle=obstacle)


#: Every scheme but the default; those with contact forces of their own kind in the plane.
EVERY_SCHEME = [
    (2, jc.ContactStabilized()),
    (2, jc.RedistributedMass()),
    (1, jc.BackwardEuler()),
    (1, jc.Trapezoidal()),
]


@pytest.mark.parametrize(("dimension", "scheme"), EVERY_SCHEME, ids=str)
def test_gradient_by_every_parameter_is_exact_for_every_scheme(dimension, scheme):
    check_every_parameter(dimension, scheme)


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("scheme", [scheme for _, scheme in EVERY_SCHEME], ids=str)
def test_gradient_by_every_parameter_is_exact_for_every_scheme_in_1d_2d_and_3d(scheme, dimension):
    check_every_parameter(dimension, scheme)


def test_gradient_by_the_normal_in_1d_is_zero():
    # Only its direction counts.
    values, evaluate = scene_gradient(1, None, "plane")
    np.testing.assert_allclose(evaluate(values)[1]["obstacle"]["normal"], 0.0, atol=1e-12)


def test_gradient_at_traced_zero_viscosity_is_one_sided_in_viscosity():
    values, evaluate = scene_gradient(2, None, "plane")

    def at(viscosity):
        material = values["material"] | {
            "bulk_viscosity": jnp.asarray(0.0, float),
            "shear_viscosity": jnp.asarray(viscosity, float),
        }
        return evaluate(values | {"material": material})

    (base, gradient), h = at(0.0), 1e-6
    slope = float(gradient["material"]["shear_viscosity"])
    assert abs(float(at(h)[0] - base) / h - slope) <= 1e-4 * abs(slope)


def test_gradient_by_materials_of_the_regions_of_an_elastic_body_is_exact():
    base, half = MESHES[2], MESHES[2].n_cells // 2
    regions = {"left": np.arange(half), "right": np.arange(half, base.n_cells)}
    mesh = jc.Mesh.from_arrays(base.points, base.cells, base.facets, regions)
    fall = jnp.broadcast_to(jnp.array([0.0, -1.0]), mesh.points.shape)
    start = jc.State(jnp.zeros_like(fall), fall)

    @jax.jit
    @jax.value_and_grad
    def evaluate(moduli):
        material = {name: jc.KelvinVoigt(**values) for name, values in moduli.items()}
        plane = jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.0, 1.0]))
        system = jc.discretize(jc.Scene(mesh, material, contact={"bottom": plane}))
        assert system.viscosity is None
        trajectory = jc.simulate(jc.prepare(system, DT), steps=STEPS, initial=start)
        return jnp.sum(trajectory.contact_impulse**2)

    moduli = {name: {"young": 100.0, "poisson": 0.3, "density": 1.0} for name in regions}
    value, gradient = evaluate(moduli)
    for region in regions:
        for name, slope in gradient[region].items():
            h = 1e-5 * moduli[region][name]
            ahead, behind = (
                evaluate(moduli | {region: moduli[region] | {name: moduli[region][name] + s}})[0]
                for s in (h, -h)
            )
            bound = DIFFERENCE * abs(float(slope)) + ROUNDING * float(value) / h
            assert abs(float(ahead - behind) / (2 * h) - float(slope)) <= bound, (region, name)
            assert abs(float(slope)) > bound


def falling(gap, speed, force=0.0, dt=DT, viscosity=1e-3):
    """Stepper, control and initial state of a body at the gap and speed of approach"""
    control, rng = thrown()[1], np.random.default_rng(7)
    velocity = jnp.asarray(-speed * up(2) + 0.01 * rng.normal(size=control.shape[1:]))
    values = unloaded(2, gap, force, dt, bulk_viscosity=viscosity, shear_viscosity=viscosity)
    initial = jc.State(jnp.zeros_like(velocity), velocity)
    return stepper_of(2, values), jnp.zeros_like(control), initial


#: What of (step, pair) is in strong contact, from the options of a fall.
PHASES = {
    "free flight": (dict(gap=1.0, speed=0.5), lambda strong: not strong.any()),
    "impact": (dict(gap=0.2, speed=1.0), lambda strong: not strong[:15].any() and strong[-1].any()),
    "lift-off": (dict(gap=0.03, speed=1.0), lambda strong: strong.any() and not strong[-1].any()),
    "all pairs pressed": (dict(gap=0.0, speed=0.5, force=5.0), lambda strong: strong[0].all()),
    "bounces that come to rest": (
        dict(gap=0.0, speed=0.0, force=5.0, viscosity=1.0, dt=0.1),
        lambda strong: strong[-1].all(),
    ),
}


@pytest.mark.parametrize("phase", PHASES)
def test_gradient_is_finite_and_right_in_every_phase(phase):
    options, is_expected = PHASES[phase]
    stepper, control, initial = falling(**options)
    trajectory = jc.simulate(stepper, control, initial=initial)
    assert is_expected(np.asarray(trajectory.strong)), phase
    value, gradient = value_and_gradient(stepper, control, initial)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(gradient))
    rng = np.random.default_rng(1)
    for name in ("control", "velocity"):
        size = {"control": 1.0, "velocity": 0.0}[name]
        along = jnp.asarray(size * rng.normal(size=control.shape))
        push = jnp.asarray((1.0 - size) * rng.normal(size=initial.velocity.shape))
        h = 1e-6

        def at(s, along=along, push=push):
            state = jc.State(initial.displacement, initial.velocity + s * push)
            return float(value_and_gradient(stepper, control + s * along, state)[0])

        derivative = float(jnp.vdot(gradient[0], along) + jnp.vdot(gradient[1].velocity, push))
        bound = DIFFERENCE * abs(derivative) + ROUNDING * abs(float(value)) / h
        assert abs((at(h) - at(-h)) / (2 * h) - derivative) <= bound, name


@pytest.mark.slow
def test_gradient_through_ten_thousand_steps_is_right():
    stepper, _, initial = falling(0.03, 1.0, force=2.0, viscosity=1.0)

    @jax.jit
    @jax.value_and_grad
    def evaluate(velocity):
        start = jc.State(initial.displacement, velocity)
        final = jc.simulate(stepper, steps=10_000, initial=start).velocity[-1]
        return jnp.sum(jnp.linspace(1.0, 2.0, final.size).reshape(final.shape) * final)

    gradient = evaluate(initial.velocity)[1]
    assert np.all(np.isfinite(gradient))
    direction = jnp.ones_like(gradient)
    h = 1e-6
    ahead, behind = (evaluate(initial.velocity + s * h * direction)[0] for s in (1.0, -1.0))
    # At rest after many bounces: the end forgets the start, up to rounding.
    scale = 1e-9 / h
    assert abs(float(ahead - behind) / (2 * h) - float(jnp.vdot(gradient, direction))) <= scale


def test_gradient_of_a_failed_step_is_nan_and_never_zero():
    # One sweep is not enough where pairs are coupled.
    stepper, control, initial = falling(0.0, 0.5, force=5.0)
    stepper = jc.with_contact(stepper, jc.ProjectedGaussSeidel(max_sweeps=1))
    value, gradient = value_and_gradient(stepper, control, initial)
    by_velocity = np.asarray(gradient[1].velocity)
    assert np.isnan(value)
    assert np.all(np.isnan(by_velocity) | (by_velocity != 0.0))
    assert np.any(np.isnan(by_velocity))


def test_gradient_of_a_nan_control_is_nan():
    stepper, control, initial = thrown()
    gradient = value_and_gradient(stepper, control.at[3, 2, 0].set(jnp.nan), initial)[1][0]
    assert np.all(np.isnan(gradient[:3]))


@jax.jit
def final_product(stepper, control, weight):
    """The product of the final displacement with a weight, and its derivative by the control"""

    def product(control):
        return jnp.vdot(weight, jc.simulate(stepper, control).displacement[-1])

    return jax.value_and_grad(product)(control)


def test_gradient_of_a_body_without_a_contact_set_is_the_one_of_free_motion():
    material = jc.KelvinVoigt(young=100.0, poisson=0.3, bulk_viscosity=0.1, shear_viscosity=0.1)
    free = jax.jit(lambda: jc.prepare(jc.discretize(jc.Scene(MESHES[2], material)), DT))()
    control, rng = thrown()[1], np.random.default_rng(0)
    weight, direction = rng.normal(size=control.shape[1:]), rng.normal(size=control.shape)
    value, gradient = final_product(free, control, weight)
    # Free motion is linear.
    change = final_product(free, control + direction, weight)[0] - value
    np.testing.assert_allclose(jnp.vdot(gradient, direction), change, rtol=1e-9)
    far, _, _ = falling(100.0, 0.0, viscosity=0.1)
    rest = jc.State(*jnp.zeros((2, *control.shape[1:])))
    final = jc.simulate(far, control, initial=rest).displacement[-1]
    np.testing.assert_allclose(value, jnp.vdot(weight, final), rtol=AGREEMENT)
    # A rigid translation: under f the height rises by dt^2 f / rho times the steps that remain.
    mean_height = np.zeros(control.shape[1:])
    mean_height[:, 1] = 1.0 / len(mean_height)
    by_force = jnp.sum(final_product(free, control, mean_height)[1][:, :, 1], axis=1)
    np.testing.assert_allclose(by_force, DT**2 * (STEPS - 0.5 - np.arange(STEPS)), rtol=1e-10)


@jax.jit
def transpose_error(young, viscosity, height, tilt, control, direction, weight):
    """<J' du, w> - <du, J'* w> of the end of a motion, relative, and the number of contacts"""
    scene = jc.Scene(
        MESHES[2],
        jc.KelvinVoigt(young=young, poisson=0.3, shear_viscosity=viscosity),
        contact={
            "bottom": jc.HalfSpace(jnp.stack([0.0, -0.12 * (1.0 + height)]), jnp.stack([tilt, 1.0]))
        },
    )
    fall = jnp.zeros(control.shape[1:]).at[:, 1].set(-2.0)
    initial = jc.State(jnp.zeros_like(fall), fall)
    stepper = jc.prepare(jc.discretize(scene), DT)

    def end(u, choice=None):
        trajectory = jc.simulate(stepper, u, initial=initial, weak_contact=choice)
        return jnp.concatenate(
            [
                trajectory.velocity[-1].ravel(),
                trajectory.displacement.ravel(),
                trajectory.contact_impulse.ravel(),
            ]
        ), jnp.sum(trajectory.active)

    _, tangent, count = jax.jvp(
        lambda u: end(u, jc.ClosedBranch()), (control,), (direction,), has_aux=True
    )
    cotangent = jnp.resize(weight, tangent.shape)
    _, pull, _ = jax.vjp(end, control, has_aux=True)
    pulled = pull(cotangent)[0]
    first, second = jnp.vdot(tangent, cotangent), jnp.vdot(direction, pulled)
    return (first - second) / (jnp.linalg.norm(tangent) * jnp.linalg.norm(cotangent)), count


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**31),
    young=st.floats(10.0, 1e4),
    viscosity=st.floats(0.0, 1.0),
    height=st.floats(0.0, 1.0),
    tilt=st.floats(-0.1, 0.1),
)
def test_adjoint_of_a_random_scene_is_the_transpose_of_its_derivative(
    seed, young, viscosity, height, tilt
):
    rng = np.random.default_rng(seed)
    control, direction = jnp.asarray(rng.normal(size=(2, STEPS, MESHES[2].n_nodes, 2)))
    weight = jnp.asarray(rng.normal(size=97))
    error, _ = transpose_error(young, viscosity, height, tilt, 5.0 * control, direction, weight)
    assert abs(float(error)) <= AGREEMENT


def test_random_scenes_of_the_transpose_test_have_contact():
    control = jnp.zeros((STEPS, MESHES[2].n_nodes, 2))
    ones = jnp.ones_like(control)
    _, count = transpose_error(100.0, 0.1, 0.5, 0.05, control, ones, jnp.ones(97))
    assert int(count) > 5


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=15 / 4)


@pytest.fixture(scope="module")
def tracking(problem):
    """A control, and the program of the tracking cost and its L2 gradient"""
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, size=problem.reference.shape)
    evaluate = jax.jit(jc.l2_value_and_grad(problem.objective, problem.system, problem.dt))
    return problem.reference + 0.5 * noise, evaluate


@pytest.mark.parametrize("name", ["gradient", 1, 2])
def test_gradient_of_the_tracking_cost_passes_the_taylor_test(problem, tracking, name):
    control, evaluate = tracking
    base, gradient = evaluate(control)
    if name == "gradient":
        along = gradient / jnp.max(jnp.abs(gradient))
    else:
        along = jnp.asarray(np.random.default_rng(name).uniform(-1.0, 1.0, size=control.shape))
    # Larger steps meet kinks, of which there are many.
    steps = 2e-4 / 2.0 ** np.arange(4)
    active = problem.simulate(control).active
    for moved in (control - steps[0] * along, control + steps[0] * along):
        np.testing.assert_array_equal(problem.simulate(moved).active, active)
    slope = float(jc.control_dot(problem.system, problem.dt, gradient, along))
    ahead = np.array([float(evaluate(control + s * along)[0]) for s in steps])
    behind = float(evaluate(control - steps[0] * along)[0])
    # Away from kinks the cost is a quadratic of the control, so that only rounding enters.
    np.testing.assert_allclose((ahead[0] - behind) / (2 * steps[0]), slope, rtol=1e-7)
    remainders = np.abs(ahead - float(base) - steps * slope)
    assert np.min(remainders) > 100 * np.finfo(float).eps * abs(float(base))
    np.testing.assert_allclose(np.log2(remainders[:-1] / remainders[1:]), 2.0, atol=ORDER)


def test_gradient_in_l2_is_the_backward_recursion_of_the_paper(problem, tracking):
    control, evaluate = tracking
    mesh, scale = problem.scene.mesh, problem.control_scale
    nodes = np.unique(mesh.facets["contact"])
    body = assemble(
        mesh.points, mesh.cells, np.unique(mesh.facets["clamped"]),
        [(i, np.array([0.0, -1.0]), mesh.points[i, 1] + 15.8) for i in nodes],
        young=1e8, poisson=0.3, bulk=1e4, shear=1e4,
    )  # fmt: skip
    load = scale * body.control_load(np.asarray(control))
    independent = simulate_independently(body, problem.dt, load)
    expected = tracking_gradient(
        body, problem.dt, independent, independent.active, np.asarray(problem.target),
        np.asarray(control), scale, problem.control_weight, problem.final_weight,
    )  # fmt: skip
    error = np.max(np.abs(evaluate(control)[1] - expected))
    assert error < AGREEMENT * np.max(np.abs(expected))
