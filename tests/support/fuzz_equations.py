"""The equations of every scheme, with a motion put in: in NumPy and float64, a batch at a time.

B cases, T steps, C pairs, n unknowns. The equations are those in the docstrings of the schemes;
nothing of the package solves anything here.
"""

from dataclasses import dataclass

import numpy as np

import jaxcontact as jc


def times(matrix, x):
    """(B, n, m) times (B, T, m)"""
    return np.einsum("bnm,btm->btn", matrix, x)


def biggest(x):
    """Largest absolute value of a case, (B,)"""
    return np.max(np.abs(x), axis=tuple(range(1, x.ndim)), initial=0.0)


@dataclass
class Step:
    """One contact problem of all steps: the terms of its balance sum to zero"""

    matrix: np.ndarray  # D, (B, n, n)
    velocity: np.ndarray  # w, (B, T, n)
    terms: list  # of (B, T, n), the rest of D w + N^T p - r
    multiplier: np.ndarray  # p, (B, T, C)


def contact_problems(kind, out):
    """The contact problems of a scheme with its motion put in, and its kinematics, zero"""
    M, A, N, dt = (np.asarray(out[x], float) for x in ("mass", "stiffness", "normals", "dt"))
    B = np.asarray(out["viscosity"], float) * np.ones((len(dt), 1, 1)) if kind.is_viscous else 0 * A
    y, v, f = (np.asarray(out[x], float) for x in ("y", "v", "load"))
    p = np.asarray(out["trajectory"].contact.multiplier, float)
    t = dt[:, None, None]
    y0, y1, v0, v1 = y[:, :-1], y[:, 1:], v[:, :-1], v[:, 1:]
    w, middle = (y1 - y0) / t, 0.5 * (v0 + v1)
    push = [np.einsum("bcn,btc->btn", N, p[:, :, i]) for i in range(p.shape[2])]
    D = M + t / 2 * B + t**2 / 4 * A
    pull = [t / 2 * times(A, y0), -t / 2 * f]
    scheme = kind.scheme
    if isinstance(scheme, jc.ContactImplicit):
        return [Step(D, middle, [push[0], -times(M, v0), *pull], p[:, :, 0])], w - middle
    if isinstance(scheme, jc.Trapezoidal):
        before = np.concatenate([0 * push[0][:, :1], push[0][:, :-1]], axis=1)
        terms = [push[0], before, -times(M, v0), *pull]
        return [Step(D, middle, terms, p[:, :, 0])], w - middle
    if isinstance(scheme, jc.BackwardEuler):
        E = M + t * B + t**2 * A
        terms = [push[0], -times(M, v0), 2 * pull[0], 2 * pull[1]]
        return [Step(E, v1, terms, p[:, :, 0])], w - v1
    if isinstance(scheme, jc.ContactStabilized):
        u = w - 0.5 * (v1 - v0)
        end = Step(D, w, [push[0], -times(M, u), *pull], p[:, :, 0])
        return [end, Step(M, u, [push[1], -times(M, v0)], p[:, :, 1])], 0 * w
    # RedistributedMass: trapezoidal on the range of I - Q, static on that of Q.
    Q = np.einsum("bcn,bcm->bnm", N, N)
    R = np.eye(M.shape[1]) - Q
    D = M + t**2 / 4 * A + t / 4 * (B + R @ B @ R)
    inner = [
        times(M, v1 - v0), t / 2 * times(A, y0), t / 2 * times(A, y1), -t * f,
        t * times(B @ R, w), t * times(B @ Q, middle),
    ]  # fmt: skip
    outer = [times(A, y1), times(B, w), -f]
    terms = [times(R, x) / 2 for x in inner] + [t / 4 * times(Q, x) for x in outer]
    static = Step(D, 0 * w, [*terms, push[0]], p[:, :, 0])
    return [static], times(R, w - middle) + times(Q, w - v1)


def condition(matrix):
    """Condition of a Jacobi-scaled symmetric matrix, (B,); infinite if it is not definite"""
    scale = 1.0 / np.sqrt(np.abs(np.diagonal(matrix, axis1=1, axis2=2)) + 1e-300)
    scaled = matrix * scale[:, :, None] * scale[:, None, :]
    scaled = np.where(np.isfinite(scaled), scaled, 0.0)
    values = np.linalg.eigvalsh(scaled)
    return np.where(values[:, 0] > 0.0, values[:, -1] / np.maximum(values[:, 0], 1e-300), np.inf)
