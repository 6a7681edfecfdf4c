"""An independent program for the same problem: dense NumPy, loops, the total form of the paper.

Nothing of jaxcontact is used. Matrices come from quadrature and strain tensors instead of closed
formulas; a step solves (4.19) for the *displacement*, with the dual problem of its variational
inequality handed to the non-negative least squares of SciPy; the adjoint is the recursion
(4.40)-(4.41) in the paper's p and q, each step one dense saddle-point system.
"""

from dataclasses import dataclass
from math import factorial, sqrt

import numpy as np
from scipy.optimize import nnls


@dataclass
class Body:
    mass: np.ndarray  # (n, n) with density
    stiffness: np.ndarray  # (n, n)
    viscosity: np.ndarray  # (n, n), zero if there is none
    nodal_mass: np.ndarray  # (N, N) scalar, density-free, all nodes
    normals: np.ndarray  # (C, n)
    gap: np.ndarray  # (C,)
    free: np.ndarray  # (N,) bool
    dimension: int

    def restrict(self, field):
        """(..., N, d) -> (..., n)"""
        return field[..., self.free, :].reshape(*field.shape[:-2], -1)

    def lift(self, x):
        """(..., n) -> (..., N, d)"""
        field = np.zeros((*x.shape[:-1], self.free.size, self.dimension))
        field[..., self.free, :] = x.reshape(*x.shape[:-1], -1, self.dimension)
        return field

    def control_load(self, control):
        """(..., N, d) force density -> (..., n)"""
        return self.restrict(np.einsum("ab,...bi->...ai", self.nodal_mass, control))


@dataclass
class Motion:
    y: np.ndarray  # (T+1, n)
    v: np.ndarray  # (T+1, n)
    impulse: np.ndarray  # (T, C)
    active: np.ndarray  # (T, C)


def quadrature(d):
    """A rule on the unit simplex that is exact for quadratics: (points in barycentrics, weights)"""
    if d == 1:
        a = 0.5 - 0.5 / sqrt(3.0)
        return np.array([[a, 1 - a], [1 - a, a]]), np.full(2, 0.5)
    a = {2: 1 / 6, 3: (5 - sqrt(5)) / 20}[d]
    points = np.full((d + 1, d + 1), a) + np.eye(d + 1) * (1 - (d + 1) * a)
    return points, np.full(d + 1, 1 / (d + 1))


def assemble(points, cells, clamped, contact, *, young, poisson, density=1.0, bulk=0.0, shear=0.0):
    """The matrices of a body of one material.

    Args:
        points: (N, d).
        cells: (E, d+1).
        clamped: nodes.
        contact: list of (node, unit normal towards the obstacle, gap).
        young, poisson, density, bulk, shear: the material; bulk and shear are viscosities.
    """
    n_nodes, d = points.shape
    mu = young / (2 * (1 + poisson))
    lame = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    nodal_mass = np.zeros((n_nodes, n_nodes))
    stiffness, viscosity = np.zeros((2, n_nodes * d, n_nodes * d))
    bary, weights = quadrature(d)
    for cell in cells:
        corners = points[cell]
        jacobian = np.vstack([np.ones(d + 1), corners.T])  # (1, x) = jacobian @ barycentrics
        volume = abs(np.linalg.det(jacobian)) / factorial(d)
        gradients = np.linalg.inv(jacobian)[:, 1:]
        for point, weight in zip(bary, weights, strict=True):
            nodal_mass[np.ix_(cell, cell)] += weight * volume * np.outer(point, point)
        strains = []
        for a in range(d + 1):
            for i in range(d):
                unit = np.zeros(d)
                unit[i] = 1.0
                strains.append((np.outer(gradients[a], unit) + np.outer(unit, gradients[a])) / 2)
        unknowns = (cell[:, None] * d + np.arange(d)).ravel()
        for first, second, matrix in (
            (lame, mu, stiffness),
            (bulk - 2 * shear / 3, shear, viscosity),
        ):
            block = [
                [volume * (first * np.trace(s) * np.trace(t) + 2 * second * np.sum(s * t))
                 for t in strains]
                for s in strains
            ]  # fmt: skip
            matrix[np.ix_(unknowns, unknowns)] += block
    free = np.ones(n_nodes, bool)
    free[list(clamped)] = False
    keep = np.repeat(free, d)
    normals = np.zeros((len(contact), n_nodes * d))
    for row, (node, normal, _) in enumerate(contact):
        normals[row, node * d : (node + 1) * d] = normal
    block = np.ix_(keep, keep)
    return Body(
        mass=density * np.kron(nodal_mass, np.eye(d))[block],
        stiffness=stiffness[block],
        viscosity=viscosity[block],
        nodal_mass=nodal_mass,
        normals=normals[:, keep],
        gap=np.array([gap for *_, gap in contact]),
        free=free,
        dimension=d,
    )


def solve_bound_constrained(matrix, rhs, normals, bound):
    """The minimiser of x.matrix.x/2 - rhs.x over normals x <= bound, with its multiplier.

    The dual min m.W m/2 + q.m over m >= 0 with W = R^T R is the least squares problem
    R m = -R^-T q.
    """
    free = np.linalg.solve(matrix, rhs)
    if not len(bound):
        return free, np.zeros(0)
    response = np.linalg.solve(matrix, normals.T)
    compliance = normals @ response
    root = np.linalg.cholesky((compliance + compliance.T) / 2).T
    multiplier, _ = nnls(root, -np.linalg.solve(root.T, bound - normals @ free), maxiter=1000)
    return free - response @ multiplier, multiplier


