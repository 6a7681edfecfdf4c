"""Which optimiser gets how far? Value and stationarity against gradients and time.

The paper's control problem, from u = 0: four meshes, bounds on the control, and a horizon ten times
as long. Values are those of the exact problem, also for the homotopy in relaxed contact. The work
of a run is its gradients and its Hessian products, each a sweep forward and one back, plus its gap
rows, each at most a sweep. Compilation is not timed: every run is made twice. The residual of
strong stationarity says what a method stopped at: a minimiser, or a kink. The last lines that are
printed are the claims about the homotopy.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from common import measure

import jaxcontact as jc
from jaxcontact.control.problem import Problem
from jaxcontact.optimize import LBFGS, NewtonCG


class Case(NamedTuple):
    """One problem."""

    rings: int
    """Rings of cells of the half disc."""

    steps: int = 150
    """Time steps."""

    bound: float | None = None
    """Largest force density in each direction, or None."""

    iterations: Mapping[str, int] = MappingProxyType({})
    """Iterations of the methods that make others than by default; zero leaves one out."""

    @property
    def name(self) -> str:
        """The title of its chart."""
        bound = "" if self.bound is None else f", |u| <= {self.bound}"
        return f"{self.rings} rings, {self.steps} steps{bound}"


DEFAULT = Case(8, iterations={"steepest descent": 1000})
SHORT = {"homotopy, path only": 0}
CASES = [
    Case(6, iterations=SHORT),
    DEFAULT,
    Case(12, iterations=SHORT),
    Case(16, iterations=SHORT | {"steepest descent": 100, "adam": 0}),
    Case(8, bound=0.5, iterations=SHORT),
    Case(3, steps=1500, iterations=SHORT | {"adam": 60, "Newton-CG": 15}),
]
#: Method and its iterations.
METHODS = {
    "steepest descent": (jc.SteepestDescent(), 200),
    "adam": (jc.Optax(optax.adam(0.02)), 200),
    "L-BFGS": (LBFGS(), 200),
    "Newton-CG": (NewtonCG(), 30),
    "homotopy, path only": (jc.Homotopy(finish=None), 20),
    "homotopy": (jc.Homotopy(), 20),
}
QUICK_METHODS = {
    "steepest descent": (jc.SteepestDescent(), 3),
    "L-BFGS": (LBFGS(), 3),
    "homotopy": (jc.Homotopy(), 20),
}


def half_disc(rings: int, steps: int, dtype: Any) -> jc.scenes.ControlProblem:
    """Return the paper's problem on a mesh of so many rings of cells."""
    return jc.scenes.half_disc_control(h=jc.scenes.RADIUS / rings, steps=steps, dtype=dtype)


