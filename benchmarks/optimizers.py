"""Which optimiser gets how far? Value and stationarity against gradients and time.

The paper's control problem, from u = 0, with every method, on three meshes and two horizons.
Values are those of the exact problem, also for the homotopy in relaxed contact. The work of a run
is its gradients plus twice its Hessian products, each the derivative of a gradient. Compilation
is not timed: every method first makes one iteration that does not count. The residual of strong
stationarity says what a method stopped at: a minimiser, or a kink. On the long horizon, where a
gradient costs ten times as much, every method makes fewer iterations. The last lines that are
printed answer the claims about the default problem, 8 rings and 150 steps.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from common import measure

import jaxcontact as jc
from jaxcontact.optimize import LBFGS, NewtonCG

DEFAULT = (8, 150)
RINGS = [6, 8, 12]
STEPS = [150, 1500]
#: Method, its iterations, and those for runs of more than 150 steps.
METHODS = {
    "steepest descent": (jc.SteepestDescent(), 1000, 60),
    "adam": (jc.Optax(optax.adam(0.02)), 200, 60),
    "L-BFGS": (LBFGS(), 200, 60),
    "Newton-CG": (NewtonCG(), 30, 6),
    "homotopy": (jc.Homotopy(), 20, 3),
}
QUICK_METHODS = {
    "steepest descent": (jc.SteepestDescent(), 3, 3),
    "L-BFGS": (LBFGS(), 3, 3),
    "homotopy": (jc.Homotopy(levels=2), 20, 20),
}


def half_disc(rings: int, steps: int, dtype: Any) -> jc.scenes.ControlProblem:
    """Return the paper's problem on a mesh of so many rings of cells."""
    return jc.scenes.half_disc_control(h=jc.scenes.RADIUS / rings, steps=steps, dtype=dtype)


def run(problem: jc.scenes.ControlProblem, method: Any, iterations: int) -> dict[str, Any]:
    """Return one row: a method on a problem."""
    start = jnp.zeros_like(problem.reference)
    options = {"method": method, "system": problem.system, "dt": problem.dt}
    if isinstance(method, jc.Homotopy):
        warm = options | {"method": replace(method, max_steps=1)}
    else:
        warm = options
    jc.optimize(problem.objective, start, iterations=1, **warm)
    result = jc.optimize(problem.objective, start, iterations=iterations, **options)
    history, certificate = result.history, result.stationarity
    row = {
        "unknowns": problem.system.size,
        "steps": problem.steps,
        "method": type(method).__name__,
        "value": result.value,
        "gradients": int(history.evaluations[-1]),
        "hessian_products": int(history.hessian_products[-1]),
        "seconds": float(history.seconds[-1]),
        "stationarity": None,
        "weak_pairs": None,
        "wrong_signs": None,
        "status": result.status,
    }
    if certificate is not None:
        row |= {
            "stationarity": certificate.residual / history.gradient_norm[0],
            "weak_pairs": len(certificate.weak_pairs),
            "wrong_signs": certificate.wrong_signs,
        }
    row["history"] = {
        name: getattr(history, name).tolist()
        for name in ("value", "gradient_norm", "evaluations", "hessian_products", "seconds")
    }
    return row


def work_of(history: dict[str, list]) -> np.ndarray:
    """Return the work at every iteration, gradients plus twice the Hessian products."""
    return np.add(history["evaluations"], 2 * np.array(history["hessian_products"]))


def answers(rows: list[dict[str, Any]]) -> list[str]:
    """Return one line per claim about the default problem."""
    chosen = {r["name"]: r for r in rows if (r["rings"], r["steps"]) == DEFAULT}
    if not {"steepest descent", "L-BFGS", "homotopy"} <= set(chosen):
        return []
    descent, best = chosen["steepest descent"], min(row["value"] for row in chosen.values())
    lines = [f"steepest descent ends at {descent['value']:.7f} ({descent['status']})"]
    for name, asked in (("L-BFGS", "60 gradients"), ("homotopy", "25 gradients + 500 products")):
        history = chosen[name]["history"]
        below = np.flatnonzero(np.array(history["value"]) < descent["value"])
        reached = "never"
        if below.size:
            counts = history["evaluations"][below[0]], history["hessian_products"][below[0]]
            reached = "{} gradients + {} products".format(*counts)
        lines.append(f"{name} is below it after {reached}; asked: {asked}")
    for row in chosen.values():
        if row["stationarity"] is not None:
            lines.append(
                f"{row['name']} ends at a strong stationarity of {row['stationarity']:.2e} after "
                f"{row['gradients']} gradients + {row['hessian_products']} products, "
                f"{row['weak_pairs']} weak pairs, {row['wrong_signs']} with a wrong sign"
            )
    lines.append("asked of the homotopy: 1e-8, 300 gradients + 3000 products, no wrong sign")
    for name, row in chosen.items():
        near = np.flatnonzero(np.array(row["history"]["value"]) <= 1.001 * best)
        when = f"{row['history']['seconds'][near[0]]:.1f} s" if near.size else "never"
        lines.append(f"{name} is within 1e-3 of the best value after {when}; asked of one: 10 s")
    return lines


