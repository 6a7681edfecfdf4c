import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from support.bodies import BLOCK, DT, ELASTIC, VISCOUS, block, random_control, random_initial
from support.independent import assemble, tracking_gradient
from support.independent import simulate as simulate_independently

import jaxcontact as jc

# Away from kinks the cost is a quadratic of the control, so that only rounding enters.
DIFFERENCE_TOLERANCE = 1e-7
RECURSION_TOLERANCE = 1e-10
AGREEMENT = 1e-9
SLOPE_BAND = 0.1
STEPS = 30


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=15 / 4)


@pytest.fixture(scope="module")
def control(problem):
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, size=problem.reference.shape)
    return problem.reference + 0.5 * noise


@pytest.fixture(scope="module")
def derivative(problem, control):
    """The derivative of the objective by the nodal values of the control, (T, N, d)"""
    return jax.grad(problem.objective)(control)


def direction(name, derivative):
    """A direction whose largest entry is one"""
    if name == "gradient":
        return derivative / jnp.max(jnp.abs(derivative))
    return jnp.asarray(np.random.default_rng(name).uniform(-1.0, 1.0, size=derivative.shape))


def taylor_slopes(function, slope_at_zero, steps):
    """The orders of the remainder f(s) - f(0) - s f'(0) between successive steps"""
    base = function(0.0)
    remainders = np.array([abs(function(s) - base - s * slope_at_zero) for s in steps])
    # A remainder of rounding errors would prove nothing.
    assert np.min(remainders) > 100 * np.finfo(float).eps * abs(base)
    return np.log(remainders[:-1] / remainders[1:]) / np.log(steps[:-1] / steps[1:])


# Four step sizes, three slopes; larger steps meet kinks, of which there are many.
TAYLOR_STEPS = 2e-4 / 2.0 ** np.arange(4)


def assert_no_kink(problem, control, step):
    """The active sets do not change between control - step and control + step"""
    active = problem.simulate(control).active
    for moved in (control - step, control + step):
        np.testing.assert_array_equal(problem.simulate(moved).active, active)


@pytest.mark.parametrize("name", ["gradient", 1, 2, 3])
def test_gradient_of_the_tracking_cost_passes_the_taylor_test(problem, control, derivative, name):
    along = direction(name, derivative)
    assert_no_kink(problem, control, TAYLOR_STEPS[0] * along)
    slopes = taylor_slopes(
        lambda s: float(problem.objective(control + s * along)),
        float(jnp.vdot(derivative, along)),
        TAYLOR_STEPS,
    )
    np.testing.assert_allclose(slopes, 2.0, atol=SLOPE_BAND)


@pytest.mark.parametrize("name", ["gradient", 1, 2, 3])
def test_gradient_of_the_tracking_cost_agrees_with_central_differences(
    problem, control, derivative, name
):
    along, step = direction(name, derivative), TAYLOR_STEPS[0]
    assert_no_kink(problem, control, step * along)
    above, below = (float(problem.objective(control + s * along)) for s in (step, -step))
    expected = float(jnp.vdot(derivative, along))
    np.testing.assert_allclose((above - below) / (2 * step), expected, rtol=DIFFERENCE_TOLERANCE)


@pytest.fixture(scope="module")
def body(problem):
    mesh = problem.scene.mesh
    nodes = np.unique(mesh.facets["contact"])
    return assemble(
        mesh.points, mesh.cells, np.unique(mesh.facets["clamped"]),
        [(i, np.array([0.0, -1.0]), mesh.points[i, 1] + 15.8) for i in nodes],
        young=1e8, poisson=0.3, bulk=1e4, shear=1e4,
    )  # fmt: skip


def test_gradient_in_l2_is_the_backward_recursion_of_the_paper(problem, control, body):
    _, gradient = jc.l2_value_and_grad(problem.objective, problem.system, problem.dt)(control)
    scale = problem.control_scale
    load = scale * body.control_load(np.asarray(control))
    motion = simulate_independently(body, problem.dt, load)
    expected = tracking_gradient(
        body, problem.dt, motion, motion.active, np.asarray(problem.target),
        np.asarray(control), scale, problem.control_weight, problem.final_weight,
    )  # fmt: skip
    error = np.max(np.abs(gradient - expected))
    assert error < RECURSION_TOLERANCE * np.max(np.abs(expected))