def run(
    problem: jc.scenes.ControlProblem, method: Any, iterations: int, bound: float | None
) -> dict[str, Any]:
    """Return one row: a method on a problem."""
    start = jnp.zeros_like(problem.reference)
    for _ in range(2):
        result = jc.optimize(
            problem.objective,
            start,
            method=method,
            iterations=iterations,
            system=problem.system,
            dt=problem.dt,
            bounds=None if bound is None else (-bound, bound),
        )
    history, certificate = result.history, result.stationarity
    row = {
        "unknowns": problem.system.size,
        "steps": problem.steps,
        "method": type(method).__name__,
        "value": result.value,
        "gradients": int(history.evaluations[-1]),
        "hessian_products": int(history.hessian_products[-1]),
        "rows": int(history.gap_rows[-1]),
        "simulations": int(history.simulations[-1]),
        "seconds": float(history.seconds[-1]),
        "stationarity": None,
        "weak_pairs": None,
        "wrong_signs": None,
        "status": result.status.name,
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
    """Return the work at every iteration: gradients and Hessian products."""
    return np.add(history["evaluations"], history["hessian_products"])


def product_time(problem: jc.scenes.ControlProblem) -> dict[str, float]:
    """Return the time of a value with its gradient, and of a product with a linearised motion."""
    reduced = Problem.of(problem.objective, problem.reference, system=problem.system, dt=problem.dt)
    product = reduced.hessian(problem.reference)
    runs = {
        "gradient": lambda: reduced.evaluate(problem.reference),
        "product": lambda: product(problem.reference),
    }
    seconds = measure.interleaved_seconds(runs, 15)
    return {"gradient_ms": 1e3 * seconds["gradient"], "product_ms": 1e3 * seconds["product"]}


def answers(rows: list[dict[str, Any]]) -> list[str]:
    """Return one line for every homotopy."""
    return [
        f"{row['problem']}: {row['status']} after {row['gradients']} gradients, {row['rows']} rows "
        f"and {row['hessian_products']} products, {row['seconds']:.1f} s; residual "
        f"{row['stationarity']:.1e}, {row['weak_pairs']} weak pairs, {row['wrong_signs']} with a "
        "wrong sign"
        for row in rows
        if row["name"] == "homotopy" and row["stationarity"] is not None
    ]


def draw_default(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw value and gradient norm of the default problem against work and time."""
    import matplotlib.pyplot as plt

    chosen = [row for row in rows if row["problem"] == DEFAULT.name]
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
    axes[1, 0].set_xlabel("gradients + Hessian products")
    axes[1, 1].set_xlabel("seconds")
    axes[0, 0].legend(fontsize=8)
    for panel in axes.flat:
        panel.grid(alpha=0.3)
    measure.save_chart(figure, "optimizers_default", out)
    plt.close(figure)


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw the residual at which every method ends against its work, one panel per problem."""
    import matplotlib.pyplot as plt

    problems = list(dict.fromkeys(row["problem"] for row in rows))
    columns = min(3, len(problems))
    lines = -(-len(problems) // columns)
    figure, axes = plt.subplots(
        lines,
        columns,
        figsize=(4.0 * columns, 3.2 * lines),
        squeeze=False,
        sharey=True,
        layout="constrained",
    )
    names = list(dict.fromkeys(row["name"] for row in rows))
    for panel, problem in zip(axes.flat, problems, strict=False):
        best = min(row["value"] for row in rows if row["problem"] == problem)
        for row in rows:
            if row["problem"] != problem or row["stationarity"] is None:
                continue
            panel.loglog(
                work_of(row["history"])[-1],
                row["stationarity"],
                "*" if row["name"] == "homotopy" else "o",
                markersize=12 if row["name"] == "homotopy" else 7,
                color=f"C{names.index(row['name'])}",
                label=f"{row['name']} (+ {100 * (row['value'] / best - 1):.2g} %)",
            )
        panel.axhline(1e-10, color="0.7", linewidth=1.0)
        panel.set(title=problem, xlabel="gradients + Hessian products")
        panel.legend(title="and value above the best", fontsize=7, title_fontsize=7)
        panel.grid(alpha=0.3)
    for line in axes:
        line[0].set_ylabel("residual of strong stationarity")
    measure.save_chart(figure, "optimizers", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    """Run the benchmark; return its rows."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--cases", type=int, nargs="*", default=range(len(CASES)))
    options = measure.parse(arguments, argv)
    cases, methods = [CASES[k] for k in options.cases], METHODS
    if options.quick:
        cases, methods = [Case(3, steps=20)], QUICK_METHODS
    rows, times = [], {}
    for case in cases:
        problem = half_disc(case.rings, case.steps, options.dtype)
        for name, (method, by_default) in methods.items():
            iterations = case.iterations.get(name, by_default)
            if not iterations:
                continue
            row = {"name": name, "problem": case.name}
            row |= run(problem, method, iterations, case.bound)
            measure.print_table([{k: v for k, v in row.items() if k != "history"}])
            rows.append(row)
        times[case.name] = product_time(problem)
        # After every problem, so that an interrupted run leaves what it has.
        measure.save("optimizers", rows, options.out, dtype=str(options.dtype), times=times)
        jax.clear_caches()  # programs of another shape are of no use to the next problem
    draw(rows, options.out)
    draw_default(rows, options.out)
    print("\n".join(answers(rows)))
    print(times)
    return rows


if __name__ == "__main__":
    main()
