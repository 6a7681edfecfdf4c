"""Structured meshes of simple bodies, with named facet sets.

`h` is the target edge length [m]: a length L is cut into ceil(L / h) edges. Boxes of every
dimension share one construction, Kuhn's division of a grid cell into d! simplices; discs are rings
of a hexagonal lattice; the half ball is a refined half octahedron blown up to a sphere.

Source: H. W. Kuhn, Some combinatorial lemmas in topology, IBM J. Res. Dev. 4 (1960) 518-524.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from jaxcontact.scene.mesh import Mesh, boundary_facets

__all__ = ["ball", "box", "disc", "half_ball", "half_disc", "interval", "rectangle"]

#: Signs that make the eight octants of the one where x, y >= 0 >= z, the lower ones first.
_OCTANTS = np.array([(i, j, k) for k in (1, -1) for j in (1, -1) for i in (1, -1)])

_SIDES = {
    1: (("left", "right"),),
    2: (("left", "right"), ("bottom", "top")),
    3: (("left", "right"), ("front", "back"), ("bottom", "top")),
}


def interval(length: float, *, h: float) -> Mesh:
    """The bar [0, length], with facet sets `left` (x = 0) and `right`.

    Args:
        length: Length [m].
        h: Edge length [m], rounded down so that a whole number of cells fits.

    Returns:
        A mesh of ceil(length / h) equal segments.

    Raises:
        ValueError: A length is not positive and finite.
    """
    return _kuhn_grid((length,), h)


def rectangle(lengths: tuple[float, float], *, h: float) -> Mesh:
    """The rectangle [0, a] x [0, b], with facet sets `left`, `right`, `bottom` and `top`.

    Args:
        lengths: Width a and height b [m].
        h: Edge length along the axes [m], rounded down so that whole cells fit.

    Returns:
        A mesh of right triangles whose diagonals all point to the upper right.

    Raises:
        ValueError: There are not two lengths, or one is not positive and finite.
    """
    return _kuhn_grid(_check_lengths(lengths, 2), h)


def box(lengths: tuple[float, float, float], *, h: float) -> Mesh:
    """The box [0, a] x [0, b] x [0, c], with the six sides as facet sets.

    `left` and `right` bound x, `front` and `back` bound y, `bottom` and `top` bound z.

    Args:
        lengths: Extents a, b and c [m] along x, y and z.
        h: Edge length along the axes [m], rounded down so that whole cells fit.

    Returns:
        A mesh of six tetrahedra per grid cell around its diagonal.

    Raises:
        ValueError: There are not three lengths, or one is not positive and finite.
    """
    return _kuhn_grid(_check_lengths(lengths, 3), h)


def disc(radius: float, *, h: float, contact: tuple[float, float] = (-120.0, -60.0)) -> Mesh:
    """The disc around the origin, with facet sets `boundary` and `contact`.

    Args:
        radius: Radius [m].
        h: Distance of the rings [m], rounded down so that ceil(radius / h) rings fit.
        contact: Start and end of the arc `contact`, counter-clockwise [degrees]: the facets whose
            middle lies between them. (-180, 180) is the whole boundary.

    Returns:
        A mesh of m = ceil(radius / h) rings with 6 k nodes on ring k and 6 m^2 triangles.

    Raises:
        ValueError: A length is not positive and finite, or the arc holds no facet.
    """
    m = _count("radius", radius, h)
    points, cells, node = _rings(radius, m, sectors=6)
    edge = np.arange(6 * m)
    boundary = np.stack([node(m, edge), node(m, edge + 1)], axis=1)
    is_contact = ((edge + 0.5) * 60.0 / m - 180.0 - contact[0]) % 360.0 < contact[1] - contact[0]
    if not is_contact.any():
        raise ValueError(
            f"no facet has its middle in the arc contact={contact}, counter-clockwise in degrees; "
            f"a facet has {60.0 / m:.3g} of them"
        )
    sets = {"boundary": boundary, "contact": boundary[is_contact]}
    return Mesh.from_arrays(points, cells, sets)


def half_disc(radius: float, *, h: float) -> Mesh:
    """The lower half (y <= 0) of the disc around the origin.

    The facet set `clamped` is the flat top, `contact` the middle third of the arc, which ends at
    nodes at -120 and -60 degrees. The mesh is symmetric about the y axis; with an even number of
    rings one of its nodes is the lowest point (0, -radius).

    Args:
        radius: Radius [m].
        h: Distance of the rings [m], rounded down so that ceil(radius / h) rings fit.

    Returns:
        A mesh of m = ceil(radius / h) rings with 3 k + 1 nodes on ring k and 3 m^2 triangles.

    Raises:
        ValueError: A length is not positive and finite.
    """
    m = _count("radius", radius, h)
    points, cells, node = _rings(radius, m, sectors=3)
    ring = np.arange(m)
    left = np.stack([node(ring, 3 * ring), node(ring + 1, 3 * ring + 3)], axis=1)
    right = np.stack([node(ring, 0 * ring), node(ring + 1, 0 * ring)], axis=1)
    clamped = np.concatenate([left, right])
    # sin(-pi) is not zero in floating point; the top is flat.
    points[np.unique(clamped), 1] = 0.0
    arc = np.arange(m, 2 * m)
    contact = np.stack([node(m, arc), node(m, arc + 1)], axis=1)
    return Mesh.from_arrays(points, cells, {"clamped": clamped, "contact": contact})


def half_ball(radius: float, *, h: float) -> Mesh:
    """The lower half (z <= 0) of the ball around the origin.

    The facet set `clamped` is the flat top; `contact` are the facets of the sphere whose centroid
    is seen from the origin within 30 degrees of the lowest point (0, 0, -radius), which is a node.
    The nodes are those of the half octahedron |i| + |j| + |k| <= m, k <= 0, moved along rays
    to x = radius (|i| + |j| + |k|) / m (i, j, k) / |(i, j, k)|_2.

    Args:
        radius: Radius [m].
        h: Distance of the shells [m], rounded down so that ceil(radius / h) shells fit, at
            least two, so that the contact set is not empty.

    Returns:
        A mesh of m = max(2, ceil(radius / h)) shells and 4 m^3 tetrahedra. Dihedral angles lie
        between 28.9 and 138.5 degrees, edges between h and 3.2 h (the longest near the sphere).

    Raises:
        ValueError: A length is not positive and finite.
    """
    points, cells, facets, low = _blown_up(radius, h, _OCTANTS[:4])
    top = (points[facets, 2] == 0).all(axis=1)
    return Mesh.from_arrays(points, cells, {"clamped": facets[top], "contact": facets[low & ~top]})


def ball(radius: float, *, h: float) -> Mesh:
    """The ball around the origin, with facet sets `boundary` and `contact`.

    It is `half_ball` and its mirror image; `contact` is the same part of the sphere.

    Args:
        radius: Radius [m].
        h: Distance of the shells [m], as of `half_ball`.

    Returns:
        A mesh of m = max(2, ceil(radius / h)) shells and 8 m^3 tetrahedra.

    Raises:
        ValueError: A length is not positive and finite.
    """
    points, cells, facets, low = _blown_up(radius, h, _OCTANTS)
    return Mesh.from_arrays(points, cells, {"boundary": facets, "contact": facets[low]})


def _blown_up(radius: float, h: float, octants: np.ndarray):
    """Points (N,3), cells (E,4) and boundary facets (B,3) of octants of a ball.

    With them whether the origin sees a facet within 30 degrees of the lowest point, (B,).
    """
    m = max(2, _count("radius", radius, h))
    lattice, cells = _octahedron(m, octants)
    shell = np.abs(lattice).sum(axis=1)
    length = np.maximum(np.linalg.norm(lattice, axis=1), 1.0)
    points = lattice * (radius * shell / (m * length))[:, None]
    facets = boundary_facets(cells)
    centroids = points[facets].mean(axis=1)
    low = -centroids[:, 2] >= math.cos(math.pi / 6) * np.linalg.norm(centroids, axis=1)
    return points, cells, facets, low


def _kuhn_grid(lengths: tuple[float, ...], h: float) -> Mesh:
    """The box [0, lengths] cut along a grid and every grid cell into d! simplices."""
    d = len(lengths)
    counts = [_count("length", length, h) for length in lengths]
    shape = tuple(n + 1 for n in counts)
    axes = [np.linspace(0.0, length, n + 1) for length, n in zip(lengths, counts, strict=True)]
    points = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=1)
    corner = np.ravel_multi_index([*np.indices(counts).reshape(d, -1)], shape)
    paths = np.ravel_multi_index(np.moveaxis(_kuhn_simplices(d), -1, 0), shape)  # (d!,d+1)
    cells = (corner[:, None, None] + paths).reshape(-1, d + 1)
    boundary = boundary_facets(cells)
    position = np.stack(np.unravel_index(boundary, shape), axis=-1)  # (B,d) -> (B,d,axes)
    facets = {
        side: boundary[(position[:, :, axis] == end).all(axis=1)]
        for axis, sides in enumerate(_SIDES[d])
        for side, end in zip(sides, (0, counts[axis]), strict=True)
    }
    return Mesh.from_arrays(points, cells, facets)


def _kuhn_simplices(d: int) -> np.ndarray:
    """Corners of the d! simplices of the unit cube, positively oriented, (d!,d+1,d)."""
    simplices = []
    for path in itertools.permutations(range(d)):
        steps = np.eye(d, dtype=np.int64)[list(path)]
        corners = np.concatenate([np.zeros((1, d), np.int64), steps.cumsum(axis=0)])
        if np.linalg.det(steps) < 0:
            corners[[-2, -1]] = corners[[-1, -2]]
        simplices.append(corners)
    return np.array(simplices)


def _rings(radius: float, m: int, sectors: int):
    """Rings k = 0..m around the origin, in sectors of 60 degrees from -180 degrees on.

    Returns:
        Points (N,2), cells (E,3), and the function (k, i) -> index of node i of ring k, where i
        counts from -180 degrees on in steps of 60/k degrees.
    """
    rings = np.arange(m + 1)
    sizes = np.maximum(sectors * rings + (sectors < 6), 1)
    offsets = np.cumsum(sizes) - sizes

    def node(k, i):
        return offsets[k] + i % sizes[k]

    ring = np.repeat(rings, sizes)
    i = np.arange(len(ring)) - offsets[ring]
    angle = np.pi * (i / (3.0 * np.maximum(ring, 1)) - 1.0)
    points = (radius * ring / m)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    k, j = np.tril_indices(m)
    start = np.arange(sectors)[:, None]
    inner, outer = start * k + j, start * (k + 1) + j
    up = [node(k, inner), node(k + 1, outer), node(k + 1, outer + 1)]
    gap = [node(k, inner), node(k + 1, outer + 1), node(k, inner + 1)]
    # The last position of a sector's inner ring has no edge after it, hence no second triangle.
    cells = [np.stack(up, axis=-1).reshape(-1, 3), np.stack(gap, axis=-1)[:, j < k].reshape(-1, 3)]
    return points, np.concatenate(cells), node


def _octahedron(m: int, octants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lattice points (N,3) and cells (E,4) of |i| + |j| + |k| <= m in some octants.

    With a = (|i|+|j|+|k|, ., .) as partial sums an octant is m >= a_1 >= a_2 >= a_3 >= 0, on which
    Kuhn's simplices of the unit grid fit exactly; octants are mirror images, hence conforming.
    """
    corner = np.stack([*np.indices((m, m, m))], axis=-1).reshape(-1, 1, 1, 3)
    simplices = (corner + _kuhn_simplices(3)).reshape(-1, 4, 3)
    sums = simplices[(simplices[:, :, :-1] >= simplices[:, :, 1:]).all(axis=(1, 2))]
    # k in the middle of the partial sums keeps the mesh symmetric under i <-> j.
    octant = np.stack(
        [sums[..., 0] - sums[..., 1], sums[..., 2], sums[..., 2] - sums[..., 1]], axis=-1
    )
    corners = octant * octants[:, None, None]  # (E/8,4,3) -> (octants,E/8,4,3)
    is_mirrored = np.prod(octants, axis=1) < 0
    corners[is_mirrored] = corners[is_mirrored][:, :, [0, 1, 3, 2]]
    shape = (2 * m + 1, 2 * m + 1, m + 1 if (octants[:, 2] > 0).all() else 2 * m + 1)
    grid = np.stack([*np.indices(shape)], axis=-1).reshape(-1, 3) - m
    inside = np.abs(grid).sum(axis=1) <= m
    number = np.cumsum(inside) - 1
    keys = np.ravel_multi_index(np.moveaxis(corners.reshape(-1, 4, 3) + m, -1, 0), shape)
    return grid[inside], number[keys]


def _count(name: str, length: float, h: float) -> int:
    """Number of edges of length at most h on `length`, forgiving round-off."""
    for what, value in ((name, length), ("h", h)):
        if not (value > 0 and math.isfinite(value)):
            raise ValueError(
                f"{what} is {value}; pass a positive, finite length in metres"
                + (f", for example h={name} / 8" if what == "h" else "")
            )
    return max(1, math.ceil(length / h * (1 - 1e-9)))


def _check_lengths(lengths, d: int) -> tuple[float, ...]:
    if np.shape(lengths) != (d,):
        raise ValueError(f"lengths are {lengths}; pass a tuple of {d} positive lengths in metres")
    return tuple(lengths)
