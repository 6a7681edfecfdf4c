"""From a scene to its matrices: the semi-discrete system of MATH.md 1.

    M y'' + B y' + A y + N^T p = f,    N y <= psi,  p >= 0,  p . (psi - N y) = 0

on the n unknowns: the displacement components of the nodes that are not clamped.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxcontact.system.basis import Basis
from jaxcontact.system.control_space import control_loads, solve_mass
from jaxcontact.system.frames import Frames
from jaxcontact.system.lift import Lift
from jaxcontact.system.pair_set import PairSet, pair_numbers
from jaxcontact.system.parts import Parts
from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.saved import save_dataclass
from jaxcontact.transforms.show import shown_by
from jaxcontact.transforms.traced import as_array, take_rows


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class System:
    """The matrices of a scene; n unknowns, N nodes, C contact pairs, dimension d."""

    mass: ComponentwiseMatrix | SymmetricMatrix
    """M, consistent mass matrix with density, (n, n) [kg]; the identity in a reduced model."""

    stiffness: SymmetricMatrix
    """A, elastic stiffness matrix, (n, n) [N/m]."""

    viscosity: SymmetricMatrix | None
    """B, viscosity matrix, (n, n) [N s/m]; None if the material has no viscosity."""

    l2_mass: ComponentwiseMatrix | SymmetricMatrix
    """L on the unknowns: mass matrix without density, (n, n) [m^d]."""

    nodal_mass: SymmetricMatrix
    """Scalar L on all nodes, (N, N) [m^d]; the inner product of controls (N, d), clamped too."""

    normals: ContactNormals
    """N, contact operator, (C, n); rows point from the body to the obstacle, or to the other body,
    whose displacement they subtract. With rollers N P: they leave out what is held."""

    gap: Array
    """Initial gap psi of the contact pairs, (C,) [m]; negative means penetration."""

    gap_rounding: Array
    """Rounding error of the gap, (C,) [m]: that of the positions it was measured between."""

    load: Array
    """Constant load of body force and traction, (n,) [N]."""

    contact_nodes: np.ndarray
    """Node of each contact pair, (C,) int32."""

    contact_area: Array
    """Integral of the hat function over the contact set, (C,) [m^(d-1)], between bodies over what
    lies before the other one; impulse / (dt area) is the contact pressure."""

    points: Array
    """Node positions in the reference configuration, (N, d) [m]."""

    free_nodes: np.ndarray
    """Nodes that are not clamped, (n/d,) int32."""

    node_numbers: np.ndarray
    """Position of each node among the free ones, (N,) int32; n/d for a clamped node."""

    directions: Array
    """Unit vector nu of each contact pair towards the obstacle or the other body, (C, d)."""

    parts: Parts
    """The facet sets, obstacles and clamped sets by name, for what changes in time."""

    dimension: int = field(metadata={"static": True})
    """Space dimension d."""

    rollers: ContactNormals | None = None
    """Orthonormal directions in which nodes are held by rollers, (H, n); None without rollers."""

    basis: Basis | None = None
    """Space of a reduced model (see `reduce`); None is all displacement components."""

    open_pairs: PairSet | None = None
    """Pairs that are taken to stay open (see `with_pairs`); None is none."""

    frames: Frames | None = None
    """The frames of the bodies that turn (see `Scene.large_rotation`); None is none."""

    def _facts(self) -> dict[str, object]:
        return {
            "dimension": self.dimension,
            "unknowns": self.size,
            "nodes": self.n_nodes,
            "clamped_nodes": self.n_nodes - len(self.free_nodes),
            "contact_pairs": self.normals.count,
            "is_reduced": self.basis is not None,
            "dtype": self.dtype.name,
        }

    __repr__, _repr_html_ = shown_by(_facts)

    @property
    def size(self) -> int:
        """Number of unknowns, n."""
        return self.load.shape[-1]

    @property
    def mark(self) -> str:
        """What the unknowns stand for: the fingerprint of the basis, empty for a full model."""
        return "" if self.basis is None else self.basis.mark

    @property
    def n_nodes(self) -> int:
        """Number of mesh nodes, N."""
        return self.points.shape[-2]

    @property
    def is_clamped(self) -> bool:
        """Whether some nodes are clamped."""
        return len(self.free_nodes) < self.n_nodes

    @property
    def dtype(self):
        """Floating point type of every array."""
        return self.load.dtype

    def with_gap(self, gap: ArrayLike) -> System:
        """Return the system with another initial gap of the contact pairs, (C,) [m].

        Raises:
            ValueError: if the gap has another shape.

        Derivative: the identity from the argument to the field `gap`.
        """
        gap = as_array(gap)
        if gap.shape != self.gap.shape:
            raise ValueError(
                f"gap has shape {gap.shape}; pass {self.gap.shape}, one for each of `contact_nodes`"
            )
        gap = jnp.asarray(gap, self.dtype)
        own = 4.0 * jnp.finfo(self.dtype).eps * jnp.abs(gap)
        rounding = jnp.maximum(self.gap_rounding, jax.lax.stop_gradient(own))
        return replace(self, gap=gap, gap_rounding=rounding)

    def save(self, path: str | Path) -> None:
        """Write the system to an .npz file, which `load_system` reads.

        If the writing fails or is killed, a file that was there before is still there.

        Raises:
            ValueError: if the system is traced, or bodies turn.
            OSError: if the file cannot be written.
        """
        if self.frames is not None:
            raise ValueError("a system with large_rotation=True holds obstacles; save its scene")
        save_dataclass(path, self)

    def with_pairs(self, pairs: ArrayLike) -> System:
        """Return the system with contact on some of its pairs only; the others stay open.

        A pair out of reach then costs no part of the contact problem. The motion is exact or
        refused: `simulate` looks at the gap of the others in every step, and where one of them
        would penetrate, that step has failed.

        Args:
            pairs: which pairs can touch: (C,) bool, for instance `system.gap < reach` or
                `jnp.any(trajectory.active, axis=0)`, or their numbers; concrete.

        Raises:
            ValueError: if the pairs are traced or are not among those of the system, or bodies
                turn.
        """
        if self.frames is not None:
            raise ValueError(
                "with large_rotation=True any pair may come within reach; keep all of them"
            )
        kept = pair_numbers(pairs, self.normals.count)
        rest = np.setdiff1d(np.arange(self.normals.count), kept)
        return replace(
            self,
            normals=self.normals.rows(kept),
            gap=take_rows(self.gap, kept),
            gap_rounding=take_rows(self.gap_rounding, kept),
            contact_nodes=take_rows(self.contact_nodes, kept),
            contact_area=take_rows(self.contact_area, kept),
            directions=take_rows(self.directions, kept),
            parts=self.parts.with_pairs(kept),
            basis=None if self.basis is None else self.basis.with_pairs(kept),
            open_pairs=PairSet.of(self, rest, self.open_pairs),
        )

    def lift(self, x: Array) -> Array:
        """Return the nodal field (..., N, d) of unknowns (..., n); zero on clamped nodes."""
        return self.lifting(x)

    @property
    def lifting(self) -> Lift:
        """What `lift` needs of the system, without its matrices."""
        vectors = None if self.basis is None else self.basis.vectors
        return Lift(self.node_numbers, vectors, self.dimension, self.is_clamped)

    @in_full_precision
    @jax.jit
    def restrict(self, y: Array) -> Array:
        """Return the unknowns (..., n) of a nodal field (..., N, d).

        Of a reduced model, the unknowns of the M-orthogonal projection.
        """
        free = self.free_components(y)
        return free if self.basis is None else self.basis.restrict(free)

    def free_components(self, y: Array) -> Array:
        """Return the components (..., n_full) of the free nodes of a nodal field (..., N, d)."""
        if self.is_clamped:
            y = jnp.take(y, self.free_nodes, axis=-2, mode="clip")
        return y.reshape(*y.shape[:-2], -1)

    @in_full_precision
    def control_load(self, control: Array) -> Array:
        """Return the load (n,) [N] of a force density (N, d) or (n,) [N/m^d]: L u of MATH.md 1."""
        if control.ndim == 1:
            return self.l2_mass @ control
        return self.nodal_load(self.nodal_mass @ control)

    @in_full_precision
    def nodal_load(self, forces: Array) -> Array:
        """Return the load (..., n) [N] of forces on the nodes (..., N, d) [N]."""
        load = self.free_components(forces)
        return load if self.basis is None else load @ self.basis.vectors

    def restrict_control(self, control: Array) -> Array:
        """Return the control (T, n) in unknowns that acts as a control (T, N, d) [N/m^d].

        It is c with L_n c = V^T L u, the L2 projection: its load is the same, and `lift` makes it
        nodal. An optimal control of a reduced model is of this kind: it is a multiple of the
        adjoint state, which lies in the space.
        """
        return solve_mass(self.l2_mass, control_loads(self, control))
