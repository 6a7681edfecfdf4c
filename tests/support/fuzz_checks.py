"""What must hold of every case of `fuzz`, in NumPy and float64, a batch at a time.

B cases, T steps, P contact problems of a step, C pairs, n unknowns.
"""

from collections import Counter
from dataclasses import dataclass, field

import jax
import numpy as np

import jaxcontact as jc
from support.fuzz import STEP
from support.fuzz_equations import biggest, condition, contact_problems, times

#: Residual of a solved contact problem, relative to the violation of the free motion.
CONTACT = {"float64": 1e-11, "float32": 1e-5}
#: Relative error of a conjugate gradient solve.
ITERATION = {"float64": 1e-10, "float32": 1e-4}
#: Rounding errors that a solve may leave: so many, and so many for each unit of its condition.
ROUNDINGS, BY_CONDITION = 1e3, 20.0
#: Relative error of a difference of costs, whose truncation is about STEP^2.
DIFFERENCE = 1e-5
#: A step may fail only where the scaled matrix has a larger condition: in float32 its rounding
#: errors take the place of those of float64 at 1e10, and conjugate gradients say what they reach.
CONDITION = {"float64": 1e10, "float32": 1e5}
ITERATED_CONDITION = {"float64": 1e6, "float32": 1e3}
#: Gauss-Seidel sweeps, 2000 in the fuzz, may be too few where that of the compliance is larger.
SWEPT_CONDITION = 1e2
#: Where positions are concrete, pairs that are one count once; traced ones count twice, and then
#: their smooth laws press twice as hard.
TWO_LAWS = "twins", "relaxed"


@dataclass
class Report:
    """What was found in a batch"""

    counts: Counter = field(default_factory=Counter)
    violations: list = field(default_factory=list)
    failures: list = field(default_factory=list)
    worst: dict = field(default_factory=dict)

    def require(self, batch, name, value, tolerance, is_due):
        """Note the cases where a value (B,) exceeds its tolerance (B,) or is not a number"""
        value = np.asarray(value)
        wrong = is_due & ~(value <= tolerance)
        ratio = value / np.where(tolerance > 0.0, tolerance, 1.0)
        self.counts[name] += int(np.sum(is_due))
        finite = ratio[is_due & np.isfinite(ratio)]
        self.worst[name] = max(self.worst.get(name, 0.0), float(np.max(finite, initial=0.0)))
        for k in np.flatnonzero(wrong):
            self.violations.append(
                {"check": name, "seed": batch.seeds[k], "value": float(value[k]),
                 "tolerance": float(tolerance[k])}
            )  # fmt: skip


def is_coarse(kind, out):
    """Whether the redistributed mass is indefinite, (B,): it is refused, and NaN where traced"""
    mass = np.asarray(out["mass"])
    is_nan = np.isnan(mass).any(axis=(1, 2))
    return is_nan & isinstance(kind.scheme, jc.RedistributedMass)


def _may_fail(kind, failed):
    is_cg = isinstance(kind.linear_solver, jc.ConjugateGradient)
    limit = (ITERATED_CONDITION if is_cg else CONDITION)[kind.precision]
    is_unswept = kind.contact_solver == "gauss_seidel" and failed["status"] == 2
    return failed["condition"] > limit or (is_unswept and failed["pairs"] > SWEPT_CONDITION)


def _compliance_condition(step, normals):
    """Condition of the scaled compliance of the contact pairs, (B,)"""
    shift = 1e-300 * np.eye(normals.shape[2])
    return condition(normals @ np.linalg.solve(step.matrix + shift, normals.transpose(0, 2, 1)))


def judge(batch, report):
    """Check the motions of a batch, and its gradients by differences"""
    kind = batch.kind
    bases = [_judge_motion(batch, out, report, k == 0) for k, out in enumerate(batch.outcomes)]
    if kind.precision == "float64":
        for sign, (is_solved, _) in zip((1.0, -1.0), bases[1:], strict=True):
            _judge_difference(batch, report, sign, bases[0][0] & is_solved, bases[0][1])


