"""Small problems with known minimisers, shared by the tests of the optimisation."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jaxcontact as jc
from support.bodies import discretized

DURATION = 0.5
WEIGHT = 0.05


@cache
def graded_bar(n_cells):
    """A bar of length one whose cells shrink by a factor of about 20 towards its end."""
    x = np.linspace(0.0, 1.0, n_cells + 1)
    points = (x + 0.9 * np.sin(np.pi * x) / np.pi)[:, None]
    cells = np.column_stack([np.arange(n_cells), np.arange(1, n_cells + 1)])
    mesh = jc.Mesh.from_arrays(points, cells, facets={"left": np.array([[0]])})
    material = jc.KelvinVoigt(young=1.0, poisson=0.0, density=1.0)
    return discretized(jc.Scene(mesh=mesh, material=material, clamped=("left",)))


def _misfit(system, dt, modes, data, u):
    """J(u) = alpha/2 |u|^2 + 1/2 sum_j ((u, phi_j) - c_j)^2 in L2(0,T; L2)."""
    products = jnp.stack([jc.control_dot(system, dt, mode, u) for mode in modes])
    return 0.5 * WEIGHT * jc.control_dot(system, dt, u, u) + 0.5 * jnp.sum((products - data) ** 2)


@jax.jit
def _minimiser(system, dt, modes, data):
    gram = jnp.array([[jc.control_dot(system, dt, a, b) for a in modes] for b in modes])
    # In the span of the modes: alpha a + G a = c.
    coefficients = jnp.linalg.solve(WEIGHT * jnp.eye(4) + gram, data)
    return sum(a * mode for a, mode in zip(coefficients, modes, strict=True))


def quadratic(n_cells=12, steps=8):
    """Return objective, start, keyword arguments and minimiser of a quadratic problem."""
    system, dt = graded_bar(n_cells), DURATION / steps
    x, t = system.points[None, :, :], dt * (jnp.arange(steps)[:, None, None] + 0.5)
    modes = [
        (j + 1.0) * jnp.sin((j + 1) * jnp.pi * x) * jnp.cos(2 * j * jnp.pi * t / DURATION) + x
        for j in range(4)
    ]
    data = jnp.array([1.0, -0.5, 2.0, 0.25])
    minimiser = _minimiser(system, dt, modes, data)
    objective = Partial(_misfit, system, dt, modes, data)
    start = jnp.zeros_like(modes[0])
    return objective, start, {"system": system, "dt": dt}, minimiser


def l2_distance(first, second, system, dt):
    difference = first - second
    return float(jnp.sqrt(jc.control_dot(system, dt, difference, difference)))


def block(tree):
    return jax.block_until_ready(tree)
