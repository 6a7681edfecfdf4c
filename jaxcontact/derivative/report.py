"""A certificate: how well motion and adjoint solve their equations, and where J has a kink.

The adjoint state p_k = dJ/df_k is the sensitivity by the load of a step, and xi_k = -dJ/dpsi_k that
by its gap. On strong contact (N p)_i = 0. On weak contact one branch of the derivative keeps the
pair open (then xi = 0 and (N p)_i is free), the other keeps it closed (then (N p)_i = 0 and xi is
free). Measured by the impulse of the step's contact problem instead of a load,

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

from jaxcontact.contact import ClosedBranch, SemismoothNewton, Status, WeakContact
from jaxcontact.derivative.phase import moved, phase_spread, phase_words
from jaxcontact.derivative.weak import contact_sizes, margins, sensitivity
from jaxcontact.motion.chatter import ADVICE, chatter
from jaxcontact.motion.checks import raise_if_failed
from jaxcontact.motion.simulate import simulate
from jaxcontact.motion.stepper import Stepper, StepPerturbation, with_contact, with_perturbation
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

    problem: np.ndarray
    """Contact problem of the step that it belongs to, (W,); 1 is the predictor of a scheme."""

    nearly_weak: np.ndarray
    """Step and mesh node of contacts that a relative change by `tolerance` makes weak, (V, 2)."""

    tolerance: float
    """What counts as nearly weak."""

    margin: float
    """Strict complementarity: smallest over steps, contact problems and pairs of the larger of gap
    and multiplier, each relative to its size in the motion; zero if and only if there is weak
    contact."""

    cone: np.ndarray
    """(N p)_i of the open branch on the weak contacts, (W,) [cost per N s]."""

    polar: np.ndarray
    """xi_i of the closed branch beyond that of the open one on the weak contacts, (W,) [cost per
    m]."""

    closing_speed: float
    """Speed at which a gap closes in the step before a touch, [m/s]; zero if nothing touches."""

    phase_spread: float
    """Standard deviation of the derivative over the phases of the touch relative to their mean;
    zero if nothing touches. See `phase_mean` and `SmoothedContact`."""

    distance: float
    """Distance of the motion from that with exact contact, relative, in the l2 norm over nodes and
    time; zero if contact is exact."""

    chatter: float
    """Largest change of a contact force that alternates from step to step, relative to the largest
    force; zero if none does. See `ChatterWarning`."""

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
        rows = zip(self.weak, self.problem, self.cone, self.polar, strict=True)
        for (step, node), problem, cone, polar in rows:
            signs = f"(N p) = {cone:.3e}, xi = {polar:.3e}: {_kind(cone, polar)}"
            where = " of the predictor" if problem else ""
            lines.append(f"  step {step}, node {node}{where}: {signs}")
        if self.distance:
            lines.append(f"smooth contact: {self.distance:.1e} from the motion of exact contact")
        if self.chatter:
            lines.append(ADVICE.format(size=self.chatter) + "; a gradient of forces follows it")
        if self.closing_speed:
            lines += phase_words(self.closing_speed, self.phase_spread)
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
    n_steps = trajectory.status.shape[0]

    def perturbed_cost(
        perturbation: StepPerturbation,
        weak_contact: WeakContact | None = None,
        distance: Array | float = 0.0,
    ) -> Array:
        perturbed = with_perturbation(moved(stepper, distance), perturbation)
        options = {"steps": n_steps, "initial": initial, "weak_contact": weak_contact}
        return cost(simulate(perturbed, control, **options))

    closed = sensitivity(perturbed_cost, stepper, n_steps)
    opened = sensitivity(perturbed_cost, stepper, n_steps, trajectory.contact.weak)
    normal_product = jax.vmap(lambda p: stepper.system.normals @ p)
    # A smooth law gives way by its softness: there N p does not vanish.
    is_rigid = np.asarray(trajectory.strong) & stepper.contact_solver.is_exact
    on_strong = np.abs(np.asarray(normal_product(closed.load))) * is_rigid
    size = float(jnp.max(jnp.abs(closed.load)))

    direction = jax.random.normal(jax.random.key(seed), closed.load.shape, closed.load.dtype)

    def along(load: Array) -> Array:
        return perturbed_cost(StepPerturbation(load), ClosedBranch())

    _, forward = jax.jvp(along, (jnp.zeros_like(direction),), (direction,))
    reverse = jnp.vdot(closed.load, direction)
    scale = jnp.linalg.norm(closed.load) * jnp.linalg.norm(direction)

    speed, spread = float(trajectory.closing_speed), 0.0
    if speed > 0.0:
        nothing = StepPerturbation(jnp.zeros_like(closed.load))
        by_load = jax.grad(perturbed_cost)
        spread = float(phase_spread(lambda x: by_load(nothing, None, x).load, speed))

    weak = np.asarray(trajectory.contact.weak)
    margin = np.where(weak, 0.0, margins(trajectory, contact_sizes(stepper, trajectory)))
    nodes = np.asarray(stepper.system.contact_nodes)
    return DerivativeReport(
        forward_residual=float(jnp.max(trajectory.residual)),
        worst_status=Status(int(jnp.max(trajectory.status))),
        adjoint_residual=float(np.max(on_strong, initial=0.0)) / (size or 1.0),
        duality_gap=float(jnp.abs(forward - reverse) / jnp.where(scale > 0.0, scale, 1.0)),
        weak=_places(weak, nodes),
        problem=np.nonzero(weak)[1],
        nearly_weak=_places((margin < tolerance) & ~weak, nodes),
        tolerance=tolerance,
        margin=float(np.min(margin, initial=np.inf)),
        cone=-np.asarray(opened.push)[weak],
        polar=np.asarray(opened.gap - closed.gap)[weak],
        closing_speed=speed,
        phase_spread=spread,
        distance=_distance_from_exact(stepper, trajectory, control, initial),
        chatter=chatter(trajectory),
    )


def _distance_from_exact(
    stepper: Stepper, trajectory: Trajectory, control: Array | None, initial: State | None
) -> float:
    """Return the distance of a motion from that with exact contact, relative."""
    if stepper.contact_solver.is_exact:
        return 0.0
    exact = with_contact(stepper, SemismoothNewton())
    steps = trajectory.status.shape[0]
    motion = simulate(exact, control, steps=steps, initial=initial).displacement
    size = jnp.linalg.norm(motion - motion[:1])
    return float(jnp.linalg.norm(trajectory.displacement - motion) / jnp.where(size, size, 1.0))


def _kind(cone: float, polar: float) -> str:
    """Return what the graph of the cost looks like across a weak contact."""
    if cone <= 0.0 <= polar:
        return "valley"
    return "ridge" if polar <= 0.0 <= cone else "mixed signs"


def _places(mask: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return step and mesh node of the marked (step, problem, pair), (W, 2)."""
    steps, _, pairs = np.nonzero(mask)
    return np.stack([steps, nodes[pairs]], axis=1)