def _judge_motion(batch, out, report, is_base):
    """Return the cases that were solved (B,) and the condition of their matrices (B,)"""
    kind, eps = batch.kind, float(np.finfo(batch.kind.dtype).eps)
    with np.errstate(all="ignore"):
        steps, kinematics = contact_problems(kind, out)
        worst = np.max([condition(step.matrix) for step in steps], axis=0)
    trajectory = out["trajectory"]
    is_solved = np.all(trajectory.status <= jc.Status.FALLBACK, axis=1)
    N, psi, dt = (np.asarray(out[x], float) for x in ("normals", "gap", "dt"))
    y, v = np.asarray(out["y"], float), np.asarray(out["v"], float)
    start_gap = psi - np.einsum("bcn,bn->bc", N, out["start"])
    rounding = 200 * eps * (out["place"] + biggest(y) + biggest(psi))
    # A difference may start in an obstacle, which is NaN. The cases themselves do not.
    is_due = (np.min(start_gap, axis=1) >= 0.0) | is_base
    report.counts["coarse"] += int(np.sum(is_due & is_coarse(kind, out)))
    is_due &= ~is_coarse(kind, out)
    for k in np.flatnonzero(is_due & ~is_solved):
        failed = {
            "seed": batch.seeds[k],
            "condition": float(worst[k]),
            "status": int(trajectory.status[k][trajectory.status[k] > 1][0]),
            "pairs": float(_compliance_condition(steps[0], N)[k]),
            "base": is_base,
        }
        report.failures.append(failed)
        if not _may_fail(kind, failed):
            report.violations.append({"check": "status", **failed})
    report.counts["status"] += int(np.sum(is_due))
    tolerance = eps * (ROUNDINGS + BY_CONDITION * worst)
    if isinstance(kind.linear_solver, jc.ConjugateGradient):
        tolerance = tolerance + ITERATION[kind.precision]
    # Beyond that the arithmetic says nothing of the equations.
    is_solved &= is_due
    is_checked = is_solved & (tolerance < 1e-2)
    report.counts["unresolved"] += int(np.sum(is_solved & ~is_checked))
    with np.errstate(all="ignore"):
        _judge_steps(batch, out, report, steps, tolerance, rounding, is_checked)
        size = biggest(v) + biggest(y) / dt
        report.require(batch, "kinematics", biggest(kinematics), tolerance * size, is_checked)
        _judge_ledger(batch, out, report, tolerance, rounding, is_checked)
    allowed = rounding + _slack(kind, out, dt, tolerance)
    report.require(batch, "gap", -trajectory.gap.min(axis=(1, 2)), allowed, is_checked)
    return is_solved, worst


def _slack(kind, out, dt, tolerance):
    """The length by which a solved step may miss a gap, (B,)"""
    tolerance = np.minimum(tolerance, 1.0)
    w = biggest(np.diff(np.asarray(out["y"], float), axis=1)) + dt * biggest(out["v"])
    return (100 * CONTACT[kind.precision] + tolerance) * w