def test_gradient_keeps_one_boolean_per_contact_node_and_step(problem, control):
    n_steps, n_pairs = problem.steps, problem.system.normals.count

    def cost(u, scale):
        return jnp.sum(jc.simulate(problem.stepper, scale * u).displacement[-1])

    (forward, _), _ = scans(jax.make_jaxpr(jax.grad(cost))(control, 1.0).jaxpr)
    recorded = jax.eval_shape(lambda u: jc.simulate(problem.stepper, u), control)
    expected = sorted(
        [
            *((n_steps, problem.system.size, "float64"),) * 2,  # displacement and velocity
            (n_steps, n_pairs, "float64"),  # impulse
            *((n_steps, n_pairs, "bool"),) * 2,  # active and weak
            *((n_steps, str(x.dtype)) for x in (recorded.iterations, recorded.status)),
            (n_steps, str(recorded.residual.dtype)),
        ],
        key=str,
    )
    outputs = [(*v.aval.shape, str(v.aval.dtype)) for v in forward.outvars]
    stacked = [entry for entry in outputs if entry[0] == n_steps]  # the others are carried
    # What is kept beyond the record.
    for entry in expected:
        if entry in stacked:
            stacked.remove(entry)
    booleans = [entry for entry in stacked if entry == (n_steps, n_pairs, "bool")]
    poison = [entry for entry in stacked if entry in {(n_steps, "float64"), (n_steps, "bool")}]
    assert len(booleans) <= 1
    assert len(poison) <= 1  # the NaN or one of the step
    assert len(stacked) == len(booleans) + len(poison), stacked


def scans(jaxpr):
    """All scan equations of a program with their depth, outermost first"""
    found = []

    def walk(jaxpr, depth):
        for equation in jaxpr.eqns:
            if equation.primitive.name == "scan":
                found.append((equation, depth))
                continue
            for sub in jaxprs_in_params(equation.params):
                walk(sub, depth + 1)

    walk(jaxpr, 0)
    return found


def test_gradient_under_jit_equals_the_gradient(problem, control, derivative):
    jitted = jax.jit(jax.grad(problem.objective))(control)
    error = np.max(np.abs(jitted - derivative))
    assert error < AGREEMENT * np.max(np.abs(derivative))


def test_gradient_compiles_nothing_for_a_new_control(problem, control, derivative, caplog):
    del derivative  # it was compiled for this one
    evaluate = jax.jit(jax.value_and_grad(problem.objective))
    jax.block_until_ready(evaluate(control))
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        jax.grad(problem.objective)(0.5 * control)
        evaluate(0.5 * control)
    compiled = [r.getMessage() for r in caplog.records if "Compiling" in r.getMessage()]
    assert not [name for name in compiled if "multiply" not in name]


def block_cost(stepper, control=None, initial=None, steps=STEPS):
    """A functional of all records that a step hands on"""
    motion = jc.simulate(stepper, control, initial=initial, steps=steps)
    return jnp.sum(motion.displacement**2) + 1e-2 * jnp.sum(jnp.sin(motion.velocity[-1]))


def test_gradient_under_vmap_over_controls_equals_the_loop():
    stepper = block()
    controls = jnp.stack([random_control(STEPS, seed) for seed in range(3)])
    gradient = jax.jit(jax.grad(lambda u: block_cost(stepper, u)))
    together = jax.jit(jax.vmap(gradient))(controls)
    for k, u in enumerate(controls):
        alone = gradient(u)
        assert np.max(np.abs(together[k] - alone)) < AGREEMENT * np.max(np.abs(alone))


