"""A certificate of strong stationarity, (4.32)-(4.33), also where the cost has a kink.

Where gap and impulse of a pair are both zero (weak contact) the cost has no derivative. Let the
strong pairs be closed and all others open, so that the motion is affine, and let an impulse
z_j >= 0 and the gap g_j >= 0 of each weak pair in W be variables of their own:

    L(u, z) = J(u, z) - sum_W nu_j g_j(u, z) - sum_W pi_j z_j.

The control is strongly stationary if dL/du = 0 and dL/dz = 0 with multipliers nu, pi >= 0: then no
direction in which W opens and none in which it closes lowers the cost to first order. nu_j is the
multiplier mu of the paper's adjoint (in its polar cone), pi_j its normal component (in its cone).
Without weak contact this is G = 0. The multipliers solve a small least-squares problem.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax import Array
from jax.tree_util import Partial

from jaxcontact.control.bounds import free_variables
from jaxcontact.control.problem import Problem
from jaxcontact.derivative.weak import ContactSizes, contact_sizes, margins
from jaxcontact.motion.checks import check_every_step, raise_if_failed
from jaxcontact.motion.stepper import Stepper, StepPerturbation, with_perturbation
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.optimize.weak_rows import WeakRows, weak_rows, wrong_signs
from jaxcontact.transforms.trees import nodes

#: Which pairs may count as weak, relative to gap and impulse of the motion: no fixed number is
#: right, since open pairs of one mesh have smaller gaps than weak ones of another control.
LADDER = 10.0 ** -np.arange(4.0, 10.0)

#: A certificate with fewer weak pairs is taken if its residual is less than this times the least.
AS_GOOD = 10.0

#: Which bounds hold depends on the multipliers of the weak gaps, and they on the bounds.
MAX_HELD = 10


@dataclass(frozen=True)
class Stationarity:
    """How far a control is from strong stationarity; m weak pairs."""

    residual: float
    """Norm of dL/du (with bounds of u - P(u - dL/du)), with the best multipliers; dL/dz enters
    it where no multipliers with the right signs solve dL/dz = 0."""

    gradient_norm: float
    """Norm of the gradient of Algorithm 1, which takes weak contact for strong."""

    weak_pairs: np.ndarray
    """Step k (0 is the first) and number of the pair of each weak contact, (m, 2) int."""

    contact_problem: np.ndarray
    """Contact problem of the step that each weak contact belongs to, (m,) int; 1 is the predictor
    of a scheme that has one."""

    gap_multiplier: np.ndarray
    """nu, (m,) [1/m]: what the cost would gain per length if the pair could penetrate."""

    impulse_multiplier: np.ndarray
    """pi, (m,) [1/(N s)]: what the cost would lose per impulse that pushes the pair apart;
    of the multiplier of the step's VI, which is lam / 2 in the contact-implicit scheme."""

    wrong_signs: int
    """Number of weak pairs with a negative multiplier."""

    weak_gap: float
    """Largest gap of the weak pairs over the largest gap of the motion."""

    weak_impulse: float
    """Largest impulse of the weak pairs over the largest impulse of the motion, or over the
    momentum of a node if that is larger."""

    strong_pairs: int = 0
    """Number of node-steps in strong contact."""

    open_pairs: int = 0
    """Number of node-steps without contact."""

    rank: int = 0
    """Number of linearly independent gaps of the weak pairs, at most m."""

    condition: float = 1.0
    """Condition of the independent ones, as functions of the control in units of their own."""

    @property
    def is_strong(self) -> bool:
        """Whether both multipliers of every weak pair have the right sign.

        If the residual is zero, the rows have full rank and the cost is a convex quadratic on
        every piece that meets here, such as `TrackingCost` with control_weight alpha, this proves
        more than stationarity: J(u + d) >= J(u) + alpha/2 |d|^2 for all d up to the next change
        of contact. The control is then a strict local minimiser.
        """
        return self.wrong_signs == 0

    def __str__(self) -> str:
        """Return the certificate in words."""
        rank = "" if self.rank == len(self.weak_pairs) else f" of rank {self.rank}"
        return (
            f"strong stationarity residual {self.residual:.2e} (gradient {self.gradient_norm:.2e});"
            f" {self.strong_pairs} strong, {self.open_pairs} open and {len(self.weak_pairs)} weak "
            f"pairs{rank}, {self.wrong_signs} with a wrong sign; they are weak to "
            f"{self.weak_gap:.1e} in gap and {self.weak_impulse:.1e} in impulse"
        )


def certify(
    problem: Problem,
    parameters: Array,
    motion: Callable[[Array], Trajectory],
    tolerance: float | None = None,
) -> Stationarity:
    """Certify a control on the exact problem; see `stationarity`.

    Raises:
        ValueError: if the motion does not record every step.
        SolveError: if a step of the motion was not solved.
    """
    trajectory = run(motion, problem.controls, parameters)
    raise_if_failed(trajectory)
    check_every_step(trajectory)
    steppers = nodes(motion, Stepper)
    if not steppers:
        raise ValueError(
            "the motion holds no stepper; hand over motion= as a bound method of a pytree that "
            "holds it, or jax.tree_util.Partial(function, stepper)"
        )
    sizes = contact_sizes(steppers[0], trajectory)
    margin = margins(trajectory, sizes)
    candidates = [margin <= x for x in (LADDER if tolerance is None else [tolerance])]
    certificates = [
        _certify(problem, parameters, motion, trajectory, sizes, is_weak)
        for k, is_weak in enumerate(candidates)
        if k == 0 or np.any(is_weak != candidates[k - 1])
    ]
    return _best(certificates)


