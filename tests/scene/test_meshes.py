import itertools
import math

import numpy as np
import pytest

from jaxcontact.scene import meshes
from jaxcontact.scene.mesh import boundary_facets, cell_volumes, facet_keys

# Coordinates carry a few rounding errors of size eps times the radius.
ROUND_OFF = 1e-13

ALL = {
    "interval": meshes.interval(2.0, h=0.3),
    "rectangle": meshes.rectangle((2.0, 1.0), h=0.3),
    "box": meshes.box((2.0, 1.0, 1.5), h=0.4),
    "disc": meshes.disc(2.0, h=0.3),
    "half_disc": meshes.half_disc(2.0, h=0.3),
    "half_ball": meshes.half_ball(2.0, h=0.3),
}
HALF_BODIES = ["half_disc", "half_ball"]


def corner_angles(mesh):
    """Angles of all triangles [degrees], (E,3)."""
    x = mesh.points[mesh.cells]
    angles = []
    for i in range(3):
        a, b = x[:, i - 2] - x[:, i], x[:, i - 1] - x[:, i]
        cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        angles.append(np.degrees(np.arccos(cosine)))
    return np.stack(angles, axis=1)


def dihedral_angles(mesh):
    """Angles between the faces of all tetrahedra [degrees], (E,6)."""
    x = mesh.points[mesh.cells]
    normals = []
    for a, b, c in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)):
        n = np.cross(x[:, b] - x[:, a], x[:, c] - x[:, a])
        normals.append(n / np.linalg.norm(n, axis=1, keepdims=True))
    pairs = [-(n * k).sum(axis=1) for n, k in itertools.combinations(normals, 2)]
    return np.degrees(np.arccos(np.stack(pairs, axis=1)))


def euler_characteristic(mesh):
    total = 0
    for size in range(1, mesh.dimension + 2):
        faces = [mesh.cells[:, c] for c in itertools.combinations(range(mesh.dimension + 1), size)]
        n_faces = len(np.unique(np.sort(np.concatenate(faces), axis=1), axis=0))
        total += (-1) ** (size - 1) * n_faces
    return total


def slope(errors):
    """Observed orders between meshes of half the edge length."""
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


@pytest.mark.parametrize("name", ALL)
def test_meshes_have_positively_oriented_cells(name):
    assert (cell_volumes(ALL[name].points, ALL[name].cells) > 0).all()


@pytest.mark.parametrize("name", ALL)
def test_meshes_conform(name):
    # In a conforming mesh only facets on the surface of the body belong to a single cell.
    mesh = ALL[name]
    d = mesh.dimension
    facets = np.concatenate([np.delete(mesh.cells, i, axis=1) for i in range(d + 1)])
    counts = np.unique(facet_keys(facets, mesh.n_nodes), return_counts=True)[1]
    assert counts.max() <= 2
    x = mesh.points[boundary_facets(mesh.cells)]  # (F,d,d)
    if name in ("interval", "rectangle", "box"):
        sides = np.stack([np.zeros(d), mesh.points.max(axis=0)])
        on_surface = (x[:, :, None, :] == sides).all(axis=1).any(axis=(1, 2))
    else:
        on_surface = (np.abs(np.linalg.norm(x, axis=-1) - 2.0) < ROUND_OFF).all(axis=1)
        if name in HALF_BODIES:
            on_surface |= (x[..., -1] == 0).all(axis=1)
    assert on_surface.all()


@pytest.mark.parametrize("name", ALL)
def test_meshes_have_the_euler_characteristic_of_a_ball(name):
    assert euler_characteristic(ALL[name]) == 1


@pytest.mark.parametrize(("name", "volume"), [("interval", 2.0), ("rectangle", 2.0), ("box", 3.0)])
def test_boxes_fill_their_volume(name, volume):
    total = cell_volumes(ALL[name].points, ALL[name].cells).sum()
    np.testing.assert_allclose(total, volume, rtol=ROUND_OFF)


@pytest.mark.parametrize(("name", "arc"), [("disc", 6), ("half_disc", 3)])
def test_discs_fill_the_polygon_of_their_boundary_nodes(name, arc):
    mesh = ALL[name]
    n_edges = arc * 7  # ceil(2 / 0.3) rings
    polygon = n_edges * 0.5 * 2.0**2 * math.sin(arc * math.pi / 3 / n_edges)
    total = cell_volumes(mesh.points, mesh.cells).sum()
    np.testing.assert_allclose(total, polygon, rtol=ROUND_OFF)


@pytest.mark.parametrize(
    ("make", "volume"),
    [(meshes.disc, np.pi), (meshes.half_disc, np.pi / 2), (meshes.half_ball, 2 * np.pi / 3)],
)
def test_round_bodies_approach_their_volume_with_order_two(make, volume):
    errors = []
    for m in (4, 8, 16):
        mesh = make(1.0, h=1 / m)
        errors.append(1 - cell_volumes(mesh.points, mesh.cells).sum() / volume)
    # The half ball is still 0.1 from the asymptotic order at these sizes.
    assert (np.abs(slope(errors) - 2) < 0.11).all()
    assert 0 < errors[-1] < 6e-3