def _judge_steps(batch, out, report, steps, tolerance, rounding, is_checked):
    kind = batch.kind
    N, psi, dt = (np.asarray(out[x], float) for x in ("normals", "gap", "dt"))
    t = dt[:, None, None]
    y, v = np.abs(np.asarray(out["y"], float)), np.abs(np.asarray(out["v"], float))
    speeds = v[:, 1:] + v[:, :-1] + (y[:, 1:] + y[:, :-1]) / t
    y = np.asarray(out["y"], float)[:, :-1]
    bound = (psi[:, None] - times(N, y)) / dt[:, None, None]
    slack = (_slack(kind, out, dt, tolerance) + rounding) / dt
    for step, gap in zip(steps, np.moveaxis(out["trajectory"].contact.gap, 2, 0), strict=True):
        terms = [times(step.matrix, step.velocity), *step.terms]
        size = sum(np.abs(x) for x in terms) + times(np.abs(step.matrix), speeds)
        p, g = step.multiplier, np.asarray(gap, float) / dt[:, None, None]
        report.require(batch, "sign", -p.min(axis=(1, 2)), 1e-300 + 0 * dt, is_checked)
        if not isinstance(kind.scheme, jc.RedistributedMass):
            recorded = bound - times(N, step.velocity) - g
            report.require(batch, "record", biggest(recorded), slack, is_checked)
        response = np.linalg.solve(step.matrix + 1e-300 * np.eye(N.shape[2]), N.transpose(0, 2, 1))
        compliance = np.einsum("bcn,bnc->bc", N, response)[:, None]
        # A multiplier below the tolerance of its pair is given as zero.
        dropped = np.einsum("bcn,bc->bn", np.abs(N), slack[:, None] / compliance[:, 0])[:, None]
        # The velocity of a held pair is known to its rounding, and put right by as much.
        held = np.sum(np.abs(N), axis=1)[:, None] * slack[:, None, None]
        dropped = dropped + times(np.abs(step.matrix), held)
        limit = tolerance[:, None, None] * size.max(axis=2, keepdims=True) + dropped
        balance = np.abs(sum(terms)) / np.maximum(limit, 1e-300)
        report.require(batch, "balance", biggest(balance), 1.0 + 0.0 * dt, is_checked)
        if kind.contact_solver == "relaxed":
            kappa = out["kappa"][:, None, None]
            law = p * g / kappa - 1.0
            # What the rounding of g or of W p makes of the product.
            law = np.abs(law) / (1.0 + p * slack[:, None, None] / kappa * 10.0)
            report.require(batch, "law", biggest(law), 10 * tolerance + 1e-4, is_checked)
            continue
        natural = np.minimum(compliance * p, g)
        report.require(batch, "complementarity", biggest(natural), slack, is_checked)


def _judge_ledger(batch, out, report, tolerance, rounding, is_checked):
    kind = batch.kind
    ledger = out["ledger"]
    dt = np.asarray(out["dt"], float)
    y, v = np.abs(np.asarray(out["y"], float)), np.abs(np.asarray(out["v"], float))
    kinetic = np.sum(v * times(np.abs(out["mass"]), v), axis=2).max(axis=1)
    elastic = np.sum(y * times(np.abs(out["stiffness"]), y), axis=2).max(axis=1)
    work = np.sum(np.abs(out["load"]) * (y[:, 1:] + y[:, :-1]), axis=2).max(axis=1)
    impulse = np.abs(out["trajectory"].contact.multiplier).sum(axis=(2, 3)).max(axis=1)
    losses = (ledger.viscous_loss, ledger.impact_loss, ledger.numerical_loss)
    flows = sum(biggest(np.asarray(x, float)) for x in (ledger.work, *losses))
    missing = 10 * impulse * (rounding + _slack(kind, out, dt, tolerance)) / dt
    if kind.contact_solver == "relaxed":
        pairs = out["normals"].shape[1]
        missing = missing + 4 * out["kappa"] * pairs * 1.01
    size = tolerance * (kinetic + elastic + work + flows) + missing
    report.require(batch, "ledger", biggest(ledger.residual), size, is_checked)


