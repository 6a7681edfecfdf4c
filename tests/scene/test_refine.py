"""Claims about refined meshes, facet sets by predicate, and the report on the quality of cells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.scene.mesh import boundary_facets, cell_volumes, facet_keys

MESHES = {
    "interval": jc.meshes.interval(1.0, h=0.3),
    "half_disc": jc.meshes.half_disc(1.0, h=0.4),
    "half_ball": jc.meshes.half_ball(1.0, h=0.8),
}
# Volumes: sums of some hundred terms.
ROUNDING = 1e-13


@pytest.fixture(params=MESHES)
def mesh(request):
    coarse = MESHES[request.param]
    regions = {"some": np.arange(coarse.n_cells)[::2]}
    return jc.Mesh.from_arrays(coarse.points, coarse.cells, coarse.facets, regions)


def test_refined_mesh_is_a_mesh_of_the_same_body(mesh):
    fine = mesh.refined()
    # The checks of a new mesh, on conforming and positive cells among others, and on facet sets.
    again = jc.Mesh.from_arrays(fine.points, fine.cells, fine.facets, fine.regions)
    assert fine.n_cells == 2**mesh.dimension * mesh.n_cells
    assert len(boundary_facets(fine.cells)) == 2 ** (mesh.dimension - 1) * len(
        boundary_facets(mesh.cells)
    )
    volume = cell_volumes(mesh.points, mesh.cells)
    children = cell_volumes(again.points, again.cells).reshape(len(volume), -1)
    expected = np.broadcast_to(volume[:, None] / children.shape[1], children.shape)
    np.testing.assert_allclose(children, expected, rtol=ROUNDING)


def test_refined_mesh_keeps_its_sets_and_regions(mesh):
    fine = mesh.refined()
    for name, facets in mesh.facets.items():
        assert len(fine.facets[name]) == 2 ** (mesh.dimension - 1) * len(facets)
        # Every new node of the set lies in the middle of an edge of the set, the old ones are kept.
        assert set(np.unique(facets)) <= set(np.unique(fine.facets[name]))
    # Oriented outward, as facets of the boundary are.
    boundary = boundary_facets(fine.cells)
    for facets in fine.facets.values():
        n = fine.n_nodes
        rows = {key: row for key, row in zip(facet_keys(boundary, n), boundary, strict=True)}
        for row, key in zip(facets, facet_keys(facets, n), strict=True):
            turned = [np.roll(rows[key], k).tolist() for k in range(mesh.dimension)]
            assert row.tolist() in turned
    volume = np.sum(cell_volumes(mesh.points, mesh.cells[mesh.regions["some"]]))
    refined = np.sum(cell_volumes(fine.points, fine.cells[fine.regions["some"]]))
    np.testing.assert_allclose(refined, volume, rtol=ROUNDING)


def test_refined_tetrahedra_do_not_degenerate():
    # A flat cell: cut along another diagonal, its children get flatter each time.
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, 0.3, 0.2]])
    mesh = jc.Mesh.from_arrays(points, np.array([[0, 1, 2, 3]]))
    qualities = [mesh.quality().minimum]
    for _ in range(4):
        mesh = mesh.refined()
        qualities.append(mesh.quality().minimum)
    assert min(qualities) > 0.5 * qualities[0]
    assert qualities[-1] == pytest.approx(qualities[1], rel=1e-9)


def test_refined_mesh_of_traced_points_has_their_derivative():
    mesh = MESHES["half_ball"]

    def second_moment(points):
        fine = mesh.with_points(points).refined()
        return jnp.sum(cell_volumes(fine.points, fine.cells) * fine.points[fine.cells[:, 0], 2])

    x = jnp.asarray(mesh.points)
    slope = jnp.vdot(jax.jit(jax.grad(second_moment))(x), x)
    # Of fourth degree in the positions.
    np.testing.assert_allclose(slope, 4.0 * second_moment(x), rtol=1e-10)


def test_refined_mesh_of_nothing_concrete_is_refused():
    cells = MESHES["half_ball"].cells
    with pytest.raises(ValueError, match="refinement needs concrete node positions"):
        jax.jit(lambda x: jc.Mesh.from_arrays(x, cells).refined().points)(
            MESHES["half_ball"].points
        )


def test_with_set_chooses_facets_by_place_and_normal():
    disc = jc.meshes.disc(1.0, h=0.2)
    lower = disc.with_set("lower", lambda x, n: n[:, 1] < -0.5)
    nodes = disc.points[np.unique(lower.facets["lower"])]
    assert np.all(nodes[:, 1] < -0.4)
    np.testing.assert_allclose(np.linalg.norm(nodes, axis=1), 1.0)
    near = disc.with_set("near", lambda x, n: np.hypot(x[:, 0], x[:, 1] - 1.0) < 0.3)
    assert 2 <= len(near.facets["near"]) <= 4
    assert set(disc.facets) | {"near"} == set(near.facets)


@pytest.mark.parametrize("name", MESHES)
def test_with_set_gets_outward_unit_normals(name):
    mesh, seen = MESHES[name], []

    def choose(x, n):
        seen.append((x, n))
        return np.ones(len(x), bool)

    chosen = mesh.with_set("all", choose).facets["all"]
    np.testing.assert_array_equal(chosen, boundary_facets(mesh.cells))
    x, n = seen[0]
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0)
    # The bodies are convex.
    assert np.all(np.sum(n * (x - mesh.points.mean(axis=0)), axis=1) > 0.0)


def test_with_set_makes_a_contact_set():
    mesh = jc.meshes.rectangle((1.0, 1.0), h=0.5).with_set("low", lambda x, n: n[:, 1] < -0.9)
    np.testing.assert_array_equal(np.sort(mesh.facets["low"]), np.sort(mesh.facets["bottom"]))


@pytest.mark.parametrize(
    ("name", "predicate", "message"),
    [
        (
            "new",
            lambda x, n: x[:, 0] > 2.0,
            r"'new': the predicate chooses none of the 8 .*between",
        ),
        ("top", lambda x, n: x[:, 0] > 0.0, "a new facet set needs a name"),
        (3, lambda x, n: x[:, 0] > 0.0, "a new facet set needs a name, a string"),
        ("new", lambda x, n: x[:, 0], r"must return bool of shape \(8,\).*float64"),
        ("new", lambda x, n: x > 0.0, r"must return bool of shape \(8,\).*\(8, 2\)"),
    ],
)
def test_with_set_refuses_what_is_no_choice(name, predicate, message):
    mesh = jc.meshes.rectangle((1.0, 1.0), h=0.5)
    with pytest.raises(ValueError, match=message):
        mesh.with_set(name, predicate)


def test_quality_of_known_cells():
    equilateral = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])
    corner = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    cells = np.arange(3)[None], np.arange(4)[None]
    report = jc.Mesh.from_arrays(equilateral, cells[0]).quality()
    np.testing.assert_allclose([report.minimum, report.smallest_height], [1.0, np.sqrt(0.75)])
    # Volume 1/6, edges 1 and sqrt 2: 12 (3 V)^(2/3) / 9; the height over the slanted face.
    report = jc.Mesh.from_arrays(corner, cells[1]).quality()
    np.testing.assert_allclose(report.minimum, 12.0 * 0.5 ** (2 / 3) / 9.0)
    np.testing.assert_allclose(report.smallest_height, 1.0 / np.sqrt(3.0))
    bar = jc.meshes.interval(1.0, h=0.25).quality()
    np.testing.assert_allclose([bar.minimum, bar.smallest_height], [1.0, 0.25])


def test_quality_names_the_worst_cells():
    mesh = jc.meshes.rectangle((1.0, 1.0), h=0.25)
    middle = np.argmin(np.linalg.norm(mesh.points - 0.5, axis=1))
    points = mesh.points.copy()
    points[middle] += [0.2, 0.0]
    report = mesh.with_points(points).quality()
    worst = report.worst(2)
    assert np.all(np.any(mesh.cells[worst] == middle, axis=1))
    assert np.all(np.diff(report.mean_ratio[report.worst(9)]) >= 0.0)
    text = str(report)
    assert text.startswith(f"{mesh.n_cells} cells, mean ratio")
    assert f"in cell {worst[0]} at (" in text
    assert f"smallest height {report.smallest_height:.3g} m" in text