def test_interval_has_nodes_in_order_from_zero_to_length():
    np.testing.assert_array_equal(meshes.interval(2.0, h=0.5).points[:, 0], [0, 0.5, 1, 1.5, 2])


@pytest.mark.parametrize(
    ("name", "axis", "lower", "upper"),
    [
        ("interval", 0, "left", "right"),
        ("rectangle", 0, "left", "right"),
        ("rectangle", 1, "bottom", "top"),
        ("box", 0, "left", "right"),
        ("box", 1, "front", "back"),
        ("box", 2, "bottom", "top"),
    ],
)
def test_boxes_name_exactly_the_facets_of_each_side(name, axis, lower, upper):
    mesh = ALL[name]
    boundary = boundary_facets(mesh.cells)
    for side, position in ((lower, 0.0), (upper, mesh.points[:, axis].max())):
        on_side = (mesh.points[boundary][:, :, axis] == position).all(axis=1)
        assert on_side.sum() > 0
        assert {*map(tuple, mesh.facets[side])} == {*map(tuple, boundary[on_side])}


@pytest.mark.parametrize("name", ["interval", "rectangle", "box"])
def test_boxes_name_every_boundary_facet_once(name):
    facets = np.concatenate([*ALL[name].facets.values()])
    assert len(facets) == len(boundary_facets(ALL[name].cells))
    assert len(np.unique(facet_keys(facets, ALL[name].n_nodes))) == len(facets)


def test_box_reaches_from_the_origin_to_its_lengths():
    np.testing.assert_array_equal(ALL["box"].points.min(axis=0), [0, 0, 0])
    np.testing.assert_array_equal(ALL["box"].points.max(axis=0), [2.0, 1.0, 1.5])


@pytest.mark.parametrize(("h", "n_cells"), [(0.1, 10), (0.0999, 11), (0.1 / (1 + 1e-11), 10)])
def test_interval_counts_cells_by_ceil_up_to_round_off(h, n_cells):
    assert meshes.interval(1.0, h=h).n_cells == n_cells


def test_rectangle_edges_along_the_axes_are_at_most_h():
    for coordinates in ALL["rectangle"].points.T:
        assert np.diff(np.unique(coordinates)).max() <= 0.3


@pytest.mark.parametrize("m", [1, 2, 3, 8, 21])
@pytest.mark.parametrize("make", [meshes.disc, meshes.half_disc])
def test_discs_keep_their_angles_away_from_zero(make, m):
    # 20 degrees would do for the convergence theory; the rings stay above 43.
    assert corner_angles(make(1.0, h=1 / m)).min() > 43


@pytest.mark.parametrize("m", [2, 3, 8, 13])
def test_half_ball_keeps_its_dihedral_angles_between_the_documented_bounds(m):
    angles = dihedral_angles(meshes.half_ball(1.0, h=1 / m))
    assert angles.min() > 28.9
    assert angles.max() < 138.5


@pytest.mark.parametrize("m", [2, 13])
def test_half_ball_edges_lie_between_the_documented_bounds(m):
    mesh = meshes.half_ball(1.0, h=1 / m)
    pairs = itertools.combinations(range(4), 2)
    x = mesh.points[mesh.cells]
    lengths = np.array([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in pairs])
    assert lengths.min() > (1 - ROUND_OFF) / m
    assert lengths.max() < 3.2 / m


def test_half_disc_of_eight_rings_has_two_hundred_unknowns():
    mesh = meshes.half_disc(15.0, h=15 / 8)
    clamped = np.unique(mesh.facets["clamped"])
    assert mesh.n_nodes == 117
    assert len(clamped) == 17
    assert 2 * (mesh.n_nodes - len(clamped)) == 200


@pytest.mark.parametrize("name", ["disc", "half_disc"])
@pytest.mark.parametrize("m", [1, 7, 8])
def test_disc_contact_arc_ends_at_minus_120_and_minus_60_degrees(name, m):
    mesh = getattr(meshes, name)(15.0, h=15 / m)
    x = mesh.points[np.unique(mesh.facets["contact"])]
    ends = x[[x[:, 0].argmin(), x[:, 0].argmax()]]
    expected = 15 * np.array([[-0.5, -math.sqrt(0.75)], [0.5, -math.sqrt(0.75)]])
    np.testing.assert_allclose(ends, expected, rtol=ROUND_OFF)
    assert len(mesh.facets["contact"]) == m
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 15.0, rtol=ROUND_OFF)
    assert (x[:, 1] <= -15 * math.sqrt(0.75) + 1e-12).all()