def test_gradient_under_vmap_over_initial_states_equals_the_loop():
    stepper, control = block(), random_control(STEPS)
    states = [random_initial(seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    gradient = jax.jit(jax.grad(lambda s: block_cost(stepper, control, s)))
    together = jax.jit(jax.vmap(gradient))(stacked)
    for k, state in enumerate(states):
        alone = gradient(state)
        for found, expected in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            assert np.max(np.abs(found[k] - expected)) < AGREEMENT * np.max(np.abs(expected))


def test_gradient_is_the_same_with_both_contact_solvers():
    control = random_control(STEPS)
    newton, sweeps = (
        jax.grad(lambda u: block_cost(stepper, u))(control)  # noqa: B023
        for stepper in (block(), block(contact_solver=jc.ProjectedGaussSeidel()))
    )
    assert np.max(np.abs(newton - sweeps)) < AGREEMENT * np.max(np.abs(newton))


def scene_cost(parameters):
    """The functional of a slanted block as a function of everything that is not topology"""
    material = jc.KelvinVoigt(
        young=parameters["young"],
        poisson=parameters["poisson"],
        bulk_viscosity=parameters["bulk"],
        shear_viscosity=parameters["shear"],
        density=parameters["density"],
    )
    plane = jc.HalfSpace(parameters["point"], parameters["normal"])
    scene = jc.Scene(
        BLOCK.with_points(parameters["points"]),
        material,
        contact={"bottom": plane},
        body_force=parameters["force"],
        traction={"left": parameters["traction"]},
    )
    stepper = jc.prepare(jc.discretize(scene), parameters["dt"])
    state = jc.State(parameters["displacement"], parameters["velocity"])
    return block_cost(stepper, initial=state)


START = random_initial()
PARAMETERS = {
    "young": 100.0,
    "poisson": 0.3,
    "bulk": 0.2,
    "shear": 0.1,
    "density": 1.0,
    "point": np.array([0.0, -0.1]),
    "normal": np.array([0.1, 1.0]),
    "points": BLOCK.points,
    "force": np.array([1.0, -10.0]),
    "traction": np.array([0.5, 0.2]),
    "dt": DT,
    "displacement": START.displacement,
    "velocity": START.velocity,
}
# A direction in the rigid motions or in the material that is about one part of the value.
SIZES = {"displacement": 0.02, "velocity": 1.0, "point": 0.1, "points": 0.1, "normal": 0.1}


@pytest.fixture(scope="module")
def value_and_gradients():
    parameters = jax.tree.map(jnp.asarray, PARAMETERS)
    evaluate = jax.jit(scene_cost)
    return parameters, evaluate, jax.jit(jax.grad(scene_cost))(parameters)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PARAMETERS))
def test_gradient_by_every_parameter_of_a_scene_agrees_with_central_differences(
    value_and_gradients, name
):
    parameters, evaluate, gradients = value_and_gradients
    value = parameters[name]
    noise = jnp.asarray(np.random.default_rng(0).normal(size=jnp.shape(value)))
    along = SIZES[name] * noise if name in SIZES else value * (1.0 + 0.0 * noise)

    def shifted(s):
        return float(evaluate(parameters | {name: value + s * along}))

    # Fourth order: steps of 1e-4 leave rounding errors of 1e-11 and no visible remainder.
    h = 1e-4
    difference = (8 * (shifted(h) - shifted(-h)) - (shifted(2 * h) - shifted(-2 * h))) / (12 * h)
    np.testing.assert_allclose(jnp.vdot(gradients[name], along), difference, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["young", "dt", "density", "points"])
def test_gradient_by_material_time_step_and_shape_passes_the_taylor_test(value_and_gradients, name):
    parameters, evaluate, gradients = value_and_gradients
    value = parameters[name]
    along = value * 1.0 if name != "points" else 0.1 * jnp.sin(3.0 * value)
    slopes = taylor_slopes(
        lambda s: float(evaluate(parameters | {name: value + s * along})),
        float(jnp.vdot(gradients[name], along)),
        TAYLOR_STEPS / 4,
    )
    np.testing.assert_allclose(slopes, 2.0, atol=SLOPE_BAND)


