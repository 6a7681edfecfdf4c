"""What a control may be asked for: a motion, a contact force, a time in contact.

The tracking cost of the paper, (4.26) with the final-time observation of section 5, is

    J(y, u) = tau/2 sum_k 1/2 (|y_{k-1} - y_d,{k-1}|^2 + |y_k - y_d,k|^2)
              + alpha/2 tau sum_k |u_k|^2 + gamma |y_T - y_d,T|^2        (gamma without 1/2)

in the L2 norm of the body, without density; |y - y_d| may also be taken on a part of the boundary
or on chosen nodes. Energies are in `energy`. Costs add up: every term is a differentiable function
of the trajectory, and so is any other JAX function of it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxcontact.control.distance import NodalDistance, ReducedDistance, reduced_distance
from jaxcontact.motion.chatter import warn_of_chatter
from jaxcontact.motion.checks import check_control, check_every_step
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.system.assembly import nodal_areas
from jaxcontact.system.control_space import as_columns
from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision


@jax.tree_util.register_pytree_node_class
class TrackingCost:
    """Tracking-type cost functional, a function of trajectory and control; a pytree.

    For a reduced system it is computed in its unknowns, for a control (T, n) without any array of
    the size of the mesh.
    """

    def __init__(
        self,
        system: System,
        *,
        target: Array,
        dt: float | Array | None = None,
        control_weight: float | Array = 0.0,
        final_weight: float | Array = 0.0,
        facets: np.ndarray | None = None,
        nodes: np.ndarray | None = None,
    ):
        """Define the functional.

        Args:
            system: the discretised scene.
            target: desired displacement y_d, (T+1, N, d) [m], or unknowns (T+1, n).
            dt: length of a time step tau, [s]; default that of the trajectory.
            control_weight: Tychonoff parameter alpha.
            final_weight: weight gamma of the final-time observation.
            facets: nodes of each facet (F, d), such as `mesh.facets["top"]`: track the trace on
                this part of the boundary, in its L2 norm with nodal quadrature, not the body.
            nodes: node numbers (R,): track these nodes, in the Euclidean norm, not the body.

        Raises:
            ValueError: if the target has another shape, if facets or nodes are not in the mesh, or
                if both are given.
        """
        nodal = (system.n_nodes, system.dimension)
        if np.shape(target)[1:] == (system.size,):
            target = system.lift(jnp.asarray(target, system.dtype))
        if np.shape(target)[1:] != nodal:
            raise ValueError(
                f"target must have shape (T+1, N, d) = (T+1, {nodal[0]}, {nodal[1]}) or, in "
                f"unknowns, (T+1, n) = (T+1, {system.size}), got {np.shape(target)}"
            )
        weights = _node_weights(system, facets, nodes)
        self.mark = system.mark
        self.masses = (system.nodal_mass, system.l2_mass)
        self.distance = NodalDistance(system.nodal_mass, weights, target)
        self.reduced = None if system.basis is None else reduced_distance(system, self.distance)
        self.dt = dt
        self.control_weight = control_weight
        self.final_weight = final_weight

    @in_full_precision
    def __call__(self, trajectory: Trajectory, control: Array | None = None) -> Array:
        """Return the value of the functional, a scalar.

        Args:
            trajectory: states of T steps, of this system or of another model on its mesh.
            control: the control that is penalised, (T, N, d), or (T, n) in the unknowns of both
                models, before any scaling; None if there is none.

        Raises:
            ValueError: if the trajectory or the control does not have the T steps of the target,
                recorded one by one, a control in unknowns comes with a motion of another model, or
                dt is not that of the trajectory (under jit the value is NaN instead).
        """
        check_every_step(trajectory)
        levels, *nodal = np.shape(self.distance.target)
        is_of_model = trajectory.mark == self.mark
        # The unknowns know nothing of supports that a schedule moves.
        is_moved = trajectory.schedule is not None and bool(trajectory.schedule.motion)
        is_reduced = self.reduced is not None and is_of_model and not is_moved
        motion = trajectory.unknowns if is_reduced else trajectory.displacement
        if len(motion) != levels or not (is_reduced or motion.shape[1:] == (*nodal,)):
            raise ValueError(
                f"the trajectory has displacements {np.shape(trajectory.displacement)}, the target "
                f"{(levels, *nodal)}; both must hold the same T+1 time levels"
            )
        if control is not None:
            check_control(control, (*nodal,), self.masses[1].size, levels - 1)
            if np.ndim(control) == 2 and not is_of_model:
                raise ValueError(
                    "the motion is one of another model than the cost, and a control (T, n) is in "
                    "the unknowns of one of them; make the cost of the system that is simulated"
                )
        return _tracking_cost(
            self.reduced if is_reduced else self.distance,
            _step_length(trajectory, self.dt),
            self.control_weight,
            self.final_weight,
            motion,
            None if control is None else self.masses[np.ndim(control) == 2],
            control,
        )

    def tree_flatten(self) -> tuple[list, tuple[str, tuple[str, ...]]]:
        """Return the arrays, and the mark with the names of the arrays."""
        arrays = {name: value for name, value in vars(self).items() if name != "mark"}
        return list(arrays.values()), (self.mark, tuple(arrays))

    @classmethod
    def tree_unflatten(cls, static: tuple[str, tuple[str, ...]], values) -> TrackingCost:
        """Return the functional of its arrays."""
        cost, (mark, names) = object.__new__(cls), static
        vars(cost).update(zip(names, values, strict=True), mark=mark)
        return cost


# Under jit with the arrays as arguments: nothing large is baked into a compiled program.
@jax.jit
def _tracking_cost(
    distance: NodalDistance | ReducedDistance,
    dt: Array,
    control_weight: Array,
    final_weight: Array,
    motion: Array,
    mass: SymmetricMatrix | ComponentwiseMatrix | None,
    control: Array | None,
) -> Array:
    errors = distance.squares(motion)
    cost = 0.25 * dt * jnp.sum(errors[:-1] + errors[1:]) + final_weight * errors[-1]
    if mass is not None and control is not None:
        columns = as_columns(control)
        cost = cost + 0.5 * control_weight * dt * jnp.sum(columns * (mass @ columns))
    return cost


def _node_weights(
    system: System, facets: np.ndarray | None, nodes: np.ndarray | None
) -> Array | None:
    """Return the weight of each node, (N,); None is the L2 norm of the body."""
    if facets is None and nodes is None:
        return None
    if facets is not None and nodes is not None:
        raise ValueError("track either facets or nodes; add two costs to track both")
    chosen = nodes if facets is None else facets
    if not isinstance(chosen, Tracer):
        chosen = np.asarray(chosen)
        if chosen.size == 0 or chosen.min() < 0 or chosen.max() >= system.n_nodes:
            raise ValueError(f"facets and nodes must be numbers from 0 to {system.n_nodes - 1}")
    if facets is not None:
        return nodal_areas(system.points, chosen)
    return jnp.zeros(system.n_nodes, system.dtype).at[chosen].set(1.0)


def _step_length(trajectory: Trajectory, dt: float | Array | None) -> Array:
    """Return the dt of the trajectory; NaN if another one was handed over.

    Raises:
        ValueError: if both are concrete and differ.
    """
    own = trajectory.dt
    if dt is None:
        return own
    is_wrong = jnp.abs(dt - own) > 1e-6 * own
    if isinstance(is_wrong, Tracer):
        return own * jnp.where(is_wrong, jnp.nan, 1.0)
    if is_wrong:
        raise ValueError(
            f"dt={float(dt):g} is not the step length of the trajectory, {float(own):g}; leave dt "
            "out, the trajectory knows its own"
        )
    return own


def contact_force(trajectory: Trajectory, *, dt: float | Array | None = None) -> Array:
    """Return the sum of all normal contact forces, the mean of each step, (T,) [N].

    Where the forces are concrete and alternate from step to step, a `ChatterWarning` says so.

    Args:
        trajectory: T steps.
        dt: not needed; checked against the step length of the trajectory.

    Raises:
        ValueError: if dt is another one.
    """
    warn_of_chatter(trajectory)
    return jnp.sum(trajectory.contact_impulse, axis=1) / _step_length(trajectory, dt)


def contact_force_error(
    trajectory: Trajectory, target: float | Array, *, dt: float | Array | None = None
) -> Array:
    """Return 1/2 the integral over time of the square of (contact force - target), [N^2 s].

    Args:
        trajectory: T steps.
        target: desired sum of the normal contact forces, (T,) or a number for all times [N].
        dt: see `contact_force`.

    Returns:
        A scalar. Its derivative by a control is zero as long as nothing touches; start from a
        control with contact, or in `RelaxedContact`.

    Raises:
        ValueError: if the target is neither a number nor of shape (T,).
    """
    force = contact_force(trajectory, dt=dt)
    if np.shape(target) not in ((), force.shape):
        raise ValueError(
            f"the target force must be a number or have shape {force.shape}, got {np.shape(target)}"
        )
    return 0.5 * trajectory.dt * jnp.sum((force - target) ** 2)


def contact_time(
    trajectory: Trajectory, *, force_scale: float | Array, dt: float | Array | None = None
) -> Array:
    """Return the time in contact, tau sum_k F_k / (F_k + F_0), a scalar [s].

    A step counts in full where the contact force F_k is large against F_0, and not without
    contact. The number of steps in contact itself is an integer, and its derivative zero.

    Args:
        trajectory: T steps.
        force_scale: F_0 > 0, a small fraction of the force in contact [N].
        dt: see `contact_force`.
    """
    force = contact_force(trajectory, dt=dt)
    return trajectory.dt * jnp.sum(force / (force + force_scale))
