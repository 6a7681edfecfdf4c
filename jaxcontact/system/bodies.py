"""The bodies of a mesh: its connected parts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import Array
from scipy.sparse.csgraph import connected_components

from jaxcontact.system.system import System

#: Sums of squared cosines between an axis and the directions of rollers, above which they hold it.
HELD = 1e-6


def body_numbers(system: System) -> np.ndarray:
    """Return the number of the body to which each node belongs, (N,)."""
    columns = np.asarray(system.nodal_mass.columns)
    rows = np.broadcast_to(np.arange(system.n_nodes), columns.shape)
    edges = (np.ones(columns.size, np.int8), (rows.ravel(), columns.ravel()))
    graph = scipy.sparse.coo_array(edges, shape=(system.n_nodes, system.n_nodes))
    return connected_components(graph, directed=False)[1]


def free_flight_acceleration(system: System) -> Array:
    """Return the acceleration (n,) [m/s^2] of each body under the constant load.

    It is that of the centre of mass, the load over the mass, as far as rollers do not hold it; zero
    for a body with clamped nodes.
    """
    numbers = body_numbers(system)
    is_free = np.zeros(system.n_nodes, bool)
    is_free[np.asarray(system.free_nodes)] = True
    acceleration = jnp.zeros_like(system.load)
    for number in np.unique(numbers):
        is_body = numbers == number
        if not np.all(is_free[is_body]):
            continue
        fields = is_body[None, :, None] * np.eye(system.dimension)[:, None, :]
        translations = system.restrict(jnp.asarray(fields, system.dtype))
        mass = jnp.dot(translations[0], system.mass @ translations[0])
        common = translations @ system.load / mass
        if system.rollers is not None:
            held = jax.vmap(lambda x: system.rollers @ x)(translations)
            stiffness, axes = jnp.linalg.eigh(held @ held.T)
            common = axes @ jnp.where(stiffness > HELD, 0.0, axes.T @ common)
        acceleration += common @ translations
    return acceleration
