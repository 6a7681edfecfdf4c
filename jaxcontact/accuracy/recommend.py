"""Which mesh, time step, scheme and model a quantity needs for a tolerance.

From half the coarsest mesh size on, mesh size or step is halved, whichever has the larger error for
its price, e / log(cost ratio), until the sum of the errors is within the tolerance; a part below a
fifth of it is left alone. A mesh whose difference to the one before is more than four tolerances is
no answer: nothing here converges faster than with h^2, so that a much smaller difference to the
next mesh is chance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcontact.accuracy.estimate import ErrorEstimate, parts_of_error
from jaxcontact.accuracy.limits import limits
from jaxcontact.accuracy.probe import Build, Choice, Probes, Quantity, number_of
from jaxcontact.output.axes import add_grid, make_axes
from jaxcontact.schemes import ContactImplicit, ContactStabilized, Scheme
from jaxcontact.system.system import System
from jaxcontact.transforms.options import check_option

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Ratio of the errors of two meshes in second order.
SECOND_ORDER = 4.0
#: Part of the tolerance below which an error is not made smaller.
NEGLIGIBLE = 0.2
#: Time of a step grows with the number of unknowns to this power.
GROWTH = 1.2
#: Vibrations that a reduced model is tried with, and those that large meshes are probed with.
TRIED_MODES, PROBED_MODES = (20, 40, 80), 150
#: Unknowns above which a mesh is probed by a reduced model.
LARGE = 5000
#: Most seconds of all probes if no budget is given.
BUDGET = 300.0


class Evidence(NamedTuple):
    """One configuration that was tried."""

    choice: Choice
    """Mesh size, time step, scheme, type and modes."""

    unknowns: int
    """Number of unknowns."""

    error: ErrorEstimate
    """Estimated errors of the quantity."""

    is_enough: bool
    """Whether they are within the tolerance."""


@dataclass(frozen=True)
class Recommendation:
    """The cheapest configuration that was found within the tolerance, or the best of all."""

    h: float
    """Mesh size, [m]."""

    dt: float
    """Time step, [s]."""

    modes: int | None
    """Vibrations of a reduced model; None is the full one."""

    scheme: Scheme
    """Time-stepping scheme."""

    dtype: Any
    """Floating point type."""

    error: float
    """Estimated absolute error of the quantity."""

    is_reached: bool
    """Whether that is within the tolerance."""

    seconds: float
    """Measured time of one run once it is compiled, [s]."""

    evidence: tuple[Evidence, ...]
    """What was tried."""

    warnings: tuple[str, ...]
    """What the motion did that the model does not hold for; empty also if the quantity does not
    return its trajectory."""

    def __str__(self) -> str:
        """Return the advice and the evidence as a table."""
        verdict = "within the tolerance" if self.is_reached else "tolerance not reached"
        lines = [
            f"h={self.h:.3g} m, dt={self.dt:.3g} s, modes={self.modes}, {self.scheme}, "
            f"{self.dtype}: error about {self.error:.2g}, {verdict}; {self.seconds:.2g} s per run",
            f"{'h':>9} {'dt':>9} {'modes':>5} {'n':>7} {'space':>8} {'time':>8} {'model':>8} "
            " scheme",
        ]
        for choice, n, error, is_enough in self.evidence:
            lines.append(
                f"{choice.h:9.3g} {choice.dt:9.3g} {choice.modes or 'full':>5} {n:7d} "
                f"{error.space:8.1e} {error.time:8.1e} {error.reduction:8.1e}  "
                f"{type(choice.scheme).__name__}{' *' if is_enough else ''}"
            )
        return "\n".join([*lines, *self.warnings])

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the errors of space and time of all that was tried against the unknowns.

        Raises:
            ImportError: if matplotlib is missing.
        """
        ax = make_axes(ax)
        for number, scheme in enumerate(dict.fromkeys(x.choice.scheme for x in self.evidence)):
            mine = [x for x in self.evidence if x.choice.scheme == scheme]
            for name, marker in (("space", "o"), ("time", "s"), ("reduction", "^")):
                errors = [(x.unknowns, getattr(x.error, name)) for x in mine]
                errors = [point for point in errors if point[1] > 0.0]
                if errors:
                    label = f"{name}, {type(scheme).__name__}"
                    ax.loglog(*np.array(errors).T, marker, color=f"C{number}", label=label)
        ax.set(xlabel="unknowns", ylabel="estimated error of the quantity")
        ax.legend()
        return add_grid(ax)


