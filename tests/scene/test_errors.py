"""Bad input raises an error that says what to do; a failed step never looks like a result.

The errors of meshes are in test_mesh.
"""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, DT, VISCOUS, block, block_scene, random_control

import jaxcontact as jc

FLOOR = jc.HalfSpace(np.array([0.0, -0.1]), np.array([0.0, 1.0]))
N = BLOCK.n_nodes
REST = jnp.zeros((N, 2))


def discretize(**changes):
    fields = {"mesh": BLOCK, "material": VISCOUS, "contact": {"bottom": FLOOR}} | changes
    return jc.discretize(jc.Scene(**fields))


def material(**changes):
    return jc.KelvinVoigt(**({"young": 1.0, "poisson": 0.3} | changes))


@pytest.fixture(scope="module")
def stepper():
    return block()


@pytest.mark.parametrize("field", ["clamped", "contact", "traction"])
def test_scene_with_an_unknown_facet_name_lists_the_known_ones(field):
    value = {
        "clamped": ("botom",),
        "contact": {"botom": FLOOR},
        "traction": {"botom": np.ones(2)},
    }[field]
    with pytest.raises(ValueError, match=r"'botom'.*'bottom', 'left', 'right', 'top'"):
        discretize(**{field: value})


def test_scene_with_an_unknown_region_lists_the_known_ones():
    mesh = jc.Mesh.from_arrays(BLOCK.points, BLOCK.cells, BLOCK.facets, {"all": np.arange(16)})
    with pytest.raises(ValueError, match=r"'steel'.*\['all'\]"):
        discretize(mesh=mesh, material={"steel": VISCOUS})


def test_scene_with_cells_in_no_or_two_regions_counts_them():
    regions = {"first": np.arange(10), "second": np.arange(9, 14)}
    mesh = jc.Mesh.from_arrays(BLOCK.points, BLOCK.cells, BLOCK.facets, regions)
    with pytest.raises(ValueError, match=r"3 cells .*exactly one region.*\[9, 14, 15\]"):
        discretize(mesh=mesh, material={"first": VISCOUS, "second": VISCOUS})


def test_scene_with_clamped_given_as_a_string_shows_the_tuple():
    with pytest.raises(ValueError, match=r"clamped=\('left',\)"):
        discretize(clamped="left")


def test_scene_with_every_node_clamped_says_so():
    mesh = jc.meshes.rectangle((1.0, 1.0), h=1.0)
    with pytest.raises(ValueError, match="every node is clamped"):
        discretize(mesh=mesh, clamped=tuple(mesh.facets), contact={})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"young": 0.0}, "young must be positive, got 0.0"),
        ({"young": -1.0}, "young must be positive"),
        ({"young": np.nan}, "young must be positive"),
        ({"poisson": 0.5}, r"poisson must be in \(-1, 1/2\).*got 0.5"),
        ({"poisson": -1.0}, r"poisson must be in \(-1, 1/2\)"),
        ({"poisson": 30.0}, r"poisson must be in \(-1, 1/2\)"),
        ({"density": 0.0}, "density must be positive"),
        ({"density": -1.0}, "density must be positive"),
        ({"density": np.inf}, "density must be positive"),
        ({"bulk_viscosity": -1e-3}, "bulk_viscosity must be zero or positive"),
        ({"shear_viscosity": -1e-3}, "shear_viscosity must be zero or positive"),
        ({"young": np.ones(3)}, "young must be a scalar.*region"),
    ],
)
def test_material_out_of_range_names_field_range_and_value(changes, message):
    with pytest.raises(ValueError, match=message):
        discretize(material=material(**changes))


def test_material_of_the_wrong_type_is_named():
    with pytest.raises(ValueError, match=r"material must be a KelvinVoigt.*got float"):
        discretize(material=1e5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body_force": np.ones(3)}, r"body_force must have shape \(2,\), got \(3,\)"),
        ({"body_force": -9.81}, r"body_force must have shape \(2,\)"),
        ({"body_force": np.array([0.0, np.nan])}, "body_force must be finite"),
        ({"traction": {"top": np.ones(1)}}, r"traction\['top'\] must have shape \(2,\)"),
        ({"traction": {"top": np.array([0.0, np.inf])}}, r"traction\['top'\] must be finite"),
    ],
)
def test_load_of_wrong_shape_or_value_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        discretize(**changes)


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (jc.HalfSpace(np.zeros(3), np.ones(3)), r"HalfSpace.point must have shape \(2,\)"),
        (jc.HalfSpace(np.zeros(2), np.zeros(2)), "HalfSpace.normal must not be the zero vector"),
        (jc.HalfSpace(np.zeros(2), np.array([0.0, np.nan])), "HalfSpace.normal must be finite"),
        (jc.Ball(np.zeros(2), -1.0), "radius must be positive"),
        (jc.Ball(np.zeros(3), 1.0), r"Ball.center must have shape \(2,\)"),
        (jc.Ball(np.zeros(2), 0.1), "zero or undefined gradient.*centre"),
    ],
)
def test_obstacle_that_defines_no_surface_is_named(obstacle, message):
    with pytest.raises(ValueError, match=message):
        discretize(contact={"bottom": obstacle})


