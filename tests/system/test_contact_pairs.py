"""One contact is one pair, however the scene states it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, DT, VISCOUS

import jaxcontact as jc

#: Bottom and right side of the block as two sets of one plane that slants under both.
SLANTED = np.array([-1.0, 1.0])
CORNER = int(np.flatnonzero(np.all(BLOCK.points == [2.0, 0.0], axis=1))[0])


def plane(offset=0.1, normal=SLANTED):
    unit = np.asarray(normal) / np.linalg.norm(normal)
    return jc.HalfSpace(BLOCK.points[CORNER] - offset * unit, np.array(normal))


def scene(bottom, right):
    return jc.Scene(BLOCK, VISCOUS, contact={"bottom": bottom, "right": right})


def pairs_at_corner(system):
    return np.flatnonzero(system.contact_nodes == CORNER)


@pytest.fixture(scope="module")
def merged():
    shared = plane()
    return jc.discretize(scene(shared, shared))


def test_contact_sets_with_one_obstacle_are_one_set(merged):
    assert len(merged.contact_nodes) == np.unique(merged.contact_nodes).size == 7
    # Half an edge of each side.
    (pair,) = pairs_at_corner(merged)
    assert merged.contact_area[pair] == pytest.approx(0.25 + 0.25)


@pytest.mark.parametrize(
    ("bottom", "right"),
    [
        (plane(), plane()),
        # Equal surfaces that are stated in other words.
        (plane(), jc.SignedDistance(plane().signed_distance)),
        (plane(), plane(normal=2.0 * SLANTED)),
    ],
    ids=["equal objects", "other types", "other lengths"],
)
def test_contact_sets_with_equal_obstacles_make_the_pairs_of_one(merged, bottom, right):
    system = jc.discretize(scene(bottom, right))
    order = np.argsort(system.contact_nodes)
    np.testing.assert_array_equal(system.contact_nodes[order], merged.contact_nodes)
    for name in ("gap", "contact_area"):
        np.testing.assert_allclose(getattr(system, name)[order], getattr(merged, name), rtol=1e-14)


def test_contact_pairs_survive_a_rebuilt_scene(merged):
    shared = plane()
    rebuilt = jax.tree.map(lambda x: x, scene(shared, shared))
    np.testing.assert_array_equal(jc.discretize(rebuilt).contact_nodes, merged.contact_nodes)


def test_contact_pair_that_is_kept_is_the_nearest():
    system = jc.discretize(scene(plane(0.3), plane(0.1)))
    (pair,) = pairs_at_corner(system)
    assert system.gap[pair] == pytest.approx(0.1)
    assert system.contact_area[pair] == pytest.approx(0.5)
    # Away from the corner each side keeps its own plane.
    assert len(system.contact_nodes) == 7
    assert np.max(system.gap) == pytest.approx(0.3 + np.sqrt(2.0))


def test_contact_pairs_with_other_normals_at_one_node_both_stay():
    system = jc.discretize(scene(plane(normal=(0.0, 1.0)), plane(normal=(-1.0, 1e-6))))
    assert pairs_at_corner(system).size == 2


@pytest.mark.parametrize("offset", [0.1, 0.3])
def test_contact_pairs_are_merged_under_jit(merged, offset):
    nodes = []

    @jax.jit
    def gap(young):
        material = jc.KelvinVoigt(young=young, poisson=0.3)
        sets = {"bottom": plane(offset), "right": plane()}
        system = jc.discretize(jc.Scene(BLOCK, material, contact=sets))
        nodes.append(system.contact_nodes)
        return jnp.min(system.gap)

    assert gap(1.0) == pytest.approx(0.1)
    np.testing.assert_array_equal(np.sort(nodes[0]), merged.contact_nodes)


def test_contact_pairs_with_one_traced_value_are_merged(merged):
    nodes = []

    @jax.grad
    def gap(point):
        sets = scene(*(jc.HalfSpace(point, SLANTED) for _ in range(2)))
        system = jc.discretize(sets)
        nodes.append(system.contact_nodes)
        return jnp.sum(system.gap)

    # Moving the plane along its normal by 1 closes the gap of all seven pairs by 1.
    unit = SLANTED / np.sqrt(2.0)
    assert gap(jnp.asarray(plane().point)) @ unit == pytest.approx(-7.0)
    np.testing.assert_array_equal(nodes[0], merged.contact_nodes)


def test_block_with_twin_contact_sets_lands_as_with_one(merged):
    initial = jc.State(
        jnp.zeros((BLOCK.n_nodes, 2)), jnp.tile(jnp.array([1.0, -1.0]), (BLOCK.n_nodes, 1))
    )
    twins = jc.discretize(scene(plane(), plane()))
    motions = [
        jc.simulate(jc.prepare(system, DT), steps=15, initial=initial) for system in (merged, twins)
    ]
    assert np.any(motions[0].active)
    np.testing.assert_allclose(motions[1].displacement, motions[0].displacement, atol=1e-12)
