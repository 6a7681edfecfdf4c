"""Error against run time: which scheme, mesh, step and precision buys the most accuracy?

Displacement, contact force, energy and gradient of the bars P1, P2, P3 against their exact
solutions, and of the half disc against a fine run. Run time is that of the simulation (of value and
gradient for the gradient), compiled beforehand. The line is the Pareto front.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import bars
import half_disc_runs
import jax
import jax.numpy as jnp
import measure
import numpy as np

import jaxcontact as jc

SCHEMES = {
    "ContactImplicit": jc.ContactImplicit(),
    "ContactStabilized": jc.ContactStabilized(),
    "RedistributedMass": jc.RedistributedMass(),
    "BackwardEuler": jc.BackwardEuler(),
    "Trapezoidal": jc.Trapezoidal(),
}
QUANTITIES = ("displacement", "force", "energy", "gradient")


def bar_mean(
    bar: bars.Bar, stepper: jc.Stepper, phase: jax.Array, p: jax.Array, steps: int
) -> jax.Array:
    """Return the mean final displacement of a bar, a function of a factor p.

    The factor scales the amplitude of P1, the speed of P2 and the height of P3.
    """
    _, stepper, initial = bars.place(bar, stepper, phase)
    if not bar.has_gap or bar.velocity:
        initial = jc.State(p * initial.displacement, p * initial.velocity)
    else:
        system = dataclasses.replace(stepper.system, gap=p * stepper.system.gap)
        stepper = dataclasses.replace(stepper, system=system)
    return jnp.mean(jc.simulate(stepper, steps=steps, initial=initial).final.displacement)


def exact_mean(bar: bars.Bar, gap: jax.Array, x: jax.Array, t: jax.Array, p: jax.Array):
    """Return the exact mean final displacement."""
    exact = bar.exact
    if not bar.has_gap:
        exact = dataclasses.replace(exact, amplitude=p * exact.amplitude)
    elif bar.velocity:
        exact = dataclasses.replace(exact, gap=gap, impact_speed=p * exact.impact_speed)
    else:
        exact = dataclasses.replace(exact, gap=p * gap)
    return jnp.mean(exact.displacement(x, t))


def measure_bar(problem: str, name: str, n: int, courant: float, dtype: Any, repeats: int) -> dict:
    """Return one row of a bar: means over four phases (root mean square of the gradient's error).

    A single phase tells nothing about the gradient: see `ContactImplicit`.
    """
    bar = bars.PROBLEMS[problem]()
    found = bars.run(bar, SCHEMES[name], n, courant, count=4, dtype=dtype)
    dt = bars.time_step(bar, n, courant)
    stepper = jc.prepare(bars.discretize(bar, n, dtype=dtype), dt, scheme=SCHEMES[name])
    steps = math.ceil((bar.duration + dt) / dt)
    one = jnp.ones((), dtype)
    touches = [jnp.asarray(phase, dtype) for phase in bars.phases(bar, dt, 4)]
    value, compile_s = measure.compiled(
        lambda p, phase, stepper: bar_mean(bar, stepper, phase, p, steps), one, touches[0], stepper
    )
    slope, _ = measure.compiled(
        jax.value_and_grad(lambda p, phase, stepper: bar_mean(bar, stepper, phase, p, steps)),
        one,
        touches[0],
        stepper,
    )
    x, t = jnp.asarray(stepper.system.points[:, 0], float), jnp.asarray(float(stepper.dt) * steps)
    exact = jax.grad(lambda p, gap: exact_mean(bar, gap, x, t, p))
    gradient_errors = [
        float(slope(one, phase, stepper)[1]) / float(exact(1.0, phase.astype(float))) - 1.0
        for phase in touches
    ]
    return {
        "problem": problem,
        "scheme": name,
        "n": n,
        "courant": courant,
        "dtype": jnp.dtype(dtype).name,
        "compile_s": compile_s,
        "run_s": measure.seconds(lambda: value(one, touches[0], stepper), repeats),
        "gradient_s": measure.seconds(lambda: slope(one, touches[0], stepper), repeats),
        "displacement": found.displacement.mean(),
        "force": found.force.mean(),
        "energy": np.abs(1.0 - found.final_energy).mean(),
        "gradient": float(np.sqrt(np.mean(np.square(gradient_errors)))),
    }


def measure_half_disc(
    name: str, rings: int, steps: int, dtype: Any, repeats: int, fine: half_disc_runs.Reference
) -> dict:
    """Return one row of the half disc."""
    stepper = half_disc_runs.prepare(rings, half_disc_runs.DURATION / steps, SCHEMES[name], dtype)
    one = jnp.ones((), dtype)
    value, compile_s = measure.compiled(
        lambda stepper, p: half_disc_runs.run(stepper, p, steps), stepper, one
    )
    slope, _ = measure.compiled(
        lambda stepper, p: half_disc_runs.gradient(stepper, p, steps), stepper, one
    )
    _, trajectory = value(stepper, one)
    row = {
        "problem": "half disc",
        "scheme": name,
        "n": stepper.system.size,
        "courant": 150.0 / steps,
        "dtype": jnp.dtype(dtype).name,
        "compile_s": compile_s,
        "run_s": measure.seconds(lambda: value(stepper, one), repeats),
        "gradient_s": measure.seconds(lambda: slope(stepper, one), repeats),
    }
    return row | half_disc_runs.errors(stepper, trajectory, float(slope(stepper, one)), fine)


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
        len(problems), 4, figsize=(14, 3.0 * len(problems)), layout="constrained", squeeze=False
    )
    for line, problem in zip(axes, problems, strict=True):
        for axis, quantity in zip(line, QUANTITIES, strict=True):
            key = "gradient_s" if quantity == "gradient" else "run_s"
            mine = [row for row in rows if row["problem"] == problem]
            for colour, name in enumerate(SCHEMES):
                for dtype, marker in (("float64", "o"), ("float32", "x")):
                    found = [r for r in mine if (r["scheme"], r["dtype"]) == (name, dtype)]
                    label = name if dtype == "float64" else None
                    xs, ys = [r[key] for r in found], [r[quantity] for r in found]
                    axis.plot(xs, ys, marker, color=f"C{colour}", ms=4, label=label)
            points = [(r[key], r[quantity]) for r in mine if np.isfinite(r[quantity])]
            axis.plot(*np.array(pareto(points)).T, "k-", lw=0.8, label="Pareto front")
            axis.set(xscale="log", yscale="log", title=f"{problem}: {quantity}")
            axis.set_xlabel("run time [s]", fontsize=8)
            axis.set_ylabel("relative error", fontsize=8)
    axes[0][0].legend(fontsize=6)
    return figure


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw."""
    options = measure.parse(measure.parser(__doc__), argv)
    cells, courants = ([20], [1.0]) if options.quick else ([50, 100, 200, 400], [0.5, 1.0, 4.0])
    dtypes = [jnp.float64] if options.quick else [jnp.float64, jnp.float32]
    names = ["ContactImplicit", "BackwardEuler"] if options.quick else list(SCHEMES)
    problems = ["P2"] if options.quick else list(bars.PROBLEMS)
    rings, steps = ([2], [30]) if options.quick else ([4, 8, 16], [75, 150, 600])
    rows = [
        measure_bar(problem, name, n, courant, dtype, options.repeats)
        for problem in problems
        for name in names
        for n in cells
        for courant in courants
        for dtype in dtypes
    ]
    fine_size = (4, 60) if options.quick else (32, 2400)
    fine = half_disc_runs.reference(*fine_size, jc.ContactStabilized())
    rows += [
        measure_half_disc(name, m, count, dtype, options.repeats, fine)
        for name in names
        for m in rings
        for count in steps
        for dtype in dtypes
    ]
    measure.print_table(rows)
    measure.save("work_precision", rows, options.out, reference_rings_and_steps=fine_size)
    measure.save_chart(chart(rows), "work_precision", options.out)
    return rows


if __name__ == "__main__":
    main()
