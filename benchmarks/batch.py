"""What does a scene cost in a batch?

Time per scene of `vmap` over controls, forward and with gradient, against the batch size: the
sweeps over the factor become products with (n, r) matrices that read the factor once for the batch.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from common import measure, speed_scenes

import jaxcontact as jc

SIZES = [500, 2_000, 10_000]
BATCHES = [1, 2, 4, 8, 16, 32]


def energy_like(stepper: jc.Stepper, initial: jc.State, control: jax.Array) -> jax.Array:
    """Return a scalar of one run, sum |y_k|^2 / 2."""
    trajectory = jc.simulate(stepper, control, initial=initial)
    return 0.5 * jnp.sum(trajectory.displacement**2)


def measure_size(
    n: int, batches: list[int], solver: str, steps: int, dtype: Any, repeats: int
) -> list[dict]:
    """Return one row per batch size; all sizes take turns."""
    body = speed_scenes.rectangle(n, dtype)
    stepper = speed_scenes.prepare(body, solver)
    base = body.control(steps)

    def forward(stepper: jc.Stepper, initial: jc.State, control: jax.Array) -> jc.Trajectory:
        return jc.simulate(stepper, control, initial=initial)

    runs, rows = {}, []
    for size in [0, *batches]:  # 0 is the single run, without vmap
        scales = jnp.linspace(0.5, 1.5, max(size, 1), dtype=dtype)
        control = base if size == 0 else scales[:, None, None, None] * base[None]
        programs = []
        for function in (forward, jax.value_and_grad(energy_like, argnums=2)):
            batched = function if size == 0 else jax.vmap(function, in_axes=(None, None, 0))
            program, _ = measure.compiled(batched, stepper, body.initial, control)
            programs.append(program)
        speed_scenes.check(programs[0](stepper, body.initial, control))
        for name, program in zip(("forward", "gradient"), programs, strict=True):
            runs[f"{name}{size}"] = lambda program=program, control=control: program(
                stepper, body.initial, control
            )
    seconds = measure.interleaved_seconds(runs, repeats, budget=60.0)
    for size in batches:
        row: dict[str, Any] = {**body.sizes, "batch": size, "steps": steps}
        for name in ("forward", "gradient"):
            single, together = seconds[f"{name}0"], seconds[f"{name}{size}"]
            row[f"{name}_us_per_scene"] = 1e6 * together / (size * steps)
            row[f"{name}_per_scene_over_single"] = together / (size * single)
        rows.append(row)
    return rows


def draw(rows: list[dict], out: Path) -> None:
    """Draw the time per scene over the time of a single run."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4.2))
    for n in dict.fromkeys(row["n"] for row in rows):
        mine = [row for row in rows if row["n"] == n]
        batch = [row["batch"] for row in mine]
        ratio = [row["forward_per_scene_over_single"] for row in mine]
        (line,) = axes.semilogx(batch, ratio, "o-", base=2, label=f"n = {n}")
        ratio = [row["gradient_per_scene_over_single"] for row in mine]
        axes.semilogx(batch, ratio, "s--", base=2, color=line.get_color())
    axes.plot([], [], "k--", label="with gradient")
    axes.set(xlabel="scenes in the batch", ylabel="time per scene / time of a single run")
    axes.set_ylim(bottom=0.0)
    axes.legend()
    axes.grid(alpha=0.3)
    measure.save_chart(figure, "batch", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Run the benchmark; return its rows."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--sizes", type=int, nargs="*", default=SIZES)
    arguments.add_argument("--batches", type=int, nargs="*", default=BATCHES)
    arguments.add_argument("--steps", type=int, default=50)
    arguments.add_argument("--solver", choices=speed_scenes.SOLVERS, default="dissection")
    options = measure.parse(arguments, argv)
    if options.quick:
        options.sizes, options.batches, options.steps = [100], [2], 20
    rows = []
    for n in options.sizes:
        rows += measure_size(
            n, options.batches, options.solver, options.steps, options.dtype, options.repeats
        )
        jax.clear_caches()
    measure.print_table(rows)
    measure.save("batch", rows, options.out, dtype=str(options.dtype), solver=options.solver)
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
