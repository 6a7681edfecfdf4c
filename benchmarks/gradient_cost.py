"""What does the exact gradient cost, and what would plain autodiff cost?

Time and memory of value and gradient over those of the forward run with the same record, against n
and T: by the control and by the material (through assembly and factorisation), with and without
checkpoints. Beside them two models that are differentiated by plain autodiff, one a penalty force,
the other a fixed number of unrolled projected Gauss-Seidel sweeps; both also show how far their
gradient is from the exact one. Memory is what the compiler lays out: arguments, outputs and
temporaries.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import alternatives, measure, speed_scenes
from jax import Array

import jaxcontact as jc

SIZES = [500, 2_000, 10_000]
STEPS = [50, 200]
SWEEPS = 30


def cost(displacement: Array) -> Array:
    """Return sum |y_k|^2 / 2 of a history of displacements, the cost of all programs."""
    return 0.5 * jnp.sum(displacement**2)


def by_control(checkpoint: jc.Checkpoint | None):
    """Return (stepper, initial, control) -> cost."""

    def objective(stepper: jc.Stepper, initial: jc.State, control: Array) -> Array:
        trajectory = jc.simulate(stepper, control, initial=initial, checkpoint=checkpoint)
        return cost(trajectory.displacement)

    return objective


def by_material(body: speed_scenes.Body, solver: str, steps: int, checkpoint: jc.Checkpoint | None):
    """Return (initial, material) -> cost, with assembly and factorisation inside."""

    def objective(initial: jc.State, material: jc.KelvinVoigt) -> Array:
        scene = jc.Scene(
            body.scene.mesh, material, contact=body.scene.contact, body_force=body.scene.body_force
        )
        system = jc.discretize(scene, dtype=body.system.dtype)
        stepper = jc.prepare(system, body.dt, linear_solver=speed_scenes.SOLVERS[solver])
        trajectory = jc.simulate(stepper, steps=steps, initial=initial, checkpoint=checkpoint)
        return cost(trajectory.displacement)

    return objective


def programs(
    body: speed_scenes.Body, stepper: jc.Stepper, solver: str, steps: int
) -> dict[str, tuple]:
    """Return the objectives with their arguments; the last argument is differentiated."""
    control = body.control(steps)
    arguments = (stepper, body.initial, control)
    split = jc.Checkpoint()
    material = (body.initial, body.scene.material)
    return {
        "control": (by_control(None), arguments),
        "control, checkpoint": (by_control(split), arguments),
        "material": (by_material(body, solver, steps, None), material),
        "material, checkpoint": (by_material(body, solver, steps, split), material),
        "penalty, autodiff": (
            lambda s, i, u: cost(alternatives.penalty(s, i, u)),
            arguments,
        ),
        "unrolled Gauss-Seidel, autodiff": (
            lambda s, i, u: cost(alternatives.unrolled_gauss_seidel(s, i, u, SWEEPS)),
            arguments,
        ),
    }


def measure_size(
    n: int, steps: int, kinds: list[str], solver: str, dtype: Any, repeats: int
) -> list[dict]:
    """Return one row per kind of gradient."""
    body = speed_scenes.half_disc(n, dtype)
    stepper = speed_scenes.prepare(body, solver)
    contact = speed_scenes.check(jc.simulate(stepper, body.control(steps), initial=body.initial))
    runs, rows, exact = {}, [], None
    for name, (objective, arguments) in programs(body, stepper, solver, steps).items():
        if name not in kinds:
            continue
        forward, _ = measure.compiled(objective, *arguments)
        gradient, compile_s = measure.compiled(
            jax.value_and_grad(objective, argnums=len(arguments) - 1), *arguments
        )
        row: dict[str, Any] = {"kind": name, **body.sizes, "steps": steps, "compile_s": compile_s}
        for key, program in (("forward", forward), ("gradient", gradient)):
            row |= {f"{key}_{part}": size for part, size in measure.memory(program).items()}
            runs[f"{name}/{key}"] = lambda program=program, arguments=arguments: program(*arguments)
        if arguments[-1] is not body.scene.material:
            derivative = np.asarray(gradient(*arguments)[1])
            exact = derivative if name == "control" else exact
            if exact is not None:
                difference = np.linalg.norm(derivative - exact)
                row["gradient_error"] = float(difference / np.linalg.norm(exact))
        rows.append(row | contact)
    seconds = measure.interleaved_seconds(runs, repeats, budget=60.0)
    for row in rows:
        for key in ("forward", "gradient"):
            row[f"{key}_ms"] = 1e3 * seconds[f"{row['kind']}/{key}"]
            parts = ("argument", "output", "temporary")
            row[f"{key}_MB"] = sum(row[f"{key}_{part}_bytes"] for part in parts) / 1e6
        row["time_ratio"] = row["gradient_ms"] / row["forward_ms"]
        row["memory_ratio"] = row["gradient_MB"] / row["forward_MB"]
    return rows


KINDS = [
    "control",
    "control, checkpoint",
    "material",
    "material, checkpoint",
    "penalty, autodiff",
    "unrolled Gauss-Seidel, autodiff",
]
COLUMNS = ["kind", "n", "steps", "forward_ms", "gradient_ms", "time_ratio", "forward_MB"]
COLUMNS += ["gradient_MB", "memory_ratio", "gradient_error"]


def draw(rows: list[dict], out: Path) -> None:
    """Draw the ratios of time and the memory of value and gradient against n, largest T."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2))
    longest = max(row["steps"] for row in rows)
    for kind in dict.fromkeys(row["kind"] for row in rows):
        mine = [row for row in rows if row["kind"] == kind and row["steps"] == longest]
        n = [row["n"] for row in mine]
        left.semilogx(n, [row["time_ratio"] for row in mine], "o-", label=kind)
        right.loglog(n, [row["gradient_MB"] for row in mine], "o-", label=kind)
    left.set(xlabel="unknowns", ylabel="time of value and gradient / forward")
    left.set_ylim(bottom=0.0)
    right.set(xlabel="unknowns", ylabel=f"memory of value and gradient, T = {longest} [MB]")
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    measure.save_chart(figure, "gradient_cost", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Run the benchmark; return its rows."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--sizes", type=int, nargs="*", default=SIZES)
    arguments.add_argument("--steps", type=int, nargs="*", default=STEPS)
    arguments.add_argument("--kinds", nargs="*", choices=KINDS, default=KINDS)
    arguments.add_argument("--solver", choices=speed_scenes.SOLVERS, default="dissection")
    options = measure.parse(arguments, argv)
    if options.quick:
        options.sizes, options.steps, options.solver = [60], [16], "dense"
        options.kinds = ["control", "material, checkpoint", *KINDS[-2:]]
    rows = []
    for n in options.sizes:
        for steps in options.steps:
            new = measure_size(
                n, steps, options.kinds, options.solver, options.dtype, options.repeats
            )
            measure.print_table([{name: row.get(name) for name in COLUMNS} for row in new])
            rows += new
            jax.clear_caches()
    measure.save("gradient_cost", rows, options.out, solver=options.solver, sweeps=SWEEPS)
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
