"""How long does it take to compile, and does it depend on the number of steps?

Time to trace and compile a run and its value with gradient, against the number of unknowns and of
steps. A new control or another material of the same mesh compiles nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from common import measure, speed_scenes

import jaxcontact as jc

SIZES = [500, 2_000, 10_000, 50_000]
STEPS = [10, 100, 1_000]


def objective(stepper: jc.Stepper, initial: jc.State, control: jax.Array) -> jax.Array:
    """Return a scalar of one run."""
    trajectory = jc.simulate(stepper, control, initial=initial)
    return 0.5 * jnp.sum(trajectory.displacement[-1] ** 2)


def measure_size(body: speed_scenes.Body, stepper: jc.Stepper, steps: int) -> dict[str, Any]:
    """Return one row; nothing runs, so that the control need not exist."""
    shape = (steps, body.system.n_nodes, body.system.dimension)
    control = jax.ShapeDtypeStruct(shape, body.system.dtype)

    def forward(stepper: jc.Stepper, initial: jc.State, control: jax.Array) -> jc.Trajectory:
        return jc.simulate(stepper, control, initial=initial)

    row: dict[str, Any] = {**body.sizes, "steps": steps}
    gradient = jax.value_and_grad(objective, argnums=2)
    for name, function in (("forward", forward), ("gradient", gradient)):
        jax.clear_caches()
        _, row[f"{name}_s"] = measure.compiled(function, stepper, body.initial, control)
    return row


def draw(rows: list[dict], out: Path) -> None:
    """Draw the compile time of value and gradient against n, one line for each T."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4.2))
    for steps in dict.fromkeys(row["steps"] for row in rows):
        mine = [row for row in rows if row["steps"] == steps]
        n = [row["n"] for row in mine]
        axes.semilogx(n, [row["gradient_s"] for row in mine], "o-", label=f"T = {steps}")
    axes.set(xlabel="unknowns", ylabel="compile time of value and gradient [s]")
    axes.set_ylim(bottom=0.0)
    axes.legend()
    axes.grid(alpha=0.3)
    measure.save_chart(figure, "compile_time", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Run the benchmark; return its rows."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--sizes", type=int, nargs="*", default=SIZES)
    arguments.add_argument("--steps", type=int, nargs="*", default=STEPS)
    arguments.add_argument("--shape", choices=speed_scenes.SHAPES, default="half_disc")
    arguments.add_argument("--solver", choices=speed_scenes.SOLVERS, default="dissection")
    options = measure.parse(arguments, argv)
    if options.quick:
        options.sizes, options.steps = [100], [10, 20]
    rows = []
    for n in options.sizes:
        body = speed_scenes.SHAPES[options.shape](n, options.dtype)
        stepper = speed_scenes.prepare(body, options.solver)
        rows += [measure_size(body, stepper, steps) for steps in options.steps]
    measure.print_table(rows)
    measure.save("compile_time", rows, options.out, shape=options.shape, solver=options.solver)
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