def test_discretize_rejects_other_floating_point_types():
    with pytest.raises(ValueError, match="float32 or float64"):
        jc.discretize(block_scene(), dtype=jnp.float16)


def test_discretize_without_x64_says_which_line_to_add():
    program = """
import numpy as np, jaxcontact as jc
scene = jc.Scene(jc.meshes.interval(1.0, h=0.5), jc.KelvinVoigt(young=1.0, poisson=0.3))
jc.discretize(scene)
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.returncode != 0
    assert "RuntimeError" in result.stderr
    assert "jax.config.update('jax_enable_x64', True)" in result.stderr


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan, np.inf])
def test_prepare_with_a_time_step_that_is_not_positive_says_so(stepper, dt):
    with pytest.raises(ValueError, match="dt must be a positive number of seconds"):
        jc.prepare(stepper.system, dt)


@pytest.mark.parametrize("option", ["scheme", "linear_solver", "contact_solver"])
@pytest.mark.parametrize("value", ["newton", jc.SemismoothNewton, jc.ContactImplicit])
def test_prepare_with_a_string_or_class_as_option_asks_for_an_object(stepper, option, value):
    with pytest.raises(ValueError, match=f"{option} must be an object"):
        jc.prepare(stepper.system, DT, **{option: value})


def test_prepare_with_a_class_as_option_shows_how_to_write_it(stepper):
    with pytest.raises(ValueError, match=r"jc\.SemismoothNewton\(\)"):
        jc.prepare(stepper.system, DT, contact_solver=jc.SemismoothNewton)


@pytest.mark.parametrize(
    ("control", "message"),
    [
        (
            jnp.zeros((N, 2)),
            r"control must have shape \(T, N, d\) = \(T, 15, 2\), .*, got \(15, 2\)",
        ),
        (jnp.zeros((4, N, 1)), "control must have shape"),
        (jnp.zeros((4, N - 1, 2)), "control must have shape.*clamped ones included"),
        (jnp.zeros((4, N, 2)).at[2, 3, 1].set(jnp.nan), r"control.*1 value.*\(2, 3, 1\)"),
        (jnp.zeros((0, N, 2)), "at least one step"),
    ],
)
def test_simulate_with_a_wrong_control_says_what_it_should_be(stepper, control, message):
    with pytest.raises(ValueError, match=message):
        jc.simulate(stepper, control)


def test_simulate_with_neither_control_nor_steps_asks_for_one(stepper):
    with pytest.raises(ValueError, match=r"control .* or the number of steps"):
        jc.simulate(stepper)


def test_simulate_with_steps_that_do_not_fit_the_control_says_so(stepper):
    with pytest.raises(ValueError, match="steps=5 does not fit a control of 4 steps"):
        jc.simulate(stepper, jnp.zeros((4, N, 2)), steps=5)


@pytest.mark.parametrize("steps", [0, -3])
def test_simulate_without_a_step_says_so(stepper, steps):
    with pytest.raises(ValueError, match="at least one step"):
        jc.simulate(stepper, steps=steps)


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        (jc.State(jnp.zeros((N, 1)), REST), r"initial.displacement must have shape .*\(15, 2\)"),
        (jc.State(REST, jnp.zeros(2 * N)), "initial.velocity must have shape"),
        (jc.State(REST.at[3, 0].set(jnp.nan), REST), r"initial.displacement.*\(3, 0\)"),
        (jc.State(REST, REST.at[3, 0].set(jnp.inf)), "initial.velocity holds 1 value"),
        (jc.State(REST - 0.11, REST), "penetrates the obstacle at 5 contact nodes.*0.01 m"),
    ],
)
def test_simulate_with_a_wrong_initial_state_says_why(stepper, initial, message):
    with pytest.raises(ValueError, match=message):
        jc.simulate(stepper, steps=3, initial=initial)


def test_simulate_from_a_reference_configuration_that_penetrates_says_so():
    with pytest.raises(ValueError, match="penetrates the obstacle at 5 contact nodes"):
        jc.simulate(block(gap=-0.05), steps=3)


@pytest.mark.parametrize("field", ["displacement", "velocity"])
def test_simulate_with_a_moving_clamped_node_names_it(field):
    mesh = jc.meshes.rectangle((2.0, 1.0), h=0.5)
    system = discretize(mesh=mesh, clamped=("top",))
    node = int(mesh.facets["top"][0, 0])
    moved = REST.at[node, 0].set(0.1)
    initial = jc.State(**({"displacement": REST, "velocity": REST} | {field: moved}))
    with pytest.raises(ValueError, match=rf"initial.{field} .*1 clamped node.*\[{node}\]"):
        jc.simulate(jc.prepare(system, DT), steps=3, initial=initial)


def test_simulate_in_float32_takes_a_float64_control():
    single = block(dtype=jnp.float32)
    motion = jc.simulate(single, random_control(3))
    assert motion.displacement.dtype == jnp.float32


@pytest.fixture(scope="module")
def hasty():
    """A block whose contact solver gives up after one sweep; it fails in step 8"""
    return block(contact_solver=jc.ProjectedGaussSeidel(max_sweeps=1))


def test_simulate_raises_solve_error_with_step_time_and_residual(hasty):
    with pytest.raises(
        jc.SolveError, match=r"step 8 of 30 \(time 0.16 s\).*not converged.*residual of \d\.\d+e-"
    ) as caught:
        jc.simulate(hasty, steps=30)
    assert isinstance(caught.value, RuntimeError)


def test_simulate_whose_load_overflows_raises_solve_error(stepper):
    with pytest.raises(jc.SolveError, match=r"step \d+ of 20.*non finite"):
        jc.simulate(stepper, jnp.full((20, N, 2), -1e308))


def test_simulate_that_fails_under_jit_is_nan_from_that_step_on(hasty):
    motion = jax.jit(lambda: jc.simulate(hasty, steps=30))()
    assert np.all(np.isfinite(motion.displacement[:8]))
    assert np.all(np.isnan(motion.displacement[8:]))
    assert np.all(np.isnan(motion.velocity[8:]))
    assert np.all(np.asarray(motion.status[:7]) == jc.Status.CONVERGED)
    assert int(motion.status[7]) == jc.Status.NOT_CONVERGED
    assert np.all(np.asarray(motion.status[8:]) == jc.Status.NON_FINITE)


def test_simulate_that_fails_under_jit_has_no_contact_impulse(hasty):
    motion = jax.jit(lambda: jc.simulate(hasty, steps=8))()
    assert np.all(np.isnan(motion.contact_impulse[7]))


@pytest.mark.parametrize("argument", ["control", "initial state"])
def test_gradient_of_a_failed_run_is_nan(hasty, argument):
    @jax.jit
    @jax.value_and_grad
    def cost(x):
        control = jnp.zeros((30, N, 2))
        if argument == "control":
            motion = jc.simulate(hasty, control + x)
        else:
            motion = jc.simulate(hasty, control, initial=jc.State(REST, REST + x))
        return jnp.sum(motion.displacement[-1] ** 2)

    value, gradient = cost(0.0)
    assert np.isnan(value)
    assert np.isnan(gradient)


def test_gradient_of_a_failed_run_outside_jit_is_nan_or_an_error(hasty):
    def cost(u):
        return jnp.sum(jc.simulate(hasty, u).displacement[-1] ** 2)

    try:
        gradient = jax.grad(cost)(jnp.zeros((30, N, 2)))
    except jc.SolveError:
        return
    assert np.all(np.isnan(gradient))


def test_simulate_that_fails_for_one_of_a_batch_spoils_that_one_only(hasty):
    # Without gravity the second body never touches.
    lift = jnp.stack([jnp.zeros((30, N, 2)), jnp.zeros((30, N, 2)).at[:, :, 1].set(10.0)])
    motion = jax.vmap(lambda u: jc.simulate(hasty, u))(lift)
    assert np.all(np.isnan(motion.displacement[0, -1]))
    assert np.all(np.isfinite(motion.displacement[1]))