def test_gradient_by_the_matrices_of_an_elastic_body_needs_no_viscosity():
    stepper, control = block(ELASTIC), random_control(STEPS)

    def cost(stepper):
        return block_cost(stepper, control)

    gradient = jax.grad(cost, allow_int=True)(stepper)
    assert gradient.system.viscosity is None
    assert np.all(np.isfinite(gradient.system.stiffness.values))
    assert np.any(gradient.system.stiffness.values)


def resting_mass_cost(force):
    """The final height of a bar that lies on the ground without load, under a force"""
    mesh = jc.meshes.interval(1.0, h=1.0)
    wall = jc.HalfSpace(np.array([0.0]), np.array([1.0]))
    system = jc.discretize(jc.Scene(mesh, ELASTIC, contact={"left": wall}))
    motion = jc.simulate(jc.prepare(system, 0.01), jnp.full((1, 2, 1), force))
    return motion.displacement[-1, 0, 0]


def test_gradient_at_a_kink_is_the_one_of_strong_contact():
    # The contact node rises under a positive force and stays under a negative one.
    assert abs(resting_mass_cost(-1.0)) < 1e-15
    assert resting_mass_cost(1.0) > 1e-6
    np.testing.assert_allclose(jax.grad(resting_mass_cost)(0.0), 0.0, atol=1e-18)


def test_gradient_without_contact_set_is_the_one_of_the_free_motion():
    scene = jc.Scene(BLOCK, VISCOUS)
    free = jc.prepare(jc.discretize(scene), DT)
    far = block(gap=100.0, force=(0.0, 0.0))
    control = random_control(STEPS)
    expected = jax.grad(lambda u: block_cost(far, u))(control)
    found = jax.grad(lambda u: block_cost(free, u))(control)
    np.testing.assert_allclose(found, expected, atol=AGREEMENT * np.max(np.abs(expected)))


def test_gradient_of_one_step_is_half_a_squared_time_step_over_the_mass():
    # A rigid translation: y = dt^2/2 f/rho for a control that is constant in space.
    stepper = block(gap=100.0, force=(0.0, 0.0))

    def mean_height(force):
        control = jnp.zeros((1, BLOCK.n_nodes, 2)).at[:, :, 1].set(force)
        return jnp.mean(jc.simulate(stepper, control).displacement[-1, :, 1])

    np.testing.assert_allclose(jax.grad(mean_height)(3.0), DT**2 / 2, rtol=1e-10)


def test_gradient_in_float32_is_close_to_float64():
    control = random_control(STEPS)
    exact = jax.grad(lambda u: block_cost(block(), u))(control)
    stepper = block(dtype=jnp.float32)
    single = jax.grad(lambda u: block_cost(stepper, u))(control.astype(jnp.float32))
    assert single.dtype == jnp.float32
    # A few rounding errors of 6e-8 in each of 30 steps forward and backward.
    assert np.max(np.abs(single - exact)) < 1e-4 * np.max(np.abs(exact))


def test_gradient_by_a_float32_control_of_a_float64_scene_works():
    stepper, control = block(), random_control(STEPS)
    exact = jax.grad(lambda u: block_cost(stepper, u))(control)
    single = jax.grad(lambda u: block_cost(stepper, u))(control.astype(jnp.float32))
    assert np.max(np.abs(single - exact)) < 1e-4 * np.max(np.abs(exact))


@pytest.mark.parametrize("mode", ["forward over reverse", "reverse over reverse"])
def test_gradient_differentiates_to_the_hessian_product(mode):
    stepper, control = block(), random_control(STEPS)
    along = random_control(STEPS, 1, size=1.0)
    gradient = jax.jit(jax.grad(lambda u: block_cost(stepper, u)))
    if mode == "forward over reverse":
        _, product = jax.jvp(gradient, (control,), (along,))
    else:
        product = jax.grad(lambda u: jnp.vdot(gradient(u), along))(control)
    difference = (gradient(control + 1e-4 * along) - gradient(control - 1e-4 * along)) / 2e-4
    scale = np.max(np.abs(difference))
    np.testing.assert_allclose(product, difference, atol=1e-6 * scale)
