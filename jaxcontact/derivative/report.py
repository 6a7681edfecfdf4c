"""A certificate: how well motion and adjoint solve their equations, and where J has a kink.

The adjoint state p_k = dJ/df_k is the sensitivity by the load of a step, and xi_k = -dJ/dpsi_k that
by its gap. On strong contact (N p)_i = 0. On weak contact one branch of the derivative keeps the
pair open (then xi = 0 and (N p)_i is free), the other keeps it closed (then (N p)_i = 0 and xi is
free), and

    (N p)_i <= 0  (p in the critical cone)    and    xi_i >= 0  (mu = N^T xi in its polar)

say that J grows on both sides of the pair: a kink that a minimiser may sit on, (4.32)-(4.33). With
the opposite sign J falls on both sides. Source: MATH.md 3; paper, section 4.5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.contact import Inactive, Status, Strong
from jaxcontact.motion.checks import raise_if_failed
from jaxcontact.motion.simulate import StepShift, simulate, simulate_shifted
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import State, Trajectory
from jaxcontact.transforms.precision import in_full_precision

#: A duality gap beyond rounding, also in float32 over many steps.
MODES_DIFFER = 1e-3


@dataclass(frozen=True)
class DerivativeReport:
    """How far the derivative of a cost can be trusted; W weak contacts."""

    forward_residual: float
    """Largest KKT residual of the motion, relative to the violation of the free motion."""

    worst_status: Status
    """Worst status of a step."""

    adjoint_residual: float
    """Largest |N p| on strong contact relative to the largest |p|. Zero but for costs or
    schemes (`Trapezoidal`) in which a step depends on an impulse directly."""

    duality_gap: float
    """|<J', d> - J'(u; d)| relative, reverse against forward mode, d a random load."""

    weak: np.ndarray
    """Step (0 is the first) and mesh node of every weak contact, (W, 2)."""

    nearly_weak: np.ndarray
    """Step and mesh node of contacts that a relative change by `tolerance` makes weak, (V, 2)."""

    tolerance: float
    """What counts as nearly weak."""

    margin: float
    """Strict complementarity: smallest over steps and pairs of the larger of gap / largest gap
    and impulse / largest impulse; zero if and only if there is weak contact."""

    cone: np.ndarray
    """(N p)_i of the open branch on the weak contacts, (W,) [1/N times the cost]; zero in the
    predictor of `ContactStabilized`, which no load reaches."""

    polar: np.ndarray
    """xi_i of the closed branch beyond that of the open one on the weak contacts, (W,) [1/m times
    the cost]."""

    @property
    def is_differentiable(self) -> bool:
        """Whether the motion has a derivative, not only one-sided ones."""
        return len(self.weak) == 0

    @property
    def has_right_signs(self) -> bool:
        """Whether p is in the critical cone and mu in its polar on every weak contact."""
        return bool(np.all(self.cone <= 0.0) and np.all(self.polar >= 0.0))

    def __str__(self) -> str:
        """Return the certificate in words."""
        if not np.isfinite(self.adjoint_residual + self.duality_gap):
            return "NOT FINITE: the cost or its derivative is NaN; the motion itself is solved"
        lines = [
            f"motion:  KKT residual {self.forward_residual:.1e}, worst step "
            f"{self.worst_status.name.lower().replace('_', ' ')}",
            f"adjoint: |N p| on strong contact {self.adjoint_residual:.1e}, "
            f"duality gap {self.duality_gap:.1e}",
            f"contact: strict complementarity margin {self.margin:.1e}, {len(self.weak)} weak, "
            f"{len(self.nearly_weak)} nearly weak (below {self.tolerance:.0e})",
        ]
        for (step, node), cone, polar in zip(self.weak, self.cone, self.polar, strict=True):
            signs = f"(N p) = {cone:.3e}, xi = {polar:.3e}: {_kind(cone, polar)}"
            lines.append(f"  step {step}, node {node}: {signs}")
        if self.duality_gap > MODES_DIFFER:
            lines.append("WRONG: forward and reverse mode of the cost differ.")
        elif self.is_differentiable:
            lines.append("The gradient is the derivative.")
        elif self.has_right_signs:
            lines.append("One-sided derivatives only; every kink is a valley, as at a minimum.")
        else:
            lines.append("One-sided derivatives only, and some kink is not a valley.")
        return "\n".join(lines)


@in_full_precision
def derivative_report(
    stepper: Stepper,
    control: Array | None,
    cost: Callable[[Trajectory], Array],
    *,
    steps: int | None = None,
    initial: State | None = None,
    tolerance: float = 1e-6,
    seed: int = 0,
) -> DerivativeReport:
    """Return the certificate of the derivative of a cost.

    Args:
        stepper: from `prepare`.
        control: force density u, (T, N, d) [N/m^d], or None.
        cost: maps the trajectory to a scalar.
        steps: number of steps if there is no control.
        initial: state at time zero; default at rest without displacement.
        tolerance: relative gap and impulse below which a contact is nearly weak.
        seed: of the random load of the duality gap.

    Raises:
        SolveError: if a step of the motion was not solved.
    """
    trajectory = simulate(stepper, control, steps=steps, initial=initial)
    raise_if_failed(trajectory)
    system, n_steps = stepper.system, trajectory.status.shape[0]
    shift = StepShift(
        jnp.zeros((n_steps, system.size), system.dtype),
        jnp.zeros((n_steps, system.normals.count), system.dtype),
    )

    def shifted_cost(shift: StepShift, weak_contact) -> Array:
        return cost(simulate_shifted(stepper, control, initial, shift, weak_contact))

    closed = jax.grad(shifted_cost)(shift, Strong())
    opened = jax.grad(shifted_cost)(shift, Inactive())
    normal_product = jax.vmap(lambda p: system.normals @ p)
    strong, weak = np.asarray(trajectory.strong), np.asarray(trajectory.weak)
    in_cone = np.asarray(normal_product(opened.load))
    on_strong = np.abs(np.asarray(normal_product(closed.load))) * strong
    size = float(jnp.max(jnp.abs(closed.load)))
    margins = _margins(trajectory)
    nodes = np.asarray(system.contact_nodes)
    is_near = (margins < tolerance) & ~weak

    direction = jax.random.normal(jax.random.key(seed), shift.load.shape, system.dtype)
    tangent = StepShift(direction, jnp.zeros_like(shift.gap))
    _, forward = jax.jvp(lambda s: shifted_cost(s, Strong()), (shift,), (tangent,))
    reverse = jnp.vdot(closed.load, direction)
    scale = jnp.linalg.norm(closed.load) * jnp.linalg.norm(direction)
    return DerivativeReport(
        forward_residual=float(jnp.max(trajectory.residual)),
        worst_status=Status(int(jnp.max(trajectory.status))),
        adjoint_residual=float(np.max(on_strong, initial=0.0)) / (size or 1.0),
        duality_gap=float(jnp.abs(forward - reverse) / jnp.where(scale > 0.0, scale, 1.0)),
        weak=_places(weak, nodes),
        nearly_weak=_places(is_near, nodes),
        tolerance=tolerance,
        margin=float(np.min(np.where(weak, 0.0, margins), initial=np.inf)),
        cone=np.where(np.asarray(trajectory.active), in_cone, 0.0)[weak],
        polar=np.asarray(opened.gap - closed.gap)[weak],
    )


def _margins(trajectory: Trajectory) -> np.ndarray:
    """Return the larger of relative gap and relative impulse of every step and pair, (T, C)."""
    gap = np.abs(np.asarray(trajectory.gap[1:]))
    impulse = np.asarray(trajectory.contact_impulse)
    return np.maximum(
        gap / (np.max(gap, initial=0.0) or 1.0), impulse / (np.max(impulse, initial=0.0) or 1.0)
    )


def _kind(cone: float, polar: float) -> str:
    """Return what the graph of the cost looks like across a weak contact."""
    if cone <= 0.0 <= polar:
        return "valley"
    return "ridge" if polar <= 0.0 <= cone else "mixed signs"


def _places(mask: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return step and mesh node of the marked pairs, (W, 2)."""
    steps, pairs = np.nonzero(mask)
    return np.stack([steps, nodes[pairs]], axis=1)