def _best(certificates: list[Stationarity]) -> Stationarity:
    """Return the verdict on the likeliest weak pairs: right signs, small residual, fewest pairs."""
    right = [x for x in certificates if x.is_strong] or certificates
    least = min(x.residual for x in right)
    as_good = [x for x in right if x.residual <= AS_GOOD * least]
    return min(as_good, key=lambda x: len(x.weak_pairs))


def _certify(
    problem: Problem,
    parameters: Array,
    motion: Callable[[Array], Trajectory],
    trajectory: Trajectory,
    sizes: ContactSizes,
    is_weak: np.ndarray,
) -> Stationarity:
    """Return the certificate with these pairs (T, P, C) in weak contact."""
    contact = trajectory.contact
    gap, impulse = np.asarray(contact.gap), np.asarray(contact.multiplier)
    is_strong = np.asarray(contact.active) & ~is_weak
    probe = StepPerturbation(
        push=jnp.asarray(np.where(is_weak, impulse, 0.0)), closed=jnp.asarray(is_strong)
    )
    _, derivative, by_impulse = on_pattern(problem.objective, problem.controls, parameters, probe)
    by_impulse = np.asarray(by_impulse)[is_weak]
    rows = weak_rows(problem, motion, parameters, probe, is_weak)
    rows = _with_held(rows, parameters, derivative)
    multiplier, signs, excess, rest = _multipliers(rows, derivative, by_impulse)
    gradient = problem.riesz(rest)
    step = parameters - problem.project(parameters - gradient)
    return Stationarity(
        residual=math.hypot(math.sqrt(max(float(problem.dot(step, step)), 0.0)), excess),
        gradient_norm=float(problem.gradient_norm(problem.evaluate(parameters))),
        weak_pairs=np.argwhere(is_weak)[:, [0, 2]],
        contact_problem=np.argwhere(is_weak)[:, 1],
        gap_multiplier=multiplier,
        impulse_multiplier=by_impulse - rows.compliance.T @ multiplier,
        wrong_signs=signs,
        weak_gap=float(np.max(gap[is_weak], initial=0.0)) / sizes.gap,
        weak_impulse=float(np.max(impulse[is_weak], initial=0.0)) / sizes.impulse,
        strong_pairs=int(np.sum(is_strong)),
        open_pairs=int(np.sum(~is_strong & ~is_weak)),
        rank=rows.rank,
        condition=rows.condition,
    )


def _with_held(rows: WeakRows, parameters: Array, derivative: Array) -> WeakRows:
    """Return the rows with the parameters that no bound holds, by the sign of dL/du."""
    bounds, rest = rows.problem.bounds, derivative
    for _ in range(MAX_HELD if bounds is not None else 0):
        free = free_variables(bounds, parameters, rest)
        if rows.free is not None and bool(jnp.all(free == rows.free)):
            break
        rows = replace(rows, free=free)
        _, rest = rows.multipliers(derivative)
    return rows


def motion_of(problem: Problem) -> Callable[[Array], Trajectory] | None:
    """Return the motion behind an objective that is a bound method of a pytree, or None."""
    objective = problem.objective
    owner = objective.args[0] if isinstance(objective, Partial) and objective.args else None
    simulate = getattr(type(owner), "simulate", None)
    return None if simulate is None else Partial(simulate, owner)


def _multipliers(
    rows: WeakRows, derivative: Array, by_impulse: np.ndarray
) -> tuple[np.ndarray, int, float, Array]:
    """Return nu, the number of pairs with a wrong sign, what signs leave of dL/dz, and dL/du."""
    nu, rest = rows.multipliers(derivative)
    m = len(nu)
    pi = by_impulse - rows.compliance.T @ nu
    wrong = int(np.sum(np.any(wrong_signs(rows.in_units_of_the_gradient(nu, pi)), axis=0)))
    if wrong == 0:
        return nu, 0, 0.0, rest
    # nu, pi >= 0 with  root nu = root nu*  and  compliance^T nu + pi = by_impulse  as well as may
    # be, where root^T root = gram and nu* is what no signs ask for.
    values, vectors = np.linalg.eigh(rows.gram)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    scale = rows.sizes / np.diagonal(rows.compliance)
    matrix = np.block(
        [[root, np.zeros((m, m))], [scale[:, None] * rows.compliance.T, np.diag(scale)]]
    )
    right = np.concatenate([root @ nu, scale * by_impulse])
    solution = scipy.optimize.lsq_linear(matrix, right, bounds=(0.0, np.inf), method="bvls").x
    excess = scale * (rows.compliance.T @ solution[:m] + solution[m:] - by_impulse)
    signed = solution[:m]
    rest = derivative - jnp.tensordot(jnp.asarray(signed), rows.rows, axes=1)
    return signed, wrong, float(np.linalg.norm(excess)), rest


@jax.jit
def run(motion: Callable, controls: Callable, parameters: Array) -> Trajectory:
    """Return the motion of parameters."""
    return motion(controls(parameters))


@jax.jit
def on_pattern(objective, controls, parameters, probe):
    """Return an objective on a pattern of contact, and its derivatives by parameters and push."""

    def value(p, z):
        return with_perturbation(objective, probe._replace(push=z))(controls(p))

    found, (derivative, by_impulse) = jax.value_and_grad(value, argnums=(0, 1))(
        parameters, probe.push
    )
    return found, derivative, by_impulse