def recommend(
    build: Build,
    quantity: Quantity,
    tolerance: float,
    *,
    schemes: Sequence[Scheme] = (ContactImplicit(), ContactStabilized()),
    budget: float | None = None,
    h: float | None = None,
    dt: float | None = None,
) -> Recommendation:
    """Find mesh size, time step, scheme and model for a tolerance of a quantity.

    The probes take 20 to 300 times as long as the run that they recommend: it is a tool for
    optimisations and ensembles, not for one run. Meshes of more than 5000 unknowns are probed by
    reduced models.

    Args:
        build: makes the scene of a mesh size h [m].
        quantity: simulates with a stepper up to a time, with
            `steps=round(end / float(stepper.dt))`, and returns a number, or a number and the
            trajectory; the warnings need the trajectory.
        tolerance: largest error of the quantity relative to its size. Take a quantity that keeps
            its size, a mean over time and not an end value that may vanish.
        schemes: the time-stepping schemes to choose from.
        budget: seconds that the probes may take, compilation included; default 300.
        h: the coarsest mesh size, [m], which is only compared with; default a quarter of the length
            of the body, which is measured on the mesh of `build(1.0)`.
        dt: the longest time step, [s]; default the time of a wave through a cell of that mesh.

    Returns:
        The recommendation. If the budget ends before the tolerance is reached, the best that was
        found, with its error.

    Raises:
        ValueError: if the tolerance is not between 0 and 1, or as `estimate_error`.
        SolveError: if a step was not solved.
    """
    if not (np.ndim(tolerance) == 0 and 0.0 < float(tolerance) < 1.0):
        raise ValueError(f"tolerance must lie between 0 and 1, got {tolerance}")
    for scheme in schemes:
        check_option("schemes", scheme, Scheme, "(ContactImplicit(),)")
    if not schemes:
        raise ValueError("name at least one scheme")
    probes = Probes(build, quantity)
    h = _coarsest(build) if h is None else float(h)
    dtype = jnp.dtype(float if jax.config.read("jax_enable_x64") else jnp.float32)
    first = Choice(h, 1.0, schemes[0], dtype)
    dt = _wave_time(probes.system(first)) if dt is None else float(dt)
    begin, budget = time.perf_counter(), BUDGET if budget is None else float(budget)
    deadline = begin + budget
    evidence: list[Evidence] = []
    for k, scheme in enumerate(schemes, start=1):
        share = begin + budget * k / len(schemes)
        _refine(probes, first._replace(dt=dt, scheme=scheme), tolerance, share, evidence)
    enough = [x for x in evidence if x.is_enough]
    if enough:
        enough = [y for x in enough for y in _reduced(probes, x, tolerance, deadline, evidence)]
    found = enough or [min(evidence, key=lambda x: x.error.total)]
    seconds = {x.choice: _seconds(probes, x.choice) for x in found}
    best = min(found, key=lambda x: seconds[x.choice])
    choice = best.choice
    warnings: tuple[str, ...] = ()
    if choice in probes.trajectories:
        stepper, motion = probes.stepper(choice), probes.trajectories[choice]
        warnings = limits(build(choice.h), stepper, motion, choice.h, tolerance)
    return Recommendation(
        choice.h,
        choice.dt,
        choice.modes,
        choice.scheme,
        choice.dtype,
        best.error.total,
        best.is_enough,
        seconds[choice],
        tuple(evidence),
        warnings,
    )


def _refine(
    probes: Probes, choice: Choice, tolerance: float, deadline: float, evidence: list[Evidence]
) -> None:
    """Halve mesh size or time step until the tolerance is met or the time is up."""
    choice = choice._replace(h=choice.h / 2)
    dimension = probes.system(choice).dimension
    price = {"h": dimension * GROWTH * math.log(2.0), "dt": math.log(2.0)}
    while True:
        begin = time.perf_counter()
        is_large = probes.system(choice._replace(h=choice.h / 2, modes=None)).size > LARGE
        choice = choice._replace(modes=PROBED_MODES if is_large else None)
        error = parts_of_error(probes, choice)
        allowed = tolerance * abs(error.value)
        is_met = error.total <= allowed
        is_enough = is_met and _change(probes, choice) <= SECOND_ORDER * allowed
        evidence.append(Evidence(choice, probes.system(choice).size, error, is_enough))
        spent = time.perf_counter() - begin
        # The next one takes at least as long.
        if is_enough or time.perf_counter() + spent > deadline:
            return
        gain = {"h": error.space / price["h"], "dt": error.time / price["dt"]}
        if error.space <= NEGLIGIBLE * allowed:
            gain["h"] = 0.0
        if error.time <= NEGLIGIBLE * allowed:
            gain["dt"] = 0.0
        # Within the tolerance by chance, or else what refining does not mend.
        if not is_met and not any(gain.values()):
            return
        is_mesh = is_met or gain["h"] >= gain["dt"]
        choice = choice._replace(h=choice.h / 2) if is_mesh else choice._replace(dt=choice.dt / 2)


def _change(probes: Probes, choice: Choice) -> float:
    """Return the difference of the quantity to that on the mesh of twice the size."""
    coarser = choice._replace(h=2 * choice.h, modes=None)
    if probes.system(coarser).size > LARGE:
        coarser = coarser._replace(modes=choice.modes)
    return probes.difference(coarser, choice)


def _reduced(
    probes: Probes, full: Evidence, tolerance: float, deadline: float, evidence: list[Evidence]
) -> list[Evidence]:
    """Return a configuration and the smallest reduced model of it that is within the tolerance."""
    if full.choice.modes is not None:
        return [full]
    for modes in TRIED_MODES:
        if 3 * modes > full.unknowns or time.perf_counter() > deadline:
            break
        choice = full.choice._replace(modes=modes)
        missed = probes.difference(choice, full.choice)
        error = ErrorEstimate(
            full.error.value, full.error.space, full.error.time, missed, full.error.precision
        )
        is_enough = error.total <= tolerance * abs(error.value)
        row = Evidence(choice, probes.system(choice).size, error, is_enough)
        evidence.append(row)
        if is_enough:
            return [full, row]
    return [full]


def _seconds(probes: Probes, choice: Choice) -> float:
    """Return the time of a run that is compiled already, [s]."""
    stepper = probes.stepper(choice)
    number_of(probes.quantity(stepper))
    begin = time.perf_counter()
    number_of(probes.quantity(stepper))
    return time.perf_counter() - begin


def _coarsest(build: Build) -> float:
    """Return a quarter of the length of the body that is built."""
    points = np.asarray(build(1.0).mesh.points)
    return 0.25 * float(np.max(np.ptp(points, axis=0)))


def _wave_time(system: System) -> float:
    """Return the time of a wave through the smallest cell, h / c in a bar, [s]."""
    stiffness, mass = system.stiffness.diagonal(), system.mass.diagonal()
    # In a bar the diagonals are 2 E / h and 2 rho h / 3.
    return float(math.sqrt(3.0) / jnp.sqrt(jnp.max(stiffness / mass)))