def _judge_difference(batch, report, sign, is_solved, worst):
    """A difference of costs is the mean slope of its ends: to third order, on a smooth piece"""
    kind, here, there = batch.kind, batch.outcomes[0], batch.outcomes[1 if sign > 0 else 2]
    contact, moved = here["trajectory"].contact, there["trajectory"].contact
    # `ClosedBranch`: a weak contact counts as closed, so there it must be pressed.
    is_smooth = np.all(
        (contact.active == moved.strong) & (moved.active == moved.strong), axis=(1, 2, 3)
    )
    bend = 0.0
    if kind.contact_solver == "relaxed":
        # Smooth, but with the curvature of 1 / kappa.
        change = np.abs(there["slope"] - here["slope"])
        is_smooth = change < 1e-3 * (here["slope_size"] + there["slope_size"])
        # The error of a mean slope is a twelfth of this.
        bend = STEP * np.abs(sum(out["slope"] for out in batch.outcomes) - 3.0 * here["slope"])
    difference = there["cost"] - here["cost"]
    expected = 0.5 * sign * STEP * (here["slope"] + there["slope"])
    size = STEP * here["slope_size"]
    eps = np.finfo(float).eps
    noise = eps * (100 + BY_CONDITION * worst + 1e3 * here["place"] / here["length"])
    if isinstance(kind.linear_solver, jc.ConjugateGradient):
        noise = noise + 1e-11
    noise = noise * (10.0 + np.abs(here["cost"]))
    is_clear = noise < 0.01 * size
    report.counts["kinked"] += int(np.sum(is_solved & ~is_smooth))
    report.counts["unclear"] += int(np.sum(is_solved & is_smooth & ~is_clear))
    allowed = DIFFERENCE * size + bend + noise
    report.require(batch, "difference", np.abs(difference - expected), allowed,
                   is_solved & is_smooth & is_clear)  # fmt: skip


def judge_repeat(batch, k, repeat, name, report):
    """Compare the lane of a case with another run of it"""
    out = batch.outcomes[0]
    is_solved = np.all(out["trajectory"].status[k] <= jc.Status.FALLBACK)
    if is_coarse(batch.kind, _only(out, k))[0]:
        return
    if name == "plain" and (batch.kind.arrangement, batch.kind.contact_solver) == TWO_LAWS:
        report.counts["two laws"] += 1
        return
    try:
        trajectory = repeat(k)
    except (ValueError, jc.SolveError) as error:
        if is_solved:
            failed = {"check": f"{name} raises", "seed": batch.seeds[k], "error": str(error)}
            report.violations.append(failed)
        report.counts[f"{name} refused"] += 1
        return
    with np.errstate(all="ignore"):
        steps, _ = contact_problems(batch.kind, _only(out, k))
        worst = np.max([condition(step.matrix) for step in steps])
    eps = float(np.finfo(batch.kind.dtype).eps)
    tolerance = eps * (3e4 + 300 * worst)
    # Pairs that lean on each other share their force by a shift that is refined away; a relaxed
    # law is solved to its own rounding, which small kappa make large.
    if batch.kind.arrangement == "twins" or batch.kind.contact_solver == "relaxed":
        tolerance *= 100
    lane = out["trajectory"]
    if isinstance(batch.kind.linear_solver, jc.ConjugateGradient):
        # A batch iterates until its last lane is solved, in every step anew.
        tolerance += 10 * len(lane.status[k]) * ITERATION[batch.kind.precision]
    place = 10 * eps * out["place"][k]
    moved = tolerance * np.abs(lane.displacement[k]).max() + place
    speed = tolerance * np.abs(lane.velocity[k]).max() + place / out["dt"][k]
    if isinstance(batch.kind.scheme, jc.RedistributedMass):
        # A node without mass has the velocity of its displacements.
        speed += moved / out["dt"][k]
    allowed = {"displacement": moved, "velocity": speed}
    for part, limit in allowed.items():
        one, other = getattr(lane, part)[k], np.asarray(getattr(trajectory, part))
        due = np.array([is_solved and tolerance < 1e-2])
        report.require(
            _One(batch.seeds[k : k + 1]),
            f"{name} {part}",
            np.array([np.abs(one - other).max()]),
            np.array([limit]),
            due,
        )


@dataclass
class _One:
    seeds: tuple


def _only(out, k):
    return jax.tree.map(lambda x: x[k : k + 1] if np.ndim(x) else x, out)