@pytest.mark.parametrize("name", HALF_BODIES)
def test_half_bodies_lie_below_their_flat_top(name):
    mesh = ALL[name]
    assert mesh.points[:, -1].max() == 0
    on_top = np.flatnonzero(mesh.points[:, -1] == 0)
    assert np.array_equal(np.unique(mesh.facets["clamped"]), on_top)


@pytest.mark.parametrize("name", HALF_BODIES)
def test_half_bodies_clamp_every_facet_of_the_top(name):
    mesh = ALL[name]
    boundary = boundary_facets(mesh.cells)
    on_top = (mesh.points[boundary][..., -1] == 0).all(axis=1)
    assert {*map(tuple, mesh.facets["clamped"])} == {*map(tuple, boundary[on_top])}


@pytest.mark.parametrize("m", [1, 2, 3, 8])
@pytest.mark.parametrize("name", HALF_BODIES)
def test_half_bodies_keep_contact_and_clamped_nodes_apart(name, m):
    facets = getattr(meshes, name)(1.0, h=1 / m).facets
    assert not np.intersect1d(facets["contact"], facets["clamped"]).size


@pytest.mark.parametrize("name", HALF_BODIES)
def test_half_bodies_have_their_lowest_node_at_minus_radius(name):
    mesh = getattr(meshes, name)(15.0, h=15 / 8)
    lowest = mesh.points[mesh.points[:, -1].argmin()]
    np.testing.assert_allclose(lowest, [0.0, 0.0, -15.0][-len(lowest) :], atol=15 * ROUND_OFF)
    assert mesh.points[:, -1].argmin() in mesh.facets["contact"]


def test_half_disc_is_symmetric_about_the_vertical_axis():
    mesh = ALL["half_disc"]
    distance = np.linalg.norm(mesh.points[:, None] * [-1, 1] - mesh.points, axis=-1)  # (N,N)
    mirror = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 2 * ROUND_OFF
    cells = {*map(tuple, np.sort(mesh.cells, axis=1))}
    assert cells == {*map(tuple, np.sort(mirror[mesh.cells], axis=1))}


@pytest.mark.parametrize("mirror", [[-1, 1, 1], [1, -1, 1], None])
def test_half_ball_is_symmetric_about_both_axes_and_their_diagonal(mirror):
    mesh = ALL["half_ball"]
    image = mesh.points[:, [1, 0, 2]] if mirror is None else mesh.points * mirror
    distance = np.linalg.norm(image[:, None] - mesh.points, axis=-1)  # (N,N)
    assert distance.min(axis=1).max() < 2 * ROUND_OFF
    cells = {*map(tuple, np.sort(mesh.cells, axis=1))}
    assert cells == {*map(tuple, np.sort(distance.argmin(axis=1)[mesh.cells], axis=1))}


def test_half_ball_contact_is_the_cap_of_30_degrees_by_centroid():
    mesh = ALL["half_ball"]
    boundary = boundary_facets(mesh.cells)
    x = mesh.points[boundary].mean(axis=1)
    polar = np.degrees(np.arctan2(np.hypot(x[:, 0], x[:, 1]), -x[:, 2]))
    sphere = ~(mesh.points[boundary][..., 2] == 0).all(axis=1)
    expected = {*map(tuple, boundary[sphere & (polar <= 30)])}
    assert {*map(tuple, mesh.facets["contact"])} == expected
    assert len(expected) > 10


def test_half_ball_has_at_least_two_shells():
    assert meshes.half_ball(1.0, h=5.0).n_cells == 4 * 2**3


BAD = [0.0, -1.0, math.nan, math.inf]


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("make", [meshes.disc, meshes.half_disc, meshes.half_ball])
def test_round_bodies_refuse_a_bad_radius_or_h(make, bad):
    with pytest.raises(ValueError, match=r"radius is .*pass a positive, finite length"):
        make(bad, h=0.5)
    with pytest.raises(ValueError, match=r"h is .*for example h=radius / 8"):
        make(1.0, h=bad)


@pytest.mark.parametrize("bad", BAD)
def test_boxes_refuse_a_bad_length_or_h(bad):
    with pytest.raises(ValueError, match=r"length is .*pass a positive, finite length"):
        meshes.interval(bad, h=0.5)
    with pytest.raises(ValueError, match=r"length is .*pass a positive, finite length"):
        meshes.box((1.0, bad, 1.0), h=0.5)
    with pytest.raises(ValueError, match=r"h is .*for example h=length / 8"):
        meshes.rectangle((1.0, 1.0), h=bad)


def test_boxes_refuse_the_wrong_number_of_lengths():
    with pytest.raises(ValueError, match=r"pass a tuple of 2 positive lengths"):
        meshes.rectangle(1.0, h=0.5)
    with pytest.raises(ValueError, match=r"pass a tuple of 3 positive lengths"):
        meshes.box((1.0, 1.0), h=0.5)
