"""Which optimiser gets how far? Value and stationarity against gradients and time.

The paper's control problem, from u = 0, with every method, on three meshes and two horizons.
Values are those of the exact problem, also for the homotopy in relaxed contact. The work of a run
is its gradients plus twice its Hessian products, each the derivative of a gradient. Compilation
is not timed: every method first makes one iteration that does not count. The residual of strong
stationarity says what a method stopped at: a minimiser, or a kink.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import measure
import numpy as np
import optax

import jaxcontact as jc
from jaxcontact.optimize import LBFGS, NewtonCG

RINGS = [8, 12, 16]
STEPS = [150, 1500]
METHODS = {
    "steepest descent": (jc.SteepestDescent(), 1000),
    "adam": (jc.Optax(optax.adam(0.02)), 500),
    "L-BFGS": (LBFGS(), 500),
    "Newton-CG": (NewtonCG(), 100),
    "homotopy": (jc.Homotopy(), 20),
}
QUICK_METHODS = {
    "steepest descent": (jc.SteepestDescent(), 3),
    "L-BFGS": (LBFGS(), 3),
    "homotopy": (jc.Homotopy(levels=2), 20),
}


def half_disc(rings: int, steps: int, dtype: Any) -> jc.scenes.ControlProblem:
    """Return the paper's problem on a mesh of so many rings of cells."""
    return jc.scenes.half_disc_control(h=jc.scenes.RADIUS / rings, steps=steps, dtype=dtype)


def run(problem: jc.scenes.ControlProblem, method: Any, iterations: int) -> dict[str, Any]:
    """Return one row: a method on a problem."""
    start = jnp.zeros_like(problem.reference)
    options = {"method": method, "system": problem.system, "dt": problem.dt}
    jc.optimize(problem.objective, start, iterations=1, **options)
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


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw the lowest value so far above the best one against work, one panel per problem."""
    import matplotlib.pyplot as plt

    problems = sorted({(row["steps"], row["unknowns"]) for row in rows})
    columns = len({unknowns for _, unknowns in problems})
    lines = -(-len(problems) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(4.2 * columns, 3.6 * lines), squeeze=False, sharey=True
    )
    for panel, (steps, unknowns) in zip(axes.flat, problems, strict=False):
        chosen = [row for row in rows if (row["steps"], row["unknowns"]) == (steps, unknowns)]
        best = min(row["value"] for row in chosen)
        for row in chosen:
            history = row["history"]
            work = np.add(history["evaluations"], 2 * np.array(history["hessian_products"]))
            lowest = np.minimum.accumulate(history["value"]) / best - 1.0
            label = row["name"]
            if row["stationarity"] is not None:
                label += f" ({row['stationarity']:.0e})"
            panel.loglog(work, np.maximum(lowest, 1e-10), ".-", label=label)
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
            for name, (method, iterations) in methods.items():
                row = {"name": name, "rings": rings, **run(problem, method, iterations)}
                measure.print_table([{k: v for k, v in row.items() if k != "history"}])
                rows.append(row)
            if not options.quick:
                jax.clear_caches()  # programs of another shape are of no use to the next problem
    measure.save("optimizers", rows, options.out, dtype=str(options.dtype))
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
