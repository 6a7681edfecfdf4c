"""Claims about memory: it is predicted before a run, and checkpoints bound it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.motion.memory import check_run_memory, estimate_memory

#: The promise of `estimate_memory`.
FACTOR = 2.0
DT = 0.2


def make_system(material=None, h=1 / 5):
    mesh = jc.meshes.rectangle((1.0, 1.0), h=h)
    plane = jc.HalfSpace(np.array([0.0, -0.02]), np.array([0.0, 1.0]))
    material = jc.KelvinVoigt(young=1.0, poisson=0.3) if material is None else material
    return jc.discretize(jc.Scene(mesh, material, contact={"bottom": plane}))


@pytest.fixture(scope="module")
def stepper():
    return jc.prepare(make_system(), DT, linear_solver=jc.Dense())


def throw(system):
    rest = jnp.zeros((system.n_nodes, system.dimension), system.dtype)
    return jc.State(rest, rest.at[:, 1].set(-0.05))


def compiled_bytes(function, *arguments, without=0):
    analysis = jax.jit(function).lower(*arguments).compile().memory_analysis()
    assert analysis is not None
    sizes = analysis.argument_size_in_bytes, analysis.output_size_in_bytes
    return sum(sizes) + analysis.temp_size_in_bytes - without


def final_misfit(trajectory):
    return jnp.sum(trajectory.displacement[-1] ** 2)


@pytest.mark.parametrize(
    ("kind", "save_every", "checkpoint"),
    [
        ("forward", 1, None),
        ("forward", 16, None),
        ("gradient", 1, None),
        ("gradient", 1, jc.Checkpoint()),
        ("gradient", 1, jc.Checkpoint(8)),
        ("gradient", 16, jc.Checkpoint(8)),
        ("initial_gradient", 1, jc.Checkpoint(8)),
        ("matrix_gradient", 1, None),
        ("matrix_gradient", 1, jc.Checkpoint(8)),
        ("matrix_gradient", 16, jc.Checkpoint(16)),
    ],
)
def test_estimate_memory_is_within_a_factor_of_two(stepper, kind, save_every, checkpoint):
    steps = 512
    options = {"save_every": save_every, "checkpoint": checkpoint}
    system = stepper.system
    shape = (steps, system.n_nodes, system.dimension)

    def run(stepper, control, initial=None):
        initial = throw(stepper.system) if initial is None else initial
        return jc.simulate(stepper, control, steps=steps, initial=initial, **options)

    def misfit(*arguments):
        return jnp.sum(run(*arguments).displacement ** 2)

    def recorded(stepper):
        return replace(run(stepper, None), nodal=None)

    if kind == "forward":
        used = compiled_bytes(recorded, stepper)
    elif kind == "gradient":
        control = jax.ShapeDtypeStruct(shape, system.dtype)
        size = np.prod(shape) * system.dtype.itemsize
        gradient = jax.value_and_grad(misfit, argnums=1)
        used = compiled_bytes(gradient, stepper, control, without=size)
    elif kind == "initial_gradient":
        gradient = jax.value_and_grad(misfit, argnums=2)
        used = compiled_bytes(gradient, stepper, None, throw(system))
        kind = "gradient"
    else:
        gradient = jax.value_and_grad(misfit, allow_int=True)
        used = compiled_bytes(gradient, stepper, None)
    flags = {} if kind == "forward" else {kind: True}
    predicted = estimate_memory(stepper, steps, **flags, **options).total
    assert predicted / FACTOR < used < predicted * FACTOR


def material_gradient_bytes(steps, **options):
    def objective(young):
        # States outweigh the two booleans per pair that are recorded of every step.
        system = make_system(jc.KelvinVoigt(young=young, poisson=0.3), h=1 / 12)
        stepper = jc.prepare(system, DT, linear_solver=jc.Dense())
        return final_misfit(jc.simulate(stepper, steps=steps, initial=throw(system), **options))

    return compiled_bytes(jax.value_and_grad(objective), 1.0)


@pytest.mark.slow
def test_checkpointed_material_gradient_takes_memory_as_the_square_root_of_the_steps():
    roots = np.array([16, 32, 64])
    split = [
        material_gradient_bytes(m * m, save_every=int(m), checkpoint=jc.Checkpoint(int(m)))
        for m in roots
    ]
    # What comes with four times the steps: twice as much with checkpoints, else four times.
    first, second = np.diff(split)
    assert 0 < second < 2.2 * first
    stored = [material_gradient_bytes(m * m, save_every=int(m)) for m in roots]
    first, second = np.diff(stored)
    assert second > 3.8 * first
    assert stored[-1] > 5.0 * split[-1]


def test_estimate_memory_of_a_checkpoint_grows_as_the_square_root(stepper):
    residuals = [
        estimate_memory(
            stepper,
            m * m,
            matrix_gradient=True,
            save_every=m,
            checkpoint=jc.Checkpoint(m),
        ).residuals
        for m in (10, 20, 40)
    ]
    np.testing.assert_allclose(np.divide(residuals[1:], residuals[:-1]), 2.0)


def test_estimate_memory_works_on_shapes_alone(stepper):
    shapes = jax.eval_shape(lambda x: x, stepper)
    assert estimate_memory(shapes, 10) == estimate_memory(stepper, 10)


def test_estimate_memory_reads_as_a_table(stepper):
    lines = str(estimate_memory(stepper, 10, gradient=True)).splitlines()
    assert [line.split()[0] for line in lines] == [
        "stepper", "trajectory", "residuals", "cotangents", "workspace", "total",
    ]  # fmt: skip
    assert all(line.split()[-1] in ("B", "kB", "MB", "GB") for line in lines)


@pytest.mark.parametrize(("steps", "save_every"), [(0, 1), (10, 3), (10, 0)])
def test_estimate_memory_refuses_what_simulate_refuses(stepper, steps, save_every):
    with pytest.raises(ValueError, match="divisor"):
        estimate_memory(stepper, steps, save_every=save_every)


def test_check_run_memory_refuses_a_run_that_no_machine_holds(stepper):
    with pytest.raises(ValueError, match=r"TB of states.*larger save_every \(now 1\), or simulate"):
        check_run_memory(stepper, 10**12)
    check_run_memory(stepper, 1000)


def test_check_run_memory_counts_the_states_that_are_recorded(stepper):
    steps = 10_000
    needed = estimate_memory(stepper, steps).trajectory
    with pytest.raises(ValueError, match="save_every"):
        check_run_memory(stepper, steps, available=needed // 3)
    check_run_memory(stepper, steps, available=needed)
    check_run_memory(stepper, steps, save_every=10, available=needed // 3)


def test_check_run_memory_works_while_the_stepper_is_traced(stepper):
    jax.eval_shape(lambda s: check_run_memory(s, 1000), stepper)


def test_simulate_refuses_at_once_what_no_machine_holds(stepper, monkeypatch):
    def compile_or_run(*_):
        raise AssertionError("the check came too late")

    monkeypatch.setattr("jaxcontact.motion.simulate._run", compile_or_run)
    with pytest.raises(ValueError, match=r"TB of states.*larger save_every \(now 1\), or simulate"):
        jc.simulate(stepper, steps=10**12)
    with pytest.raises(ValueError, match=r"\(now 10\)"):
        jc.simulate(stepper, steps=10**12, save_every=10)


def test_simulate_leaves_the_memory_of_a_traced_stepper_to_whoever_runs_it(stepper):
    steps = 10**9
    motion = jax.eval_shape(lambda s: jc.simulate(s, steps=steps), stepper)
    assert motion.displacement.shape[0] == steps + 1


def test_half_disc_control_refuses_at_once_what_no_machine_holds():
    with pytest.raises(ValueError, match="TB of states"):
        jc.scenes.half_disc_control(h=7.5, steps=10**11)
