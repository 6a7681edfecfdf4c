"""Error against run time: which scheme, contact law, mesh, step and precision is most accurate?

Displacement, contact force, energy and gradient of the bars P1, P2, P3 against their exact
solutions, and of the half disc against a fine run. One compiled program of a scheme, mesh and
precision serves all time steps; the run time of a row is the time per step of that program times
the number of steps (value and gradient together in the column of the gradient). Line: Pareto front.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import bars, half_disc_runs, measure

import jaxcontact as jc

SCHEMES = {
    "ContactImplicit": jc.ContactImplicit(),
    "ContactStabilized": jc.ContactStabilized(),
    "RedistributedMass": jc.RedistributedMass(),
    "BackwardEuler": jc.BackwardEuler(),
    "Trapezoidal": jc.Trapezoidal(),
    "RelaxedContact": jc.ContactImplicit(),
    "SmoothedContact": jc.ContactImplicit(),
}
QUANTITIES = ("displacement", "force", "energy", "gradient")
PHASES = 8


class Case(NamedTuple):
    """What is compiled once."""

    problem: str
    scheme: str
    n: int
    """Cells of a bar, rings of the half disc."""
    dtype: Any


def mean_at(
    stepper: jc.Stepper, initial: jc.State, gap: jax.Array, count: jax.Array, steps: int
) -> tuple[jax.Array, jc.Trajectory]:
    """Return the mean displacement after `count` of `steps` steps, and the trajectory."""
    system = dataclasses.replace(stepper.system, gap=gap)
    stepper = dataclasses.replace(stepper, system=system)
    trajectory = jc.simulate(stepper, steps=steps, initial=initial)
    return jnp.mean(trajectory.displacement[count]), trajectory


def with_law(name: str, stepper: jc.Stepper, trajectory: jc.Trajectory) -> jc.Stepper:
    """Return the stepper with the contact law of a name, of the size of a motion, if it has one."""
    if name not in ("RelaxedContact", "SmoothedContact"):
        return stepper
    law = getattr(jc, name).for_scene(stepper, speed=trajectory.closing_speed)
    return jc.with_contact(stepper, law)


def gradient_errors(relative: np.ndarray) -> dict[str, float]:
    """Return root mean square, mean and standard deviation of errors (PHASES,) of a gradient."""
    return {
        "gradient": float(np.sqrt(np.mean(relative**2))),
        "gradient_bias": float(np.mean(relative)),
        "gradient_spread": float(np.std(relative)),
    }


value = partial(jax.jit, static_argnums=4)(mean_at)
gradient = partial(jax.jit, static_argnums=4)(jax.grad(mean_at, argnums=(1, 2), has_aux=True))


@partial(jax.jit, static_argnums=0)
def exact_run(bar: bars.Bar, exact: Any, x: jax.Array, time: jax.Array):
    """Return distance from the wall (T+1, N) and mean contact force of the steps (T,)."""
    offset = exact.gap if bar.has_gap else 0.0
    distance = offset + exact.displacement(x[None, :], time[:, None])
    return distance, exact.contact_force_mean(time[:-1], time[1:])


@partial(jax.jit, static_argnums=0)
@partial(jax.grad, argnums=4)
def exact_slope(bar: bars.Bar, exact: Any, x: jax.Array, t: jax.Array, p: jax.Array):
    """Return the derivative of the exact mean displacement by the factor p of `bar_slope`."""
    if not bar.has_gap:
        exact = dataclasses.replace(exact, amplitude=p * exact.amplitude)
    elif bar.velocity:
        exact = dataclasses.replace(exact, impact_speed=p * exact.impact_speed)
    else:
        exact = dataclasses.replace(exact, gap=p * exact.gap)
    return jnp.mean(exact.displacement(x, t))


def bar_slope(bar: bars.Bar, by_initial: jc.State, by_gap: jax.Array, start: Any) -> float:
    """Return the derivative by a factor of the amplitude of P1, the speed of P2, the gap of P3."""
    initial, gap = start
    if not bar.has_gap:
        return float(jnp.vdot(by_initial.displacement, initial.displacement))
    if bar.velocity:
        return float(jnp.vdot(by_initial.velocity, initial.velocity))
    return float(jnp.vdot(by_gap, gap))


def bar_errors(bar: bars.Bar, case: Case, courant: float, phase: Any, steps: int) -> np.ndarray:
    """Return the four errors of one phase, signed for energy and gradient, in NumPy."""
    dt = bars.time_step(bar, case.n, courant)
    count = bars.n_steps(bar, dt)
    # P1 touches at L/c: there the step, not the gap, is moved by a fraction of a step.
    length = 1.0 if bar.has_gap else 1.0 / (1.0 + phase * courant / case.n)
    system = bars.discretize(bar, case.n, dtype=case.dtype)
    stepper = jc.prepare(system, dt * length, scheme=SCHEMES[case.scheme])
    exact, stepper, initial = bars.place(bar, stepper, jnp.asarray(phase))
    gap = stepper.system.gap
    stepper = with_law(case.scheme, stepper, value(stepper, initial, gap, count, steps)[1])
    by, trajectory = gradient(stepper, initial, gap, count, steps)
    x = jnp.asarray(stepper.system.points[:, 0], float)
    time = float(stepper.dt) * jnp.arange(steps + 1.0)
    distance, mean = (np.asarray(field, float) for field in exact_run(bar, exact, x, time))
    offset = float(exact.gap) if bar.has_gap else 0.0
    error = offset + np.asarray(trajectory.displacement[:, :, 0], float) - distance
    force = np.asarray(trajectory.contact_impulse[:, 0], float) / float(stepper.dt)
    ends = [
        float(half_disc_runs.energy_at(stepper, trajectory.displacement[k], trajectory.velocity[k]))
        - float(jnp.dot(stepper.system.load, stepper.system.restrict(trajectory.displacement[k])))
        - float(jnp.sum(stepper.system.load)) * offset
        for k in (0, count)
    ]
    slope = bar_slope(bar, *by, (initial, gap))
    return np.array(
        [
            np.linalg.norm(error[: count + 1]) / np.linalg.norm(distance[: count + 1]),
            np.abs(force - mean)[:count].sum() / mean[:count].sum(),
            ends[1] / ends[0] - 1.0,
            slope / float(exact_slope(bar, exact, x, time[count], 1.0)) - 1.0,
        ]
    )


def measure_bars(problems: list[str], case: Case, courants: list[float], repeats: int) -> list:
    """Return the rows of problems that share their programs: means over phases of the impact.

    The gradient is judged by mean and spread: a single phase tells nothing, see `SmoothedContact`.
    """
    needed = {
        (problem, courant): bars.n_steps(bar, bars.time_step(bar, case.n, courant))
        for problem, bar in ((name, bars.PROBLEMS[name]()) for name in problems)
        for courant in courants
    }
    steps = max(needed.values())
    rows = []
    for (problem, courant), count in needed.items():
        bar = bars.PROBLEMS[problem]()
        places = bars.phases(bar, bars.time_step(bar, case.n, courant), PHASES)
        found = np.array([bar_errors(bar, case, courant, phase, steps) for phase in places])
        errors = map(float, np.abs(found[:, :3]).mean(axis=0))
        row = case._replace(problem=problem)._asdict() | {"courant": courant, "steps": count}
        row |= dict(zip(QUANTITIES[:3], errors, strict=True))
        rows.append(row | gradient_errors(found[:, 3]))
    stepper = jc.prepare(
        bars.discretize(bar, case.n, dtype=case.dtype),
        bars.time_step(bar, case.n, 1.0),
        scheme=SCHEMES[case.scheme],
    )
    _, stepper, initial = bars.place(bar, stepper, jnp.asarray(places[0]))
    arguments = stepper, initial, stepper.system.gap, steps, steps
    stepper = with_law(case.scheme, stepper, value(*arguments)[1])
    arguments = stepper, *arguments[1:]
    return timed(rows, value, gradient, arguments, steps, repeats)


def measure_half_disc(
    case: Case, counts: list[int], repeats: int, fine: half_disc_runs.Reference
) -> list[dict]:
    """Return the rows of the half disc, one for each number of steps."""
    one, steps = jnp.ones((), case.dtype), max(counts)
    rows = []
    for count in counts:
        dt = half_disc_runs.DURATION / count
        stepper = half_disc_runs.prepare(case.n, dt, SCHEMES[case.scheme], case.dtype)
        _, trajectory = half_disc_runs.value(stepper, one, count, steps)
        stepper = with_law(case.scheme, stepper, trajectory)
        _, trajectory = half_disc_runs.value(stepper, one, count, steps)
        found = half_disc_runs.errors(stepper, trajectory, count, fine)
        slopes = half_disc_runs.slopes(stepper, trajectory, count, steps, PHASES)
        found |= gradient_errors(slopes / fine.gradient - 1.0)
        rows.append(case._asdict() | {"courant": None, "steps": count} | found)
    arguments = stepper, one, steps, steps
    return timed(rows, half_disc_runs.value, half_disc_runs.gradient, arguments, steps, repeats)


def timed(
    rows: list, value: Any, gradient: Any, arguments: tuple, steps: int, repeats: int
) -> list:
    """Return the rows with the run times of their program and a name for their dtype."""
    run = measure.seconds(lambda: value(*arguments), repeats) / steps
    both = measure.seconds(lambda: gradient(*arguments), repeats) / steps
    return [
        row
        | {
            "dtype": jnp.dtype(row["dtype"]).name,
            "run_s": run * row["steps"],
            "gradient_s": both * row["steps"],
        }
        for row in rows
    ]


def pareto(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points (time, error) that no other point beats in both, sorted by time."""
    front: list[tuple[float, float]] = []
    for time, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((time, error))
    return front


