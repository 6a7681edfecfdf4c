"""Bodies of about n unknowns that are thrown on a plane: the scenes of the speed benchmarks.

Unit size, density and Young's modulus, so that the pressure wave has a speed c of about one. The
time step is h / c (Courant number one). A body meets the plane in its third step; a weight presses
it down so that it comes back 40 steps after a bounce and contact is closed most of the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial

import jaxcontact as jc
from jaxcontact.contact import Status
from jaxcontact.linear.dissection.nested_dissection import NestedDissection

POISSON = 0.3
WAVE_SPEED = math.sqrt((1.0 - POISSON) / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON)))
THROW = 0.05


class Body(NamedTuple):
    """A body above a plane, with a time step and the state in which it is thrown."""

    scene: jc.Scene
    system: jc.System
    dt: float
    initial: jc.State

    @property
    def sizes(self) -> dict[str, int]:
        """Number of unknowns and of contact pairs, for the rows of a table."""
        return {"n": self.system.size, "contact_pairs": self.system.normals.count}

    def control(self, steps: int) -> jax.Array:
        """Return a smooth force density (T, N, d) of about the size of the weight."""
        shape = (steps, self.system.n_nodes, self.system.dimension)
        phase = jnp.linspace(0.0, 6.0, steps, dtype=self.system.dtype)[:, None, None]
        place = self.system.points[None]
        size = THROW / (40.0 * self.dt)
        return jnp.broadcast_to(size * jnp.sin(phase + 3.0 * place), shape)


def thrown(mesh: jc.Mesh, contact: str, h: float, dtype: Any) -> Body:
    """Put a mesh above a plane and throw it.

    Args:
        mesh: the body, of about unit size.
        contact: facet set that may touch.
        h: edge length that a wave crosses in one time step, [m].
        dtype: floating point type.
    """
    dt = h / WAVE_SPEED
    points = np.asarray(mesh.points)
    up = np.eye(mesh.dimension)[-1]
    lowest = points[:, -1].min()
    scene = jc.Scene(
        mesh,
        jc.KelvinVoigt(young=1.0, poisson=POISSON),
        contact={contact: jc.HalfSpace((lowest - 2.5 * THROW * dt) * up, up)},
        body_force=-THROW / (20.0 * dt) * up,
    )
    system = jc.discretize(scene, dtype=dtype)
    rest = jnp.zeros(points.shape, dtype)
    return Body(scene, system, dt, jc.State(rest, rest.at[:, -1].set(-THROW)))


def rectangle(n: int, dtype: Any = jnp.float64) -> Body:
    """Return a unit square of right triangles."""
    m = max(2, round(math.sqrt(n / 2)) - 1)
    mesh = jc.meshes.rectangle((1.0, 1.0), h=(1.0 + 1e-9) / m)
    return thrown(mesh, "bottom", 1.0 / m, dtype)


def half_disc(n: int, dtype: Any = jnp.float64) -> Body:
    """Return a free half disc of rings: an unstructured mesh with a growing contact."""
    m = max(2, round(math.sqrt(n / 3)))
    return thrown(jc.meshes.half_disc(1.0, h=(1.0 + 1e-9) / m), "contact", 1.0 / m, dtype)


def delaunay(n: int, dtype: Any = jnp.float64) -> Body:
    """Return a unit square with a Delaunay mesh of scattered points."""
    m = max(3, round(math.sqrt(n / 2)) - 1)
    inner = (np.stack(np.meshgrid(*2 * [np.arange(1, m)]), axis=-1).reshape(-1, 2)) / m
    inner = inner + np.random.default_rng(0).uniform(-0.3 / m, 0.3 / m, inner.shape)
    edge = np.arange(m + 1) / m
    sides = [np.stack([edge, 0 * edge + y], 1) for y in (0.0, 1.0)]
    sides += [np.stack([0 * edge[1:-1] + x, edge[1:-1]], 1) for x in (0.0, 1.0)]
    points = np.concatenate([*sides, inner])
    cells = scipy.spatial.Delaunay(points).simplices
    area = np.abs(np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]))
    cells = cells[area > 1e-6 / m**2]  # collinear points of a side
    bottom = np.stack([np.arange(m), np.arange(1, m + 1)], axis=1)
    return thrown(jc.Mesh.from_arrays(points, cells, {"bottom": bottom}), "bottom", 1.0 / m, dtype)


def box(n: int, dtype: Any = jnp.float64) -> Body:
    """Return a unit cube of tetrahedra."""
    m = max(2, round((n / 3) ** (1 / 3)) - 1)
    mesh = jc.meshes.box((1.0, 1.0, 1.0), h=(1.0 + 1e-9) / m)
    return thrown(mesh, "bottom", 1.0 / m, dtype)


SHAPES: dict[str, Callable[..., Body]] = {
    "rectangle": rectangle,
    "half_disc": half_disc,
    "delaunay": delaunay,
    "box": box,
}

SOLVERS: dict[str, Any] = {
    "auto": None,
    "dissection": NestedDissection(),
    "dense": jc.Dense(),
    "cg": jc.ConjugateGradient(),
}


def prepare(body: Body, solver: str = "dissection") -> jc.Stepper:
    """Factorise the matrix of a body with a solver of that name."""
    return jc.prepare(body.system, body.dt, linear_solver=SOLVERS[solver])


def check(trajectory: jc.Trajectory) -> dict[str, float]:
    """Assert that every step converged; return how much contact there was."""
    assert np.all(np.asarray(trajectory.status) == Status.CONVERGED), "a step did not converge"
    active = np.asarray(trajectory.active)
    return {
        "contact_steps": float(np.mean(np.any(active, axis=1))),
        "active_pairs": float(np.mean(active)),
        "contact_iterations": float(np.mean(trajectory.iterations)),
    }
