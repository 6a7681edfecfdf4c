"""A certificate of strong stationarity, (4.32)-(4.33), also where the cost has a kink.

Where gap and impulse of a pair are both zero (weak contact) the cost has no derivative. Take the
derivative with all weak pairs W open, and let an impulse z_j >= 0 and the gap g_j >= 0 of each
of them be variables of their own:

    L(u, z) = J(u, z) - sum_W nu_j g_j(u, z) - sum_W pi_j z_j.

The control is strongly stationary if dL/du = 0 and dL/dz = 0 with multipliers nu, pi >= 0: then no
direction in which W opens and none in which it closes lowers the cost to first order. nu_j is the
multiplier mu of the paper's adjoint (in its polar cone), pi_j its normal component (in its cone).
Without weak contact this is G = 0. The multipliers solve a small least-squares problem.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax import Array
from jax.tree_util import Partial

from jaxcontact.control.bounds import free_variables, mask
from jaxcontact.control.problem import Problem
from jaxcontact.derivative.weak import contact_sizes, margins
from jaxcontact.motion.checks import check_every_step, raise_if_failed
from jaxcontact.motion.stepper import Stepper, StepPerturbation, with_perturbation
from jaxcontact.motion.trajectory import Trajectory

#: Multipliers above minus this times the largest one count as not negative.
SIGN_TOLERANCE = 1e-6

#: Weak pairs that a certificate can hold: each costs a gradient and an array like the control.
MAX_PAIRS = 500


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

    @property
    def is_strong(self) -> bool:
        """Whether both multipliers of every weak pair have the right sign."""
        return self.wrong_signs == 0

    def __str__(self) -> str:
        """Return the certificate in words."""
        return (
            f"strong stationarity residual {self.residual:.2e} (gradient {self.gradient_norm:.2e});"
            f" {len(self.weak_pairs)} weak pairs, {self.wrong_signs} with a wrong sign; they are "
            f"weak to {self.weak_gap:.1e} in gap and {self.weak_impulse:.1e} in impulse"
        )


def certify(
    problem: Problem,
    parameters: Array,
    motion: Callable[[Array], Trajectory],
    tolerance: float = 1e-4,
) -> Stationarity:
    """Certify a control on the exact problem; see `stationarity`.

    Raises:
        ValueError: if the motion does not record every step or has too many weak pairs.
        SolveError: if a step of the motion was not solved.
    """
    trajectory = _run(motion, problem.controls, parameters)
    gap, impulse = (np.asarray(x) for x in (trajectory.contact.gap, trajectory.contact.multiplier))
    raise_if_failed(trajectory)
    check_every_step(trajectory)
    sizes = contact_sizes(_stepper_of(motion), trajectory)
    is_weak = margins(trajectory, sizes) <= tolerance
    places = np.argwhere(is_weak)
    if len(places) > MAX_PAIRS:
        raise ValueError(
            f"{len(places)} node-steps are in weak contact, more than {MAX_PAIRS}; does the body "
            "rest on the obstacle without a force? Start it at a distance, or lower the tolerance"
        )

    probe = (jnp.asarray(is_weak), jnp.zeros(gap.shape, impulse.dtype))
    derivative, by_impulse = _objective_sensitivity(
        problem.objective, problem.controls, parameters, *probe
    )
    by_impulse = np.asarray(by_impulse)[is_weak]
    # Row j: derivatives of the gap of weak pair j by the parameters and by all weak impulses.
    rows, gap_by_impulse = [], []
    for place in places:
        row, response = _gap_sensitivity(motion, problem.controls, parameters, *probe, place)
        rows.append(row)
        gap_by_impulse.append(np.asarray(response)[is_weak])
    compliance = np.array(gap_by_impulse).reshape(len(places), len(places))

    free = free_variables(problem.bounds, parameters, derivative)
    multiplier, signs, excess = _multipliers(
        problem, [mask(free, row) for row in rows], mask(free, derivative), compliance, by_impulse
    )
    for nu, row in zip(multiplier, rows, strict=True):
        derivative = derivative - nu * row
    gradient = problem.riesz(derivative)
    step = parameters - problem.project(parameters - gradient)
    return Stationarity(
        residual=math.hypot(math.sqrt(max(float(problem.dot(step, step)), 0.0)), excess),
        gradient_norm=float(problem.gradient_norm(problem.evaluate(parameters))),
        weak_pairs=places[:, [0, 2]],
        contact_problem=places[:, 1],
        gap_multiplier=multiplier,
        impulse_multiplier=by_impulse - compliance.T @ multiplier,
        wrong_signs=signs,
        weak_gap=float(np.max(gap[is_weak], initial=0.0)) / sizes.gap,
        weak_impulse=float(np.max(impulse[is_weak], initial=0.0)) / sizes.impulse,
    )


def motion_of(problem: Problem) -> Callable[[Array], Trajectory] | None:
    """Return the motion behind an objective that is a bound method of a pytree, or None."""
    objective = problem.objective
    owner = objective.args[0] if isinstance(objective, Partial) and objective.args else None
    simulate = getattr(type(owner), "simulate", None)
    return None if simulate is None else Partial(simulate, owner)


def _multipliers(
    problem: Problem,
    rows: list[Array],
    derivative: Array,
    compliance: np.ndarray,
    by_impulse: np.ndarray,
) -> tuple[np.ndarray, int, float]:
    """Return nu, the number of wrong signs, and the part of dL/dz that signs leave over."""
    m = len(rows)
    if m == 0:
        return np.zeros(0), 0, 0.0
    gradients = [problem.riesz(row) for row in rows]
    gram = np.array([[float(jnp.vdot(row, g)) for g in gradients] for row in rows])
    weights, vectors = np.linalg.eigh(gram)
    keep = weights > 1e-14 * weights[-1]
    root = np.sqrt(weights[keep])[:, None] * vectors[:, keep].T  # root.T root = gram

    def project(covector: Array) -> np.ndarray:
        moments = np.array([float(jnp.vdot(covector, g)) for g in gradients])
        return (vectors[:, keep].T @ moments) / np.sqrt(weights[keep])

    right = project(derivative)
    nu = np.linalg.lstsq(root, right, rcond=None)[0]
    # Once more for the remainder: products of the columns lose half of the digits.
    for coefficient, row in zip(nu, rows, strict=True):
        derivative = derivative - coefficient * row
    nu = nu + np.linalg.lstsq(root, project(derivative), rcond=None)[0]

    pi = by_impulse - compliance.T @ nu
    # Both multipliers of a pair in units of the gradient: comparable, whatever the mesh.
    unit = np.sqrt(np.diagonal(gram))
    sizes = np.stack([unit * nu, unit * pi / np.diagonal(compliance)])
    wrong = int(np.sum(np.any(sizes < -SIGN_TOLERANCE * np.max(np.abs(sizes)), axis=0)))
    if wrong == 0:
        return nu, 0, 0.0
    # nu, pi >= 0 with  root nu = right  and  compliance^T nu + pi = by_impulse  as well as may be.
    scale = unit / np.diagonal(compliance)
    matrix = np.block(
        [[root, np.zeros((root.shape[0], m))], [scale[:, None] * compliance.T, np.diag(scale)]]
    )
    solution = scipy.optimize.lsq_linear(
        matrix, np.concatenate([right, scale * by_impulse]), bounds=(0.0, np.inf), method="bvls"
    ).x
    excess = scale * (compliance.T @ solution[:m] + solution[m:] - by_impulse)
    return solution[:m], wrong, float(np.linalg.norm(excess))


def _stepper_of(motion: Callable[[Array], Trajectory]) -> Stepper:
    """Return the stepper in the pytree of a motion."""
    found = [x for x in jax.tree.leaves(motion, is_leaf=_is_stepper) if _is_stepper(x)]
    if not found:
        raise ValueError(
            "the motion holds no stepper; hand over motion= as a bound method of a pytree that "
            "holds it, or jax.tree_util.Partial(function, stepper)"
        )
    return found[0]


def _is_stepper(node: object) -> bool:
    return isinstance(node, Stepper)


@jax.jit
def _run(motion: Callable, controls: Callable, parameters: Array) -> Trajectory:
    return motion(controls(parameters))


@jax.jit
def _objective_sensitivity(objective, controls, parameters, is_open, push):
    def value(p, z):
        probe = StepPerturbation(push=z, is_open=is_open)
        return with_perturbation(objective, probe)(controls(p))

    return jax.grad(value, argnums=(0, 1))(parameters, push)


@jax.jit
def _gap_sensitivity(motion, controls, parameters, is_open, push, place):
    def gap(p, z):
        probe = StepPerturbation(push=z, is_open=is_open)
        return with_perturbation(motion, probe)(controls(p)).contact.gap[tuple(place)]

    return jax.grad(gap, argnums=(0, 1))(parameters, push)
