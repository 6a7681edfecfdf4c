"""Claims about controls and costs in unknowns: the same numbers without an array of the mesh."""

import re
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

#: The formulas are exact.
ROUNDING = 1e-12
SCALE, WEIGHTS = 1e6, {"control_weight": 1e-2, "final_weight": 7.5e-4}


class Problem(NamedTuple):
    full: jc.scenes.ControlProblem
    reduced: jc.System
    stepper: jc.Stepper
    nodal: jax.Array
    """A control (T, N, d) outside of the space, on clamped nodes too."""
    control: jax.Array
    """A control (T, n) in the space."""


@pytest.fixture(scope="module")
def problem():
    full = jc.scenes.half_disc_control(h=3.0, gap=0.2, steps=40, dt=1e-4)
    reduced = jc.reduce(full.system, 6, loads=[full.reference[0]])
    x = full.system.points
    nodal = 0.7 * full.reference * (1.0 + 0.2 * jnp.cos(x[:, :1]))[None]
    stepper = jc.prepare(reduced, full.dt)
    return Problem(full, reduced, stepper, nodal, reduced.restrict_control(nodal))


def tracking(problem, system, **options):
    return jc.TrackingCost(system, target=problem.full.target, **WEIGHTS, **options)


def value_and_gradient(stepper, cost, control):
    """Cost of a control and its derivative"""

    def objective(control):
        return cost(jc.simulate(stepper, SCALE * control), control)

    return jax.jit(jax.value_and_grad(objective))(control)


def agree(found, expected, tolerance=ROUNDING):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))


def test_restricted_control_has_the_same_load(problem):
    agree(
        jax.vmap(problem.reduced.control_load)(problem.control),
        jax.vmap(problem.reduced.control_load)(problem.nodal),
    )


def test_control_in_the_space_is_what_it_is_restricted_to(problem):
    lifted = problem.reduced.lift(problem.control)
    agree(problem.reduced.restrict_control(lifted), problem.control, 1e-11)


@pytest.mark.parametrize("part", ["body", "facets", "nodes"])
def test_cost_in_unknowns_is_the_nodal_one(problem, part):
    mesh, full = problem.full.scene.mesh, problem.full.system
    chosen = {"body": {}, "facets": {"facets": mesh.facets["contact"]}, "nodes": {"nodes": [3, 7]}}
    in_unknowns, on_nodes = (
        tracking(problem, system, **chosen[part]) for system in (problem.reduced, full)
    )
    c = problem.control
    value, gradient = value_and_gradient(problem.stepper, in_unknowns, c)

    def nodal_objective(c):
        u = problem.reduced.lift(c)
        return on_nodes(jc.simulate(problem.stepper, SCALE * u), u)

    expected = jax.jit(jax.value_and_grad(nodal_objective))(c)
    agree(value, expected[0])
    agree(gradient, expected[1])
    nodal_value, _ = value_and_gradient(problem.stepper, in_unknowns, problem.reduced.lift(c))
    agree(nodal_value, value)


def test_gradient_in_unknowns_is_the_restricted_nodal_one(problem):
    cost = jc.TrackingCost(problem.reduced, target=problem.full.target, final_weight=1e-3)

    def objective(u):
        return cost(jc.simulate(problem.stepper, SCALE * u))

    for_control = partial(jc.l2_value_and_grad, system=problem.reduced, dt=problem.full.dt)
    value, nodal = jax.jit(for_control(objective))(problem.nodal)
    again, gradient = jax.jit(for_control(objective))(problem.control)
    agree(again, value)
    agree(gradient, problem.reduced.restrict_control(nodal), 1e-11)


def test_inner_product_in_unknowns_is_the_nodal_one(problem):
    c = problem.control
    dot = partial(jc.control_dot, problem.reduced, problem.full.dt)
    u = problem.reduced.lift(c)
    agree(dot(c, c[::-1]), dot(u, u[::-1]))


def test_energy_takes_a_control_in_unknowns(problem):
    trajectory = jc.simulate(problem.stepper, SCALE * problem.control)
    ledger = jc.energy(problem.stepper, trajectory, SCALE * problem.control)
    assert np.max(np.abs(ledger.residual)) < ROUNDING * np.max(ledger.total)
    with pytest.raises(ValueError, match="the stepper that made it"):
        jc.energy(problem.full.stepper, trajectory)


def test_full_model_takes_a_control_in_unknowns(problem):
    full = problem.full
    u = full.system.lift(full.system.restrict(problem.nodal))
    c = full.system.restrict_control(u)
    found, expected = (jc.simulate(full.stepper, SCALE * x).unknowns for x in (c, u))
    agree(found, expected, 1e-11)
    cost = tracking(problem, full.system)
    in_unknowns = cost(jc.simulate(full.stepper, SCALE * c), c)
    agree(in_unknowns, cost(jc.simulate(full.stepper, SCALE * u), u), 1e-10)


def test_optimize_in_unknowns_finds_a_control_of_the_full_model(problem):
    def objective(stepper, cost, u):
        return cost(jc.simulate(stepper, SCALE * u), u)

    full = problem.full
    small = jax.tree_util.Partial(objective, problem.stepper, tracking(problem, problem.reduced))
    start = jnp.zeros_like(problem.control)
    options = {"system": problem.reduced, "dt": full.dt}
    result = jc.optimize(small, start, iterations=25, **options)
    assert result.control.shape == start.shape
    on_full = full.objective(problem.reduced.lift(result.control))
    assert on_full < 0.1 * full.objective(0.0 * problem.nodal)
    assert abs(on_full - result.value) < 0.05 * result.value
    with pytest.raises(ValueError, match="bounds are those of nodal values"):
        jc.optimize(small, start, bounds=(-1.0, 1.0), **options)


