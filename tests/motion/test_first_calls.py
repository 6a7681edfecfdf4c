"""Calls with the wrong thing say what to write instead, and objects say what they are."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, VISCOUS, block, block_scene

import jaxcontact as jc
import jaxcontact.optimize as o

FLOOR = jc.HalfSpace(np.array([0.0, -0.1]), np.array([0.0, 1.0]))
N = BLOCK.n_nodes


@pytest.fixture(scope="module")
def stepper():
    return block()


@pytest.fixture(scope="module")
def motion(stepper):
    return jc.simulate(stepper, steps=10)


def scene(**changes):
    return jc.Scene(
        **({"mesh": BLOCK, "material": VISCOUS, "contact": {"bottom": FLOOR}} | changes)
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: jc.discretize(BLOCK), r"takes a Scene, got a Mesh; .* jc.Scene\(mesh, material"),
        (lambda _: jc.prepare(scene(), 0.1), r"takes a System, got a Scene; .* jc.discretize\(sc"),
        (lambda s: jc.simulate(s.system, steps=3), r"takes a Stepper, got a System; .*jc.prepare"),
        (lambda s: jc.simulate(s, steps=3.5), "steps must be a whole number, got 3.5"),
        (lambda s: jc.prepare(s.system, "a"), "dt must be a positive number of seconds, got 'a'"),
        (
            lambda s: jc.simulate(s, steps=3, initial=(np.zeros((N, 2)), np.zeros((N, 2)))),
            r"got a tuple; write initial=jc.State\(displacement, velocity\)",
        ),
    ],
)
def test_call_with_the_wrong_thing_says_which_comes_first(stepper, call, message):
    with pytest.raises(ValueError, match=message):
        call(stepper)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contact": {"bottom": lambda x: x[1]}}, r"jc.SignedDistance\(\.\.\.\)"),
        ({"contact": {"bottom": "table"}}, r"'table' is no obstacle.*jc.Facets\('table'\)"),
        ({"clamped": ("bottom",)}, "every node of contact set 'bottom' is clamped"),
        ({"contact": ("bottom",)}, r"contact must be a mapping.*got a tuple"),
        ({"clamped": {"top": [0.0, -0.1]}}, r"clamped=\('top',\).*jc.Schedule\(motion="),
    ],
)
def test_scene_with_the_wrong_thing_names_the_right_one(changes, message):
    with pytest.raises(ValueError, match=message):
        jc.discretize(scene(**changes))


def test_clamped_nodes_of_a_contact_set_have_no_pair_and_change_no_other():
    held, free = (jc.discretize(scene(clamped=names)) for names in (("left",), ()))
    kept = ~np.isin(free.contact_nodes, BLOCK.facets["left"])
    assert kept.sum() == 4
    np.testing.assert_array_equal(held.contact_nodes, free.contact_nodes[kept])
    for name in ("gap", "contact_area", "directions"):
        np.testing.assert_array_equal(getattr(held, name), getattr(free, name)[kept])


def test_clamped_node_of_a_contact_set_that_penetrates_is_named():
    slope = jc.HalfSpace(np.array([0.2, 0.0]), np.array([1.0, 1.0]))
    with pytest.raises(ValueError, match=r"1 clamped nodes.*node 0 of 'bottom' by 0.141 m"):
        jc.discretize(scene(clamped=("left",), contact={"bottom": slope}))


def test_clamped_node_that_penetrates_a_traced_obstacle_makes_all_gaps_nan():
    def gap(x):
        slope = jc.HalfSpace(jnp.stack([x, 0.0]), jnp.array([1.0, 1.0]))
        return jc.discretize(scene(clamped=("left",), contact={"bottom": slope})).gap

    assert np.all(np.isnan(jax.jit(gap)(0.2)))
    assert np.all(np.isfinite(jax.jit(gap)(-0.2)))


def test_state_at_rest_is_the_default_start(stepper, motion):
    same = jc.simulate(stepper, steps=10, initial=jc.State.at_rest(stepper.system))
    np.testing.assert_array_equal(same.unknowns, motion.unknowns)


@pytest.mark.parametrize(
    ("thing", "words"),
    [
        (lambda s, m: BLOCK, ["nodes=15", "cells=16", "bottom: 4"]),
        (lambda s, m: s.system, ["unknowns=30", "contact_pairs=5", "dtype=float64"]),
        (lambda s, m: s, ["dt=0.02 s", "courant=0.7", "scheme=ContactImplicit()"]),
        (lambda s, m: m, ["steps=10", "end=0.2 s", "status={converged: 10}", "largest_force="]),
    ],
)
def test_object_shows_itself_in_one_line_and_as_a_table(stepper, motion, thing, words):
    thing = thing(stepper, motion)
    text = repr(thing)
    assert all(word in text for word in words), text
    assert len(text) < 250
    assert "array(" not in text
    assert thing._repr_html_().count("<tr>") >= len(words)


def test_largest_force_of_a_trajectory_is_that_of_all_pairs_together(motion):
    largest = np.asarray(motion.contact_force).sum(axis=1).max()
    assert f"largest_force={largest:.4g} N" in repr(motion)


def test_traced_objects_and_trees_without_values_show_themselves_too(stepper, motion):
    seen = []
    jax.jit(lambda s, m: seen.append(repr((s, m))))(stepper, motion)
    assert "values=traced" in seen[0]
    assert "no arrays" in repr(jax.tree.map(lambda _: object(), stepper))


def test_courant_number_of_a_uniform_bar_is_that_of_the_textbook():
    bar = jc.Scene(jc.meshes.interval(1.0, h=0.1), jc.KelvinVoigt(young=4.0, poisson=0.0))
    assert "courant=0.5," in repr(jc.prepare(jc.discretize(bar), 0.025))


def test_optimize_is_a_module_and_its_function():
    assert o is jc.optimize
    assert o.LBFGS is jc.LBFGS
    assert inspect.signature(jc.optimize) == inspect.signature(o.optimize)


def test_optimize_without_an_inner_product_names_the_euclidean_one():
    with pytest.raises(ValueError, match=r"inner_product=jc.Euclidean\(\)"):
        jc.optimize(jnp.sum, jnp.zeros(2))


def test_euclidean_inner_product_identifies_the_stiffness_of_a_bounce():
    def final(log_young):
        material = jc.KelvinVoigt(young=jnp.exp(log_young), poisson=0.3)
        shot = jc.prepare(jc.discretize(block_scene(material)), 0.02)
        return jc.simulate(shot, steps=12).final.displacement

    seen = final(jnp.log(100.0))
    miss = jax.jit(lambda p: jnp.sum((final(p[0]) - seen) ** 2))
    result = jc.optimize(miss, jnp.log(jnp.array([60.0])), inner_product=jc.Euclidean())
    assert float(jnp.exp(result.parameters[0])) == pytest.approx(100.0, rel=1e-4)
    assert "iterations=" in repr(result)