def draw_default(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw value and gradient norm of the default problem against work and time."""
    import matplotlib.pyplot as plt

    chosen = [row for row in rows if (row["rings"], row["steps"]) == DEFAULT]
    if not chosen:
        return
    best = min(row["value"] for row in chosen)
    figure, axes = plt.subplots(2, 2, figsize=(9, 6.4), sharex="col", sharey="row")
    for row in chosen:
        history = row["history"]
        lowest = np.minimum.accumulate(history["value"]) / best - 1.0
        norms = np.array(history["gradient_norm"]) / history["gradient_norm"][0]
        for column, x in enumerate((work_of(history), np.array(history["seconds"]))):
            axes[0, column].loglog(x, np.maximum(lowest, 1e-10), ".-", label=row["name"])
            axes[1, column].loglog(x, norms, ".-", label=row["name"])
    axes[0, 0].set_ylabel("lowest value / best value - 1")
    axes[1, 0].set_ylabel("norm of the exact gradient / first one")
    axes[1, 0].set_xlabel("gradients + 2 products")
    axes[1, 1].set_xlabel("seconds")
    axes[0, 0].legend(fontsize=8)
    for panel in axes.flat:
        panel.grid(alpha=0.3)
    measure.save_chart(figure, "optimizers_default", out)
    plt.close(figure)


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw the lowest value so far above the best one against work, one panel per problem."""
    import matplotlib.pyplot as plt

    problems = sorted({(row["steps"], row["unknowns"]) for row in rows})
    columns = len({unknowns for _, unknowns in problems})
    lines = -(-len(problems) // columns)
    figure, axes = plt.subplots(
        lines,
        columns,
        figsize=(4.2 * columns, 3.6 * lines),
        squeeze=False,
        sharey=True,
        layout="constrained",
    )
    for panel, (steps, unknowns) in zip(axes.flat, problems, strict=False):
        chosen = [row for row in rows if (row["steps"], row["unknowns"]) == (steps, unknowns)]
        best = min(row["value"] for row in chosen)
        for row in chosen:
            history = row["history"]
            lowest = np.minimum.accumulate(history["value"]) / best - 1.0
            label = row["name"]
            if row["stationarity"] is not None:
                label += f" ({row['stationarity']:.0e})"
            panel.loglog(work_of(history), np.maximum(lowest, 1e-10), ".-", label=label)
        panel.set(title=f"{unknowns} unknowns, {steps} steps", xlabel="gradients + 2 products")
        panel.legend(title="relative stationarity", fontsize=7, title_fontsize=7)
        panel.grid(alpha=0.3)
    axes[0, 0].set_ylabel("lowest value / best value - 1")
    measure.save_chart(figure, "optimizers", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    """Run the benchmark; return its rows."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--rings", type=int, nargs="*", default=RINGS)
    arguments.add_argument("--steps", type=int, nargs="*", default=STEPS)
    options = measure.parse(arguments, argv)
    methods = METHODS
    if options.quick:
        options.rings, options.steps, methods = [3], [20], QUICK_METHODS
    rows = []
    for steps in options.steps:
        for rings in options.rings:
            problem = half_disc(rings, steps, options.dtype)
            for name, (method, short, long) in methods.items():
                iterations = short if steps <= 150 else long
                row = {"name": name, "rings": rings, **run(problem, method, iterations)}
                measure.print_table([{k: v for k, v in row.items() if k != "history"}])
                rows.append(row)
            # After every problem, so that an interrupted run leaves what it has.
            measure.save("optimizers", rows, options.out, dtype=str(options.dtype))
            if not options.quick:
                jax.clear_caches()  # programs of another shape are of no use to the next problem
    draw(rows, options.out)
    draw_default(rows, options.out)
    print("\n".join(answers(rows)))
    return rows


if __name__ == "__main__":
    main()
