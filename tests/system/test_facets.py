"""Contact rows between two bodies: what they keep exactly, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.two_bodies import (
    FACES,
    RUBBER,
    rigid_motions,
    rotation,
    round_bodies,
    stacked,
    touching,
)

import jaxcontact as jc

# Stress and pressure of the patch test; BODIES of some hundred unknowns leave 1e-13.
PATCH = 1e-9
# Of sums of some ten products of numbers of size one.
ROUNDING = 1e-13


def static_under_traction(scene):
    """Displacement (N, d) and pressure (C,) of bodies pressed together, nothing clamped.

    All pairs are closed; of the rigid motions the smallest is taken.
    """
    system = jc.discretize(scene)
    A, N = system.stiffness.to_scipy().toarray(), system.normals.to_scipy().toarray()
    matrix = np.block([[A, N.T], [N, np.zeros((len(N), len(N)))]])
    data = np.concatenate([system.load, system.gap])
    solution = np.linalg.lstsq(matrix, data, rcond=1e-12)[0]
    assert np.linalg.norm(matrix @ solution - data) < 1e-12
    y = system.lift(jnp.asarray(solution[: system.size]))
    return np.asarray(y), solution[system.size :] / np.asarray(system.contact_area)


def stresses(mesh, displacement, material):
    """Stress in every cell, (E, d, d)"""
    x, y = mesh.points[mesh.cells], displacement[mesh.cells]
    gradient = np.linalg.solve(x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1])
    strain = 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
    first, second = material.elastic_lame()
    trace = np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(mesh.dimension)
    return first * trace + 2.0 * second * strain


@pytest.mark.parametrize("turned", [False, True], ids=["upper slave", "lower slave"])
@pytest.mark.parametrize(
    ("d", "lower", "upper", "angle", "jitter"),
    [
        (2, 1 / 4, 1 / 4, 0.0, 0.0),
        (2, 1 / 4, 1 / 6, 0.0, 0.0),
        (2, 1 / 8, 1 / 2, 0.0, 0.0),
        (2, 1 / 4, 1 / 6, 0.4, 0.2),
        (3, 1 / 2, 1 / 2, 0.0, 0.0),
        (3, 1 / 2, 1 / 3, 0.0, 0.0),
        (3, 1 / 2, 1 / 3, 0.4, 0.2),
    ],
)
def test_facets_pass_the_patch_test(d, lower, upper, angle, jitter, turned):
    mesh = stacked(lower, upper, d, angle=angle, jitter=jitter)
    normal, sides = rotation(d, angle)[:, -1], FACES[d][:: -1 if turned else 1]
    pressed = {"upper/top": -normal, "lower/bottom": normal}
    y, pressure = static_under_traction(touching(mesh, *sides, traction=pressed))
    error = stresses(mesh, y, RUBBER) + np.outer(normal, normal)
    assert np.max(np.abs(error)) < PATCH
    np.testing.assert_allclose(pressure, 1.0, atol=PATCH)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_facets_have_the_gap_and_the_area_of_flat_faces(d):
    system = jc.discretize(touching(stacked(1 / 3, 1 / 2, d, gap=0.1, angle=0.3)))
    np.testing.assert_allclose(system.gap, 0.1, rtol=1e-13)
    assert np.sum(system.contact_area) == pytest.approx(1.0, rel=1e-13)
    assert system.normals.count == 3 ** (d - 1)


def test_facets_on_matching_meshes_couple_node_to_node():
    mesh = stacked(1 / 4, 1 / 4)
    system = jc.discretize(touching(mesh))
    rows = system.normals.to_scipy().toarray().reshape(5, mesh.n_nodes, 2)
    for node, row in zip(system.contact_nodes, rows, strict=True):
        (below,) = np.flatnonzero(np.all(mesh.points[:25] == mesh.points[node], axis=1))
        expected = np.zeros_like(row)
        expected[[node, below], 1] = -1.0, 1.0
        np.testing.assert_allclose(row, expected, atol=ROUNDING)


@pytest.mark.parametrize("along", [None, "down"])
@pytest.mark.parametrize("d", [2, 3])
def test_facets_feel_no_rigid_motion_on_curved_surfaces(d, along):
    mesh = round_bodies(d)
    direction = None if along is None else -np.eye(d)[-1]
    system = jc.discretize(touching(mesh, "ball/contact", "floor/contact", along=direction))
    assert system.normals.count >= 5
    for motion in rigid_motions(mesh.points):
        assert np.max(np.abs(system.normals @ system.restrict(motion))) < ROUNDING


def test_facets_behind_others_are_not_seen():
    lower = stacked(1 / 3, 1 / 4)
    upper = jc.meshes.rectangle((1.0, 1.0), h=0.5).moved(translation=[0.0, 2.1])
    # The master is the whole boundary of both bodies below.
    mesh = jc.join({"two": lower, "upper": upper})
    cells = mesh.cells[mesh.regions["two"]]
    whole = jc.scene.mesh.boundary_facets(cells)
    mesh = jc.Mesh.from_arrays(mesh.points, mesh.cells, mesh.facets | {"two": whole})
    system = jc.discretize(touching(mesh, "upper/bottom", "two"))
    expected = jc.discretize(touching(mesh, "upper/bottom", "two/upper/top"))
    np.testing.assert_allclose(
        system.normals.to_scipy().toarray(), expected.normals.to_scipy().toarray(), atol=ROUNDING
    )


def test_facets_see_clamped_nodes_as_a_rigid_obstacle():
    mesh = stacked(1 / 4, 1 / 3, gap=0.1)
    held = jc.discretize(touching(mesh, clamped=("lower/top", "lower/bottom")))
    plane = jc.HalfSpace(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    rigid = jc.discretize(
        jc.Scene(mesh, RUBBER, ("lower/top", "lower/bottom"), {"upper/bottom": plane})
    )
    assert held.normals.weights.shape == (4, 2)
    for name in ("gap", "contact_area", "contact_nodes"):
        np.testing.assert_allclose(getattr(held, name), getattr(rigid, name), rtol=1e-13)
    np.testing.assert_allclose(
        held.normals.to_scipy().toarray(), rigid.normals.to_scipy().toarray(), atol=ROUNDING
    )


def test_facets_stand_beside_rigid_obstacles():
    mesh = stacked(1 / 4, 1 / 3, gap=0.1)
    floor = jc.HalfSpace(np.array([0.0, -0.2]), np.array([0.0, 1.0]))
    contact = {"upper/bottom": jc.Facets("lower/top"), "lower/bottom": floor}
    system = jc.discretize(jc.Scene(mesh, RUBBER, contact=contact))
    np.testing.assert_allclose(np.sort(system.gap), [0.1] * 4 + [0.2] * 5, rtol=1e-13)
    compliance = system.normals.to_scipy() @ system.normals.to_scipy().T
    assert np.linalg.matrix_rank(compliance.toarray()) == 9


@pytest.mark.parametrize("d", [2, 3])
def test_facets_are_differentiable_by_node_positions(d):
    mesh = round_bodies(d)
    scene = touching(mesh, "ball/contact", "floor/contact")
    rng = np.random.default_rng(1)
    count = jc.discretize(scene).normals.count
    y, c = jnp.asarray(rng.normal(size=mesh.points.shape)), jnp.asarray(rng.normal(size=count))
    direction = rng.normal(size=mesh.points.shape)

    @jax.jit
    def functional(points):
        moved = jc.Scene(mesh.with_points(points), RUBBER, contact=scene.contact)
        system = jc.discretize(moved)
        row = system.normals @ system.restrict(y) + system.gap + system.contact_area
        return jnp.dot(c, row)

    x, step = jnp.asarray(mesh.points), 1e-6
    by_points = jnp.vdot(jax.grad(functional)(x), direction)
    ahead, behind = (functional(x + s * direction) for s in (step, -step))
    np.testing.assert_allclose(by_points, (ahead - behind) / (2.0 * step), rtol=1e-7)


def test_facets_are_differentiable_where_meshes_match():
    # Every corner of a piece lies on a corner of the other side, where clipping has a kink.
    mesh, rng = stacked(1 / 4, 1 / 4), np.random.default_rng(2)
    scene, y = touching(mesh), jnp.asarray(rng.normal(size=mesh.points.shape))
    is_inside = np.abs(mesh.points[:, :1] - 0.5) < 0.4
    change = rng.normal(size=mesh.points.shape) * is_inside * np.array([[1.0, 0.0]])

    @jax.jit
    def functional(points):
        system = jc.discretize(jc.Scene(mesh.with_points(points), RUBBER, contact=scene.contact))
        return jnp.sum(jnp.sin(system.normals @ system.restrict(y)))

    x, step = jnp.asarray(mesh.points), 1e-6
    by_points = jnp.vdot(jax.grad(functional)(x), change)
    ahead, behind = (functional(x + s * change) for s in (step, -step))
    assert abs(by_points) > 0.1
    np.testing.assert_allclose(by_points, (ahead - behind) / (2.0 * step), rtol=1e-5)


@pytest.mark.parametrize("d", [2, 3])
def test_facets_of_traced_nodes_stay_right_for_small_motions(d):
    mesh = stacked(1 / 3, 1 / 3, d, gap=0.1)
    moves = 0.01 * np.random.default_rng(5).uniform(-1.0, 1.0, size=mesh.points.shape)
    is_on_face = (mesh.points < 1e-9) | (mesh.points > 1.0 - 1e-9)
    points = mesh.points + np.where(is_on_face, 0.0, moves)
    field = jnp.asarray(np.random.default_rng(6).normal(size=points.shape))

    def rows(points):
        system = jc.discretize(touching(mesh.with_points(points)))
        return system.normals @ system.restrict(field), system.gap, system.contact_area

    for traced, concrete in zip(jax.jit(rows)(jnp.asarray(points)), rows(points), strict=True):
        np.testing.assert_allclose(traced, concrete, rtol=1e-12, atol=1e-13)


ONCE = r"'lower/top' -> 'upper/bottom' and 'upper/bottom' -> 'lower/top' constrain the same gap"
TWO_SIDED = {"upper/bottom": jc.Facets("lower/top"), "lower/top": jc.Facets("upper/bottom")}


@pytest.mark.parametrize(
    ("contact", "message"),
    [
        ({"upper/bottom": jc.Facets("floor")}, r"Facets\('floor'\) .* is not in the mesh"),
        ({"upper/bottom": jc.Facets("upper/left")}, "share 1 nodes, .*jc.join"),
        ({"upper/bottom": jc.Facets("lower/top", [0.0])}, r"along must have shape \(2,\)"),
        ({"upper/bottom": jc.Facets("lower/top", [0.0, 0.0])}, "along must be finite and not zero"),
        ({"upper/bottom": jc.Facets("lower/top", [0.0, np.nan])}, "along must be finite"),
        ({"upper/top": jc.Facets("lower/bottom")}, "none of the 4 nodes .*'upper/top'.* sees"),
        (TWO_SIDED, ONCE),
    ],
    ids=["name", "shared nodes", "shape", "zero", "nan", "turned away", "two-sided"],
)
def test_facets_that_cannot_meet_are_refused(contact, message):
    with pytest.raises(ValueError, match=message):
        jc.discretize(jc.Scene(stacked(1 / 4, 1 / 3), RUBBER, contact=contact))


def test_facets_that_are_clamped_as_slaves_are_refused():
    with pytest.raises(ValueError, match=r"'upper/bottom' and the clamped sets .* share 4 nodes"):
        jc.discretize(touching(stacked(1 / 4, 1 / 3), clamped=("upper/bottom",)))


def test_facets_may_form_a_chain():
    mesh = jc.join({"pair": stacked(1 / 4, 1 / 3), "third": cube_above()})
    contact = {
        "pair/upper/bottom": jc.Facets("pair/lower/top"),
        "third/bottom": jc.Facets("pair/upper/top"),
    }
    system = jc.discretize(jc.Scene(mesh, RUBBER, contact=contact))
    assert np.linalg.matrix_rank(system.normals.to_scipy().toarray()) == system.normals.count == 7


def cube_above():
    return jc.meshes.rectangle((1.0, 1.0), h=0.5).moved(translation=[0.0, 2.0])


def test_facets_need_concrete_positions_to_be_searched():
    mesh = stacked(1 / 4, 1 / 3)

    @jax.jit
    def gap(points):
        traced = jc.Mesh.from_arrays(points, mesh.cells, mesh.facets)
        return jc.discretize(touching(traced)).gap

    with pytest.raises(ValueError, match=r"JAX traces them; .*mesh.with_points"):
        gap(jnp.asarray(mesh.points))


def test_facets_need_a_concrete_direction():
    def gap(along):
        return jnp.sum(jc.discretize(touching(stacked(1 / 4, 1 / 3), along=along)).gap)

    with pytest.raises(ValueError, match=r"Facets\('lower/top'\).along must be concrete"):
        jax.grad(gap)(jnp.array([0.0, -1.0]))