def simulate(body, dt, loads, y0=None, v0=None):
    """The motion under the loads (T, n) of the steps, in the total form (4.19) with (3.12).

    D y' + tau/2 N^T lam = M (y + tau v) - tau^2/4 A y + tau/2 B y + tau^2/2 f,
    v' = 2 (y' - y)/tau - v.
    """
    M, A, B = body.mass, body.stiffness, body.viscosity
    D = M + dt / 2 * B + dt**2 / 4 * A
    n = len(M)
    y, v = (np.zeros(n) if x is None else x for x in (y0, v0))
    ys, vs, impulses = [y], [v], []
    for f in loads:
        right = M @ (y + dt * v) - dt**2 / 4 * A @ y + dt / 2 * B @ y + dt**2 / 2 * f
        y_new, multiplier = solve_bound_constrained(D, right, body.normals, body.gap)
        y, v = y_new, 2 * (y_new - y) / dt - v
        ys.append(y)
        vs.append(v)
        impulses.append(2 / dt * multiplier)
    impulse = np.array(impulses).reshape(len(loads), len(body.gap))
    return Motion(np.array(ys), np.array(vs), impulse, impulse > 0)


def tracking_cost(body, dt, displacement, target, control, alpha, gamma):
    """The functional of section 5 for fields (T+1, N, d) and a control (T, N, d) before scaling"""

    def square(field):
        return sum(field[:, i] @ body.nodal_mass @ field[:, i] for i in range(field.shape[1]))

    errors = [square(y - z) for y, z in zip(displacement, target, strict=True)]
    steps = range(1, len(errors))
    tracking = dt / 2 * sum(0.5 * (errors[k - 1] + errors[k]) for k in steps)
    return tracking + alpha / 2 * dt * sum(map(square, control)) + gamma * errors[-1]


def adjoint(body, dt, cost_derivatives, active):
    """The adjoint states p_1, ..., p_T of (4.40)-(4.41), (T, n).

    Args:
        body: the matrices.
        dt: the time step.
        cost_derivatives: dJ/dy_0, ..., dJ/dy_T, (T+1, n).
        active: the active sets, (T, C); all of them count as strong contact (Algorithm 1).
    """
    M, A, B = body.mass, body.stiffness, body.viscosity
    D = M + dt / 2 * B + dt**2 / 4 * A
    n = len(M)

    def solve(right, rows):
        N = body.normals[rows]
        saddle = np.block([[D, N.T], [N, np.zeros((len(N), len(N)))]])
        return np.linalg.solve(saddle, np.concatenate([right, np.zeros(len(N))]))[:n]

    steps = len(active)
    p = np.zeros((steps + 1, n))
    p[steps] = solve(cost_derivatives[steps], active[steps - 1])
    q = -2 / dt * p[steps]
    for k in range(steps - 1, 0, -1):
        after = p[k + 1]
        right = M @ (after - dt * q) - dt**2 / 4 * A @ after + dt / 2 * B @ after
        p[k] = solve(right + cost_derivatives[k], active[k - 1])
        q = -q + 2 / dt * (after - p[k])
    return p[1:]


def tracking_gradient(body, dt, motion, active, target, control, scale, alpha, gamma):
    """The L2(0,T; L2) gradient G_k = alpha u_k + scale tau/2 p_k of the tracking cost, (T, N, d)"""
    errors = body.lift(motion.y) - target
    weights = np.full(len(errors), dt)
    weights[[0, -1]] = dt / 2
    weights[-1] += 2 * gamma
    derivatives = weights[:, None] * body.control_load(errors)
    return alpha * control + scale * dt / 2 * body.lift(adjoint(body, dt, derivatives, active))


def kkt_violation(system, dt, trajectory, control=None):
    """The largest relative violation of (1)-(3) of MATH.md 2 over the steps of a trajectory.

    Balance of momentum relative to its largest term, non-penetration relative to the lengths in
    the gap, sign and complementarity relative to the largest impulse (times those lengths).
    """
    M, A = system.mass.to_scipy(), system.stiffness.to_scipy()
    B = 0 * M if system.viscosity is None else system.viscosity.to_scipy()
    D = M + dt / 2 * B + dt**2 / 4 * A
    N, psi = system.normals.to_scipy(system.size), np.asarray(system.gap)
    y, v = (np.asarray(system.restrict(x)) for x in (trajectory.displacement, trajectory.velocity))
    impulse = np.asarray(trajectory.contact_impulse)
    w = (v[1:] + v[:-1]) / 2
    load = np.broadcast_to(np.asarray(system.load), w.shape)
    if control is not None:
        load = load + np.stack([np.asarray(system.control_load(u)) for u in control])
    terms = [w @ D, impulse @ N / 2, -v[:-1] @ M, dt / 2 * y[:-1] @ A, -dt / 2 * load]
    tiny = np.finfo(float).tiny
    size = np.max([np.linalg.norm(term, axis=1) for term in terms], axis=0) + tiny
    balance = np.max(np.linalg.norm(sum(terms), axis=1) / size)
    length = np.max(np.abs(y)) + np.max(np.abs(psi), initial=0.0) + tiny
    coupling = np.max(np.abs(y[1:] - y[:-1] - dt * w)) / length
    gap = psi - y[1:] @ N.T
    strength = np.max(impulse, initial=0.0) + tiny
    violations = [
        balance,
        coupling,
        np.max(-gap, initial=0.0) / length,
        np.max(-impulse, initial=0.0) / strength,
        np.max(np.abs(impulse * gap), initial=0.0) / (strength * length),
    ]
    return max(violations)
