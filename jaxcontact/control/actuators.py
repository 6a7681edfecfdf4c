"""Actuators: linear maps E from a few parameters to controls, u = E p.

Volume actuators act on a region of nodes, boundary actuators as a traction on a facet set; both
may have a fixed direction and be constant on intervals that span several time steps. Parameters
are (K, R, d), or (K, R) with a direction, for K intervals and R nodes.

The inner product of the parameters of a volume actuator is the one pulled back by E: the L2 norm
of the control itself. A traction g on the boundary is the control L^-1 (area g), whose L2 norm in
the body grows without limit as the mesh is refined; its parameters are measured in L2(0,T; L2) of
the boundary instead, with nodal quadrature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.control.inner_product import L2, InnerProduct, RegionL2, Weighted, lumped_mass
from jaxcontact.system import assembly
from jaxcontact.system.system import System


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Actuator:
    """A linear map from parameters to controls, see `actuator` and `boundary_actuator`."""

    nodes: np.ndarray
    """Nodes that it acts on, (R,) int32."""

    intervals: np.ndarray
    """Interval of each time step, (T,) int32."""

    durations: np.ndarray
    """Number of steps of each interval, (K,)."""

    direction: Array | None
    """Fixed direction, (d,); None is all components."""

    areas: Array | None
    """Boundary area of each node, (R,) [m^(d-1)]; None for a volume actuator."""

    system: System | None
    """The discretised scene of a boundary actuator, whose mass turns loads into controls."""

    n_nodes: int = field(metadata={"static": True})
    """Number of mesh nodes, N."""

    dimension: int = field(metadata={"static": True})
    """Space dimension d."""

    dtype: str = field(metadata={"static": True})
    """Floating point type of the parameters."""

    def zeros(self) -> Array:
        """Return the parameters of no control, (K, R, d) or with a direction (K, R)."""
        shape = (len(self.durations), len(self.nodes))
        shape = shape if self.direction is not None else (*shape, self.dimension)
        return jnp.zeros(shape, self.dtype)

    def __call__(self, parameters: Array) -> Array:
        """Return the control (T, N, d) of parameters (K, R, d) or with a direction (K, R)."""
        values = parameters
        if self.direction is not None:
            values = parameters[:, :, None] * self.direction[None, None, :]
        if self.areas is not None:
            values = self.areas[None, :, None] * values
        shape = (values.shape[0], self.n_nodes, self.dimension)
        fields = jnp.zeros(shape, values.dtype).at[:, self.nodes].set(values)
        if self.system is not None:
            fields = L2(self.system, 1.0).riesz(fields)
        return fields[self.intervals]

    def inner_product(
        self, system: System, dt: float | Array, *, is_lumped: bool = False
    ) -> InnerProduct:
        """Return the inner product of the parameters.

        Args:
            system: the discretised scene.
            dt: length of a time step, [s].
            is_lumped: whether the mass is lumped, as bounds need it.
        """
        durations = dt * jnp.asarray(self.durations, system.dtype)
        if self.direction is not None:
            durations = durations * jnp.sum(self.direction**2)
        if self.areas is None and not is_lumped:
            return RegionL2(system.nodal_mass, self.nodes, durations)
        nodal = lumped_mass(system)[self.nodes] if self.areas is None else self.areas
        weights = durations[:, None] * nodal[None, :]
        return Weighted(weights if self.direction is not None else weights[:, :, None])


def actuator(
    system: System,
    steps: int,
    *,
    nodes: ArrayLike | None = None,
    direction: ArrayLike | None = None,
    intervals: int | Sequence[int] | None = None,
) -> Actuator:
    """Return an actuator that applies a force per volume on a region.

    Args:
        system: the discretised scene.
        steps: number of time steps T.
        nodes: node numbers (R,) or a mask (N,); default all nodes.
        direction: fixed direction (d,); default all components. Its length scales the control.
        intervals: number of intervals on which the control is constant, as equal as possible, or
            the first step of each, starting with 0; default every step on its own.

    Raises:
        ValueError: if a node, the direction or the intervals do not fit.
    """
    return _make(system, steps, _check_nodes(system, nodes), direction, intervals)


def boundary_actuator(
    system: System,
    steps: int,
    facets: np.ndarray,
    *,
    direction: ArrayLike | None = None,
    intervals: int | Sequence[int] | None = None,
) -> Actuator:
    """Return an actuator that applies a traction, [N/m^(d-1)], on a facet set.

    Its control is the force per volume with the same nodal loads, so that a cost that penalises
    the control penalises a quantity that depends on the mesh; penalise the parameters instead.

    Args:
        system: the discretised scene.
        steps: number of time steps T.
        facets: nodes of each facet (F, d), for instance `mesh.facets["top"]`.
        direction: see `actuator`.
        intervals: see `actuator`.

    Raises:
        ValueError: if a node, the direction or the intervals do not fit.
    """
    nodes = _check_nodes(system, np.unique(facets))
    areas = assembly.nodal_areas(system.points, np.asarray(facets))[nodes]
    return replace(_make(system, steps, nodes, direction, intervals), areas=areas, system=system)


def _make(
    system: System,
    steps: int,
    nodes: np.ndarray,
    direction: ArrayLike | None,
    intervals: int | Sequence[int] | None,
) -> Actuator:
    """Return a volume actuator."""
    numbers = _interval_of_each_step(steps, intervals)
    return Actuator(
        nodes=nodes,
        intervals=numbers,
        durations=np.bincount(numbers),
        direction=_check_direction(system, direction),
        areas=None,
        system=None,
        n_nodes=system.n_nodes,
        dimension=system.dimension,
        dtype=str(system.dtype),
    )


def _check_nodes(system: System, nodes: ArrayLike | None) -> np.ndarray:
    nodes = np.arange(system.n_nodes) if nodes is None else np.asarray(nodes)
    if nodes.dtype == bool:
        if nodes.shape != (system.n_nodes,):
            raise ValueError(f"a mask of nodes must have shape ({system.n_nodes},)")
        nodes = np.flatnonzero(nodes)
    if nodes.ndim != 1 or nodes.size == 0:
        raise ValueError(f"an actuator needs at least one node, got an array {nodes.shape}")
    if nodes.min() < 0 or nodes.max() >= system.n_nodes or np.unique(nodes).size != nodes.size:
        raise ValueError(
            f"the nodes of an actuator must be different numbers from 0 to {system.n_nodes - 1}"
        )
    return nodes.astype(np.int32)


def _check_direction(system: System, direction: ArrayLike | None) -> Array | None:
    if direction is None:
        return None
    direction = np.asarray(direction, float)
    if direction.shape != (system.dimension,) or not np.linalg.norm(direction) > 0.0:
        raise ValueError(
            f"direction must be a vector of {system.dimension} components and not zero, got "
            f"{direction}"
        )
    return jnp.asarray(direction, system.dtype)


def _interval_of_each_step(steps: int, intervals: int | Sequence[int] | None) -> np.ndarray:
    intervals = steps if intervals is None else intervals
    if isinstance(intervals, int):
        if not 1 <= intervals <= steps:
            raise ValueError(f"{intervals} intervals do not fit {steps} steps")
        return (np.arange(steps) * intervals // steps).astype(np.int32)
    first = np.asarray(intervals)
    if first.size == 0 or first[0] != 0 or np.any(np.diff(first) <= 0) or first[-1] >= steps:
        raise ValueError(
            f"the first steps of the intervals must rise from 0 to less than {steps}, got {first}"
        )
    return (np.searchsorted(first, np.arange(steps), side="right") - 1).astype(np.int32)
