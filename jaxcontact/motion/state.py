"""What a simulation may start from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.scene.scene import Scene, clamped_nodes
from jaxcontact.system.system import System


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """Displacement and velocity of the bodies at one time; None is zero."""

    displacement: Array | None = None
    """Nodal displacement, (N, d) [m]; zero on clamped nodes, if no schedule moves them."""

    velocity: Array | None = None
    """Nodal velocity, (N, d) [m/s]; zero on clamped nodes, if no schedule moves them."""

    @classmethod
    def of(
        cls,
        scene: Scene,
        *,
        displacement: Mapping[str, ArrayLike] | ArrayLike | None = None,
        velocity: Mapping[str, ArrayLike] | ArrayLike | None = None,
    ) -> State:
        """Return the state in which regions of a mesh move as a whole; clamped nodes rest.

        Args:
            scene: the scene.
            displacement: a vector (d,) [m] for each named region, one for all nodes, or nodal
                values (N, d). None, and a region that is not named, is zero.
            velocity: likewise, [m/s].

        Raises:
            ValueError: if a region is unknown, a shape does not fit, or two named regions share
                nodes.

        Derivative: by the vectors.

        Example:
            >>> thrown = jc.State.of(jc.scenes.bars(), velocity={"bar0": [1.0]})
            >>> thrown.velocity.shape
            (102, 1)
        """
        return cls(
            _nodal_field(scene, "displacement", displacement),
            _nodal_field(scene, "velocity", velocity),
        )

    @classmethod
    def at_rest(cls, system: System) -> State:
        """Return the state of zeros, its arrays (N, d) in the type of the system.

        For loops whose state needs its arrays, as a `jax.lax.scan` over `step` does.
        """
        zeros = jnp.asarray(np.zeros((system.n_nodes, system.dimension), system.dtype))
        return cls(zeros, zeros)

    def filled(self, rest: Array) -> State:
        """Return the state with an array of zeros (N, d) in the place of None."""
        values = (self.displacement, self.velocity)
        return State(*(rest if x is None else x for x in values))


def _nodal_field(
    scene: Scene, name: str, values: Mapping[str, ArrayLike] | ArrayLike | None
) -> Array:
    """Return the nodal values (N, d) of a state; see `State.of`."""
    mesh = scene.mesh
    shape, d = mesh.points.shape, mesh.dimension
    parts = values if isinstance(values, Mapping) else {} if values is None else {None: values}
    field, taken = jnp.zeros(shape), np.zeros(shape[0], bool)
    for region, value in parts.items():
        if region is not None and region not in mesh.regions:
            raise ValueError(f"region {region!r} is not in the mesh; it has {sorted(mesh.regions)}")
        where = name if region is None else f"{name}[{region!r}]"
        value = jnp.asarray(value, field.dtype)
        if value.shape != (d,) and not (region is None and value.shape == shape):
            raise ValueError(f"{where} must have shape ({d},), got {value.shape}")
        nodes = np.unique(mesh.cells if region is None else mesh.cells[mesh.regions[region]])
        if np.any(taken[nodes]):
            raise ValueError(
                f"{where} gives {np.count_nonzero(taken[nodes])} nodes a second value: regions of "
                "one body share nodes; name one region, or give nodal values (N, d)"
            )
        taken[nodes] = True
        field = field.at[nodes].set(value if value.ndim == 2 else value[None, :])
    return field.at[clamped_nodes(scene)].set(0.0)