def test_gradient_in_unknowns_makes_no_array_of_the_mesh_and_the_steps(problem):
    cost = tracking(problem, problem.reduced)

    def objective(c):
        return cost(jc.simulate(problem.stepper, SCALE * c), c)

    program = str(jax.make_jaxpr(jax.grad(objective))(problem.control))
    sizes = [
        np.prod([int(n) for n in shape.split(",")])
        for shape in re.findall(r"f64\[([\d,]+)\]", program)
    ]
    steps, n_full = len(problem.control), problem.full.system.size
    assert max(sizes) <= max(n_full * problem.reduced.size, 3 * steps * problem.reduced.size)
    assert max(sizes) < steps * n_full


@pytest.mark.parametrize("shape", [(40, 5), (40, 3, 2), (40,)])
def test_control_of_another_shape_is_refused(problem, shape):
    with pytest.raises(ValueError, match=r"or in unknowns \(T, n\)"):
        jc.simulate(problem.stepper, np.zeros(shape))


def test_cost_sees_supports_that_move(problem):
    # A moved support is no part of the unknowns: such a motion is compared on the nodes.
    system, target = problem.full.system, problem.full.target
    down = 0.01 * np.linspace(0.0, 1.0, len(target))[:, None] * np.array([0.0, -1.0])
    motion = jc.simulate(problem.stepper, schedule=jc.Schedule(motion={"clamped": down}))
    found = tracking(problem, problem.reduced)(motion)
    agree(found, tracking(problem, system)(motion))


@pytest.fixture(scope="module")
def another(problem):
    """A reduced model of the same size, on other vectors"""
    sideways = jnp.ones_like(problem.full.reference[0]) * jnp.array([[1.0, 0.0]])
    reduced = jc.reduce(problem.full.system, 6, loads=[sideways])
    assert reduced.size == problem.reduced.size
    return reduced


def test_cost_does_not_take_the_unknowns_of_another_model_for_its_own(problem, another):
    motion = jc.simulate(problem.stepper, SCALE * problem.control)
    cost = tracking(problem, another)
    agree(cost(motion), tracking(problem, problem.full.system)(motion))
    with pytest.raises(ValueError, match="the motion is one of another model"):
        cost(motion, problem.control)
    with pytest.raises(ValueError, match="the stepper that made it"):
        jc.energy(jc.prepare(another, problem.full.dt), motion)


def test_equal_reduced_models_share_costs_and_programs(problem, tmp_path):
    again = jc.reduce(problem.full.system, 6, loads=[problem.full.reference[0]])
    problem.reduced.save(tmp_path / "reduced.npz")
    loaded = jc.load_system(tmp_path / "reduced.npz")

    @jax.jit
    def value(stepper, cost, c):
        return cost(jc.simulate(stepper, SCALE * c), c)

    costs = [tracking(problem, system) for system in (problem.reduced, again, loaded)]
    steppers = [jc.prepare(system, problem.full.dt) for system in (problem.reduced, again, loaded)]
    values = [
        value(stepper, cost, problem.control)
        for stepper, cost in zip(steppers, reversed(costs), strict=True)
    ]
    agree(values[1:], values[:1] * 2)
    assert value._cache_size() == 1


def test_models_of_one_mark_are_stacked(problem, another):
    models = [
        replace(system, basis=replace(system.basis, mark="of two loads"))
        for system in (problem.reduced, another)
    ]
    steppers = [jc.prepare(system, problem.full.dt) for system in models]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *steppers)
    found = jax.vmap(lambda x: jc.simulate(x, SCALE * problem.nodal).displacement)(stacked)
    for stepper, motion in zip(steppers, found, strict=True):
        agree(motion, jc.simulate(stepper, SCALE * problem.nodal).displacement)


@pytest.mark.parametrize("is_uniform", [True, False])
def test_inner_product_needs_no_matrix_where_the_density_is_one_number(problem, is_uniform):
    scene = problem.full.scene
    heavier = scene.material.density * np.linspace(1.0, 2.0, len(scene.mesh.cells))
    if not is_uniform:
        scene = replace(scene, material=replace(scene.material, density=heavier))
    reduced = jc.reduce(jc.discretize(scene), 6)
    assert (sum(x.size for x in jax.tree.leaves(reduced.l2_mass)) == 1) == is_uniform
    c = jnp.cos(jnp.arange(2.0 * reduced.size)).reshape(2, -1)
    agree(jc.control_dot(reduced, 1.0, c, c), jc.control_dot(reduced, 1.0, *[reduced.lift(c)] * 2))
    levels = problem.full.target[:2]
    motion = jc.simulate(jc.prepare(reduced, problem.full.dt), SCALE * c[:1])
    costs = [
        jc.TrackingCost(system, target=levels, control_weight=1e9)(motion, control)
        for system, control in ((reduced, c[:1]), (jc.discretize(scene), reduced.lift(c[:1])))
    ]
    agree(*costs)