def chart(rows: list[dict]):
    """Return the figure: problems down, quantities across, with the Pareto fronts."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    problems = list(dict.fromkeys(row["problem"] for row in rows))
    figure, axes = plt.subplots(
        len(problems), 4, figsize=(13, 2.8 * len(problems)), layout="constrained", squeeze=False
    )
    for line, problem in zip(axes, problems, strict=True):
        mine = [row for row in rows if row["problem"] == problem]
        meshes = sorted({row["n"] for row in mine})
        for axis, quantity in zip(line, QUANTITIES, strict=True):
            key = "gradient_s" if quantity == "gradient" else "run_s"
            for colour, name in enumerate(SCHEMES):
                for row in (row for row in mine if row["scheme"] == name):
                    is_double = row["dtype"] == "float64"
                    axis.plot(
                        row[key],
                        row[quantity],
                        "o",
                        color=f"C{colour}",
                        mfc=f"C{colour}" if is_double else "none",
                        ms=3 + 2 * meshes.index(row["n"]),
                        alpha=0.75,
                    )
            points = [(r[key], r[quantity]) for r in mine if np.isfinite(r[quantity])]
            axis.step(*np.array(pareto(points)).T, "k-", lw=0.8, where="post")
            axis.set(xscale="log", yscale="log", title=f"{problem}: {quantity}")
            # Gradients of Trapezoidal grow to 1e100; a point above the frame is useless.
            axis.set_ylim(top=min(axis.get_ylim()[1], 30.0))
            axis.grid(alpha=0.3)
        line[0].set_ylabel("relative error")
    for axis in axes[-1]:
        axis.set_xlabel("run time [s]")
    keys = [plt.Line2D([], [], marker="o", ls="", color=f"C{i}") for i in range(len(SCHEMES))]
    keys += [
        plt.Line2D([], [], marker="o", ls="", color="grey", mfc="none"),
        plt.Line2D([], [], color="k", lw=0.8),
    ]
    labels = [*SCHEMES, "float32 (hollow)", "Pareto front; larger dots: finer mesh"]
    figure.legend(keys, labels, loc="outside lower center", ncols=4)
    return figure


def sizes(name: str, doubles: list[int], singles: list[int]) -> list[tuple[int, Any]]:
    """Return the meshes and types of a scheme; two schemes show what float32 does."""
    found: list[tuple[int, Any]] = [(n, jnp.float64) for n in doubles]
    if name in ("ContactImplicit", "ContactStabilized"):
        found += [(n, jnp.float32) for n in singles]
    return found


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw."""
    options = measure.parse(measure.parser(__doc__), argv)
    courants = [1.0] if options.quick else [0.5, 1.0, 4.0]
    names = ["ContactImplicit", "SmoothedContact"] if options.quick else list(SCHEMES)
    groups = [["P2"]] if options.quick else [["P1"], ["P2", "P3"]]
    doubles = [20] if options.quick else [50, 100, 200]
    singles = [] if options.quick else [100]
    rows = []
    for problems in groups:
        for name in names:
            for n, dtype in sizes(name, doubles, singles):
                case = Case("bar", name, n, dtype)
                rows += measure_bars(problems, case, courants, options.repeats)
                print(f"measured {' and '.join(problems)}, {name}, {n} cells, {dtype.__name__}")
    rings, counts = ([2], [30]) if options.quick else ([4, 8, 16], [75, 150, 600])
    fine_size = (4, 60) if options.quick else (32, 2400)
    fine = half_disc_runs.reference(*fine_size, jc.ContactStabilized(), PHASES)
    for name in names:
        for m, dtype in sizes(name, rings, rings[1:2]):
            case = Case("half disc", name, m, dtype)
            rows += measure_half_disc(case, counts, options.repeats, fine)
            print(f"measured the half disc, {name}, {m} rings, {dtype.__name__}")
    measure.print_table(rows)
    measure.save("work_precision", rows, options.out, reference_rings_and_steps=fine_size)
    measure.save_chart(chart(rows), "work_precision", options.out)
    return rows


if __name__ == "__main__":
    main()
