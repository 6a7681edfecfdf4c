"""Does the work of an optimiser grow with the mesh? Evaluations against h and dt.

The paper's control problem over 0.0075 s from u = 0, with mesh size and time step halved
together and one by one. Counted is the work until the value has fallen by 99.9 % of what it can
fall, the lowest value known of each problem being that of the homotopy. In the inner product of
L2(0,T; L2) the counts should not depend on h and dt.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import measure

import jaxcontact as jc
from jaxcontact.optimize import LBFGS

#: Rings of cells and time steps.
CASES = [(8, 150), (16, 150), (8, 300), (16, 300)]
DURATION = 0.0075
DECREASE = 0.999
METHODS = {
    "homotopy": (jc.Homotopy(levels=6), 20),
    "L-BFGS": (LBFGS(), 150),
    "steepest descent": (jc.SteepestDescent(), 300),
}
QUICK_METHODS = {"homotopy": (jc.Homotopy(levels=2), 20), "L-BFGS": (LBFGS(), 5)}


def measure_case(
    rings: int, steps: int, methods: dict[str, Any], dtype: Any
) -> list[dict[str, Any]]:
    """Return the rows of one problem: the work of every method."""
    problem = jc.scenes.half_disc_control(
        h=jc.scenes.RADIUS / rings, steps=steps, dt=DURATION / steps, dtype=dtype
    )
    start = jnp.zeros_like(problem.reference)
    rows, best = [], np.inf
    for name, (method, iterations) in methods.items():
        result = jc.optimize(
            problem.objective,
            start,
            method=method,
            system=problem.system,
            dt=problem.dt,
            iterations=iterations,
        )
        history = result.history
        best = min(best, result.value)
        goal = history.value[0] - DECREASE * (history.value[0] - best)
        reached = np.flatnonzero(history.value <= goal)
        row = {
            "rings": rings,
            "unknowns": problem.system.size,
            "steps": steps,
            "method": name,
            "value": result.value,
            "best": best,
            "iterations": None,
            "gradients": None,
            "hessian_products": None,
        }
        if reached.size:
            first = int(reached[0])
            row |= {
                "iterations": first,
                "gradients": int(history.evaluations[first]),
                "hessian_products": int(history.hessian_products[first]),
            }
        rows.append(row)
    return rows


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw the work of every method over the cases."""
    import matplotlib.pyplot as plt

    cases = list(dict.fromkeys((row["rings"], row["steps"]) for row in rows))
    figure, axes = plt.subplots(figsize=(6, 4))
    for name in dict.fromkeys(row["method"] for row in rows):
        chosen = [row for row in rows if row["method"] == name]
        work = [
            np.nan if row["gradients"] is None else row["gradients"] + 2 * row["hessian_products"]
            for row in chosen
        ]
        axes.semilogy(range(len(cases)), work, "o-", label=name)
    axes.set_xticks(range(len(cases)), [f"h = R/{rings}\n{steps} steps" for rings, steps in cases])
    axes.set_ylabel(f"gradients + 2 products to {100 * DECREASE:g} % of the decrease")
    axes.legend()
    axes.grid(alpha=0.3)
    measure.save_chart(figure, "mesh_independence", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    """Run the benchmark; return its rows."""
    options = measure.parse(measure.parser(__doc__), argv)
    cases, methods = (CASES, METHODS)
    if options.quick:
        cases, methods = [(3, 20), (4, 20)], QUICK_METHODS
    rows = []
    for rings, steps in cases:
        new = measure_case(rings, steps, methods, options.dtype)
        measure.print_table(new)
        rows += new
        # After every problem, so that an interrupted run leaves what it has.
        measure.save("mesh_independence", rows, options.out, dtype=str(options.dtype))
        if not options.quick:
            jax.clear_caches()  # programs of another shape are of no use to the next problem
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
