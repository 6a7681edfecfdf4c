"""Contact rows between two bodies: gaps at the nodes, dual mortar weights on the other body.

Row i of a contact node x_i with unit direction nu_i, and master nodes k with sum_k m_ik = 1:

    (N y)_i = nu_i . (y_i - sum_k m_ik y_k) <= psi_i.

psi_i is the way along nu_i to the facet that it hits. A slave facet e around the node and a master
facet f overlap along nu_i in a piece, on which slave and master coordinates are l_s and l_m. With
Me = sum w l_s l_s^T and de = sum w l_s over the pieces of e, exact by quadrature, the dual function
psi_i = de_i (Me^-1)_i . l_s satisfies sum w psi_i l_s,j = de_i delta_ij, and

    D_i = sum_e de_i,    m_ik = (1 / D_i) sum_e,f sum w psi_i l_m,k.

Hence (N y) is zero on translations, and on rotations of both bodies, since sum_k m_ik x_k - x_i is
parallel to nu_i: contact forces balance in force and torque. A uniform pressure between flat
surfaces is met exactly on any two meshes (patch test). Everything is of NumPy or JAX, as the node
positions are; d corners of a facet in d dimensions.

Source: Wohlmuth, SIAM J. Numer. Anal. 38 (2000) 989-1012; Popp, Gitterle, Gee, Wall, Int. J. Numer.
Meth. Engng 83 (2010) 1428-1465; MATH.md 9. Here each row is divided by D_i, and the gap is that of
the node: an averaged one sees penetration in a curved gap that is closed at the nodes.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.scene.cells import area_vectors
from jaxcontact.system.block_matrix import scatter
from jaxcontact.transforms.traced import Values, is_traced


class Meeting(NamedTuple):
    """Which facets meet: C rows, G slave facets around their nodes, Z pieces of overlap."""

    nodes: np.ndarray
    """Slave node of each row, (C,) int32."""

    hit: np.ndarray
    """Nodes of the master facet that the ray of each row hits, (C, d) int32."""

    own: np.ndarray
    """Nodes of the slave facets around the nodes of the rows, that node first, (G, d) int32."""

    row: np.ndarray
    """Row of each of these facets, (G,) int32."""

    facets: np.ndarray
    """Nodes of the master facet of each piece, (Z, d) int32."""

    group: np.ndarray
    """Which of the G slave facets each piece lies on, (Z,) int32."""

    masters: np.ndarray
    """Master nodes of each row, (C, m) int32; rows with fewer repeat their own slave node."""

    slots: np.ndarray
    """Place of the nodes of each piece in the masters of its row, (Z, d) int32; m + s for a node
    of the clamped set s."""

    held: np.ndarray
    """Numbers of the clamped sets, (S,) int32."""


class MortarRows(NamedTuple):
    """The values of C contact rows with at most m master nodes each."""

    gap: Array | np.ndarray
    """Way to the other body along the normal, (C,) [m]; negative means penetration."""

    normals: Array | np.ndarray
    """Unit directions nu from the slave to the master, (C, d)."""

    area: Array | np.ndarray
    """Integral of the dual function, D, (C,) [m^(d-1)]: force over it is the pressure."""

    shares: Array | np.ndarray
    """Weights m_ik of the master nodes, (C, m)."""

    held: Array | np.ndarray
    """Sum of the weights of the nodes of each clamped set, (C, S)."""


def mortar_rows(
    points: Values,
    slave: np.ndarray,
    ends: np.ndarray,
    along: np.ndarray | None,
    meeting: Meeting,
) -> MortarRows:
    """Return the rows of facets that meet, on the host if the positions are concrete.

    Args:
        points: node positions, (N, d) [m].
        slave: facets of the contact set, (F, d).
        ends: see `area_vectors`.
        along: direction of all rows, (d,), or None for the normals of the contact set.
        meeting: which facets meet.

    Derivative: by the positions, with the meeting facets fixed; one-sided where the end of one
    contact set lies exactly on a node or edge of the other.
    """
    if is_traced(points):
        return _traced_rows(points, slave, ends, along, meeting)
    return _rows(np.asarray(points), slave, ends, along, meeting)


def _rows(
    points: Values, slave: Values, ends: Values, along: Values | None, meeting: Meeting
) -> MortarRows:
    xp, d = _numpy_of(points), points.shape[1]
    count, own_count = len(meeting.nodes), len(meeting.row)
    normals = directions(points, slave, ends, along, meeting.nodes)
    gap = meet(points[meeting.hit], points[meeting.nodes], normals)[1]

    own, nu = points[meeting.own[meeting.group]], normals[meeting.row[meeting.group]]
    corners = project(own, points[meeting.facets], nu)  # (z, b, a)
    weights, places = overlap(corners)
    gram = xp.einsum("zq,zqa,zqc->zac", weights, places, places)
    gram = scatter(gram, meeting.group, own_count)
    integrals = scatter(xp.einsum("zq,zq->z", weights, places[:, :, 0]), meeting.group, own_count)
    dual = integrals[:, None] * xp.linalg.inv(gram)[:, 0]  # (g, a)
    # The weights are relative to the volume of the unit simplex.
    size = xp.linalg.norm(area_vectors(points, meeting.own, ends), axis=1) * math.factorial(d - 1)
    area = scatter(size * integrals, meeting.row, count)

    function = xp.einsum("za,zqa->zq", (size[:, None] * dual)[meeting.group], places)
    on_master = places @ xp.linalg.inv(corners)  # (z, q, b)
    parts = xp.einsum("zq,zq,zqb->zb", weights, function, on_master)
    n_masters = meeting.masters.shape[1]
    width = n_masters + len(meeting.held)
    slots = meeting.row[meeting.group][:, None] * width + meeting.slots
    shares = scatter(parts.reshape(-1), slots.reshape(-1), count * width)
    shares = shares.reshape(count, width) / area[:, None]
    return MortarRows(gap, normals, area, shares[:, :n_masters], shares[:, n_masters:])


_traced_rows = jax.jit(_rows)


def directions(
    points: Values, facets: np.ndarray, ends: Values, along: Values | None, nodes: np.ndarray
) -> Values:
    """Return the unit direction of the given nodes of the facets, (C, d); see `mortar_rows`."""
    xp, d = _numpy_of(points), points.shape[1]
    if along is not None:
        sums = xp.broadcast_to(xp.asarray(along, points.dtype)[None, :], (len(nodes), d))
    else:
        vectors = xp.repeat(area_vectors(points, facets, ends), d, axis=0)
        sums = scatter(vectors, facets.reshape(-1), len(points))[nodes]
    return sums / xp.linalg.norm(sums, axis=1, keepdims=True)


def meet(corners: Values, x: Values, nu: Values) -> tuple[Values, Values]:
    """Return where lines x + t nu meet the planes of facets: coordinates (Z, d) and t (Z,) [m].

    Args:
        corners: of the facets, (Z, d, d) [m], one a row.
        x: points, (Z, d) [m].
        nu: directions, (Z, d).
    """
    xp = _numpy_of(corners)
    first = corners[:, 0]
    matrix = xp.concatenate([corners[:, 1:] - first[:, None], -nu[:, None]], axis=1)
    solution = xp.linalg.solve(xp.swapaxes(matrix, 1, 2), (x - first)[:, :, None])[:, :, 0]
    others = solution[:, :-1]
    places = xp.concatenate([1.0 - xp.sum(others, axis=1, keepdims=True), others], axis=1)
    return places, solution[:, -1]


def project(own: Values, corners: Values, nu: Values) -> Values:
    """Return the corners b of facets, moved along nu to facets `own`, in coordinates, (Z, b, a)."""
    xp, d = _numpy_of(corners), corners.shape[1]
    places = [meet(own, corners[:, b], nu)[0] for b in range(d)]
    return xp.stack(places, axis=1)


def overlap(corners: Values) -> tuple[Values, Values]:
    """Return a quadrature, exact for quadratics, of the overlap of facets with the unit simplex.

    Args:
        corners: of a facet that faces the simplex, in its coordinates, (Z, b, a).

    Returns:
        Weights (Z, q), with the sum 1/(d-1)! for a covered simplex, and coordinates (Z, q, a).
    """
    xp, d = _numpy_of(corners), corners.shape[1]
    if d == 1:
        return xp.ones_like(corners[:, :, 0]), corners
    if d == 2:
        ends = xp.clip(corners[:, :, 1], 0.0, 1.0)
        half = 0.5 * (ends[:, :1] - ends[:, 1:])
        middle = 0.5 * (ends[:, :1] + ends[:, 1:])
        sides = xp.asarray([[-1.0, 1.0]], corners.dtype)
        place = middle + half * sides / math.sqrt(3.0)
        return xp.abs(half * sides), xp.stack([1.0 - place, place], axis=2)
    # Facets that face each other turn the other way round.
    polygon = corners[:, ::-1, 1:]
    for inside in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, -1.0, -1.0]):
        polygon = _clip(polygon, inside[0] + polygon @ xp.asarray(inside[1:], polygon.dtype))
    first, second = polygon[:, 1:-1] - polygon[:, :1], polygon[:, 2:] - polygon[:, :1]
    areas = 0.5 * (first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])  # (z, fan)
    middles = 0.5 * xp.stack([first, second, first + second], axis=2)  # (z, fan, 3, 2)
    place = (polygon[:, :1, None] + middles).reshape(len(corners), -1, 2)
    weights = xp.repeat(areas / 3.0, 3, axis=1)
    return weights, xp.concatenate([1.0 - xp.sum(place, axis=2, keepdims=True), place], axis=2)


def _clip(polygon: Values, signs: Values) -> Values:
    """Return the part of convex polygons (Z, n, 2) where signs (Z, n), affine, are not negative.

    It has n+1 corners, the last one repeated where there are fewer, all one point if there are
    none. Source: Sutherland, Hodgman, Comm. ACM 17 (1974) 32-42.
    """
    xp, n = _numpy_of(polygon), polygon.shape[1]
    following, next_signs = xp.roll(polygon, -1, axis=1), xp.roll(signs, -1, axis=1)
    is_inside = signs >= 0.0
    crosses = is_inside != (next_signs >= 0.0)
    way = signs / xp.where(crosses, signs - next_signs, 1.0)
    crossing = polygon + way[:, :, None] * (following - polygon)
    candidates = xp.stack([polygon, crossing], axis=2).reshape(-1, 2 * n, 2)
    is_corner = xp.stack([is_inside, crosses], axis=2).reshape(-1, 2 * n)
    last = xp.maximum(xp.sum(is_corner, axis=1, keepdims=True) - 1, 0)
    order = xp.argsort(~is_corner, axis=1, stable=True)
    order = xp.take_along_axis(order, xp.minimum(np.arange(n + 1)[None, :], last), axis=1)
    return xp.take_along_axis(candidates, order[:, :, None], axis=1)


def _numpy_of(values: Values) -> ModuleType:
    return np if isinstance(values, np.ndarray) else jnp
