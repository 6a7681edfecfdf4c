"""A St.Venant-Kirchhoff reference in NumPy: exact rotations, finite strain, P1 elements.

Each step is the energy-momentum scheme of Simo and Tarnow (1992): the force is that of the mean of
the stresses of both ends at the middle configuration, which conserves energy, momentum and angular
momentum. Newton's method with dense matrices; contact with one plane by an active set, in the
contact-stabilized form of Deuflhard, Krause and Ertel (2008). Nothing of the package is used.
"""

from typing import NamedTuple

import numpy as np


class Body(NamedTuple):
    """A body of N nodes and E cells."""

    gradients: np.ndarray
    """Gradients of the hat functions, (E, d+1, d)."""

    volumes: np.ndarray
    """Volumes of the cells, (E,)."""

    cells: np.ndarray
    """Nodes of the cells, (E, d+1)."""

    mass: np.ndarray
    """Consistent mass, (N, N)."""

    lame: tuple[float, float]
    """Constants of the material."""


class State(NamedTuple):
    """Positions and velocities, (N, d) each."""

    x: np.ndarray
    v: np.ndarray


def body(points, cells, young, poisson, density):
    """Return the body of a mesh, in plane strain in two dimensions."""
    d = points.shape[1]
    corners = points[cells]
    edges = corners[:, 1:] - corners[:, :1]
    inner = np.swapaxes(np.linalg.inv(edges), 1, 2)
    gradients = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    volumes = np.abs(np.linalg.det(edges)) / (2.0 if d == 2 else 6.0)
    local = density / ((d + 1) * (d + 2)) * (1.0 + np.eye(d + 1))
    mass = np.zeros((len(points), len(points)))
    rows, columns = cells[:, :, None], cells[:, None, :]
    np.add.at(mass, (rows, columns), volumes[:, None, None] * local)
    first = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    return Body(gradients, volumes, cells, mass, (first, young / (2 * (1 + poisson))))


def stress(body, F):
    """Return the second Piola-Kirchhoff stress of deformation gradients (E, d, d)."""
    first, second = body.lame
    identity = np.eye(F.shape[-1])
    strain = 0.5 * (np.swapaxes(F, 1, 2) @ F - identity)
    trace = np.trace(strain, axis1=1, axis2=2)[:, None, None]
    return first * trace * identity + 2.0 * second * strain, strain


def deformation(body, x):
    """Return the deformation gradients, (E, d, d)."""
    return np.einsum("eai,eaj->eij", x[body.cells], body.gradients)


def energy(body, state):
    """Return kinetic and elastic energy."""
    S, strain = stress(body, deformation(body, state.x))
    elastic = 0.5 * np.sum(body.volumes * np.sum(S * strain, axis=(1, 2)))
    return 0.5 * np.sum(state.v * (body.mass @ state.v)), elastic


def force(body, old, new):
    """Return the force (N, d) between two configurations and its derivative by the new one."""
    F0, F1 = deformation(body, old), deformation(body, new)
    middle, S = 0.5 * (F0 + F1), 0.5 * (stress(body, F0)[0] + stress(body, F1)[0])
    G, V, (first, second) = body.gradients, body.volumes, body.lame
    n, d = old.shape
    at_cells = np.einsum("e,eij,ejk,eak->eai", V, middle, S, G)
    f = np.zeros((n, d))
    np.add.at(f, body.cells, at_cells)
    mG, oG = np.einsum("eij,eaj->eai", middle, G), np.einsum("eij,eaj->eai", F1, G)
    geometric = np.einsum("eaj,ejk,ebk->eab", G, S, G)[:, :, None, :, None] * np.eye(d)[:, None, :]
    GG = np.einsum("eaj,ebj->eab", G, G)
    mF = np.einsum("eik,ejk->eij", middle, F1)
    material = first * mG[:, :, :, None, None] * oG[:, None, None, :, :]
    material = material + second * (
        GG[:, :, None, :, None] * mF[:, None, :, None, :]
        + np.swapaxes(mG, 1, 2)[:, None, :, :, None] * oG[:, :, None, None, :]
    )
    blocks = 0.5 * V[:, None, None, None, None] * (geometric + material)
    K = np.zeros((n, d, n, d))
    i, j = body.cells[:, :, None], body.cells[:, None, :]
    np.add.at(K, (i, slice(None), j), np.moveaxis(blocks, 2, 3))
    return f, K.reshape(n * d, n * d)


def closest(matrix, rhs, rows, gap):
    """Solve matrix w + N^T p = rhs, N w <= gap, p >= 0, complementary, by an active set."""
    active, scale = np.zeros(len(rows), bool), np.max(np.abs(gap), initial=0.0)
    for _ in range(50):
        N = rows[active]
        k = len(N)
        saddle = np.block([[matrix, N.T], [N, np.zeros((k, k))]])
        solution = np.linalg.solve(saddle, np.concatenate([rhs, gap[active]]))
        w, p = solution[: len(rhs)], np.zeros(len(rows))
        p[active] = solution[len(rhs) :]
        following = np.where(active, p > 0.0, rows @ w > gap + 1e-12 * scale)
        if np.array_equal(following, active):
            return w, p
        active = following
    raise RuntimeError("the active set does not settle")


def step(body, state, dt, rows=None, plane=0.0, tolerance=1e-11):
    """Make one step without load; rows (C, N d) point into the plane rows . x <= plane.

    Returns the state, the impulse of the contact (C,) and the number of Newton iterations.
    """
    x, v = state
    n, d = x.shape
    M = np.kron(body.mass, np.eye(d))
    rows = np.zeros((0, n * d)) if rows is None else rows
    gap = (plane - rows @ x.ravel()) / dt
    z = closest(M, M @ v.ravel(), rows, gap)[0]
    w, p = z, np.zeros(len(rows))
    size = max(np.max(np.abs(v)), 1e-300)
    for iteration in range(1, 30):
        f, K = force(body, x, x + dt * w.reshape(n, d))
        matrix = M + 0.5 * dt**2 * K
        rest = M @ (z - w) - 0.5 * dt * f.ravel()
        change, p = closest(matrix, rest, rows, gap - rows @ w)
        w = w + change
        if np.max(np.abs(change)) <= tolerance * size:
            after = State(x + dt * w.reshape(n, d), v + 2.0 * (w - z).reshape(n, d))
            return after, 2.0 * p, iteration
    raise RuntimeError("Newton's method does not converge")
