"""How far a motion is from a target: on the nodes of the mesh, or in unknowns of a reduced model.

With L_n = V^T L V = R^T R and q_d = L_n^-1 V^T L y_d, the distance of y = V q is exactly

    |V q - y_d|^2 = |R q - R q_d|^2 + c,    c = |y_d - V q_d|^2;

on R chosen nodes with weights w it is that of the rows of V there. Source: MATH.md 10.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jax import Array

from jaxcontact.control.inner_product import nodal_norms
from jaxcontact.system.control_space import control_loads
from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.traced import is_traced


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NodalDistance:
    """Distance on the nodes of the mesh."""

    nodal_mass: SymmetricMatrix
    """Scalar L, (N, N) [m^d]."""

    weights: Array | None
    """Weight of each node, (N,); None is the L2 norm of the body."""

    target: Array
    """y_d, (T+1, N, d) [m]."""

    def squares(self, displacement: Array) -> Array:
        """Return the squared distances (T+1,) of displacements (T+1, N, d)."""
        if self.weights is None:
            return nodal_norms(self.nodal_mass, displacement - self.target)
        return jnp.einsum("n,tni->t", self.weights, (displacement - self.target) ** 2)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ReducedDistance:
    """Distance in the unknowns of a reduced model."""

    root: Array
    """R, (m, n); a number stands for that multiple of the identity."""

    target: Array
    """R q_d, (T+1, m)."""

    rest: Array
    """c, the part of the target outside of the space, (T+1,)."""

    def squares(self, unknowns: Array) -> Array:
        """Return the squared distances (T+1,) of unknowns (T+1, n)."""
        rooted = unknowns @ self.root.T if self.root.ndim else self.root * unknowns
        return jnp.sum((rooted - self.target) ** 2, axis=1) + self.rest


@in_full_precision
def reduced_distance(system: System, distance: NodalDistance) -> ReducedDistance:
    """Return the distance in the unknowns of a reduced system."""
    target = jnp.asarray(distance.target, system.dtype)
    if distance.weights is None:
        loads = control_loads(system, target)
        if isinstance(system.l2_mass, ComponentwiseMatrix):
            root = jnp.sqrt(system.l2_mass.scalar.values[0, 0])
            rooted = loads / root
            nearest = rooted / root
        else:
            root = jnp.linalg.cholesky(system.l2_mass.values).T
            solve = jax.scipy.linalg.solve_triangular
            rooted = solve(root.T, loads.T, lower=True).T
            nearest = solve(root, rooted.T).T
        rest = nodal_norms(distance.nodal_mass, system.lift(nearest) - target)
        return ReducedDistance(root, rooted, rest)
    weights = distance.weights
    chosen = slice(None) if is_traced(weights) else np.flatnonzero(np.asarray(weights))
    scale = jnp.sqrt(weights[chosen])[None, :, None]
    rows = scale * system.lift(jnp.eye(system.size, dtype=system.dtype))[:, chosen]
    target = scale * target[:, chosen]
    root = rows.reshape(system.size, -1).T
    return ReducedDistance(root, target.reshape(len(target), -1), jnp.zeros(len(target)))
