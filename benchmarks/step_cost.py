"""How much does a contact step cost, and how far is it from the memory limit?

Times a full contact step (forward, inside one compiled scan) against the number of unknowns, with
the motion recorded after every step and with the last state alone (`save_every`). The
limit is the time to read the nonzeros of the Cholesky factor twice, once for the sweep up and once
for the sweep down, without padding: two dot products of a buffer of that size, in turns with the
steps of the same run and on the same device. Conjugate gradients have no factor and no limit. The
peak memory is that of the process so far: start anew for every figure that is to be quoted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import measure, speed_scenes

import jaxcontact as jc
from jaxcontact.linear.dissection import plan as dissection_plan
from jaxcontact.linear.dissection.nested_dissection import NestedDissection
from jaxcontact.system.sparse import unknown_columns

SIZES_2D = [500, 2_000, 10_000, 50_000, 200_000]
SIZES_3D = [3_000, 20_000, 80_000]


def factor_entries(body: speed_scenes.Body) -> int:
    """Return the number of nonzeros of the Cholesky factor, sum of s (s + 1) / 2 + s b."""
    system = body.system
    coordinates = np.repeat(
        np.asarray(system.points)[system.free_nodes], system.dimension, axis=0
    ).astype(float)
    plan = dissection_plan.plan_for(
        unknown_columns(system.stiffness.columns, system.size),
        system.normals.unknowns,
        coordinates,
        NestedDissection().leaf_size,
    )
    return plan.n_factor_entries


def reader(entries: int, times: int, dtype: Any) -> Callable[[], Any]:
    """Return a function that reads so many numbers so many times, by dot products."""
    if jax.default_backend() == "cpu":
        buffer = np.ones(entries, dtype)

        def stream() -> None:
            for _ in range(times):
                np.dot(buffer, buffer)

        return stream

    @jax.jit
    def read(numbers: jax.Array) -> jax.Array:
        def read_once(_: int, total: jax.Array) -> jax.Array:
            return total + jnp.sum(numbers * (numbers + total))  # without total only read once

        return jax.lax.fori_loop(0, times, read_once, jnp.zeros((), dtype))

    return partial(read, jnp.ones(entries, dtype))


def measure_step(shape: str, n: int, solver: str, steps: int, dtype: Any, repeats: int) -> dict:
    """Return one row: a body of a shape with about n unknowns."""
    body = speed_scenes.SHAPES[shape](n, dtype)
    start = time.perf_counter()
    stepper = jax.block_until_ready(speed_scenes.prepare(body, solver))
    prepare_s = time.perf_counter() - start
    start = time.perf_counter()
    jax.block_until_ready(speed_scenes.prepare(body, solver))
    prepare_again_s = time.perf_counter() - start

    def run(stepper: jc.Stepper, initial: jc.State) -> jc.Trajectory:
        return jc.simulate(stepper, steps=steps, initial=initial)

    def run_bare(stepper: jc.Stepper, initial: jc.State) -> jc.Trajectory:
        return jc.simulate(stepper, steps=steps, initial=initial, save_every=steps)

    program, compile_s = measure.compiled(run, stepper, body.initial)
    bare, _ = measure.compiled(run_bare, stepper, body.initial)
    contact = speed_scenes.check(program(stepper, body.initial))
    entries = factor_entries(body) if solver != "cg" else 0
    stream = reader(entries, 2 * steps, dtype)
    runs = {
        "step": lambda: program(stepper, body.initial),
        "bare": lambda: bare(stepper, body.initial),
    } | ({"limit": stream} if entries else {})
    seconds = measure.interleaved_seconds(runs, repeats)
    limit = seconds.get("limit")
    return {
        "shape": shape,
        **body.sizes,
        "factor_entries": entries,
        "step_us": 1e6 * seconds["step"] / steps,
        "bare_us": 1e6 * seconds["bare"] / steps,
        "limit_us": limit and 1e6 * limit / steps,
        "step_over_limit": limit and seconds["step"] / limit,
        "bare_over_limit": limit and seconds["bare"] / limit,
        "prepare_s": prepare_s,
        "prepare_again_s": prepare_again_s,
        "compile_s": compile_s,
        "peak_MB": measure.peak_memory(),
        "steps": steps,
        **contact,
    }


def growth_exponents(rows: list[dict], smallest: int) -> dict[str, float]:
    """Fit step time ~ n^p to the rows with n >= smallest, for each shape."""
    exponents = {}
    for shape in dict.fromkeys(row["shape"] for row in rows):
        points = [
            (row["n"], row["step_us"])
            for row in rows
            if row["shape"] == shape and row["n"] >= smallest
        ]
        if len(points) > 1:
            n, t = np.log(np.array(points)).T
            exponents[shape] = float(np.polyfit(n, t, 1)[0])
    return exponents


def draw(rows: list[dict], out: Path) -> None:
    """Draw step, with and without the record of the motion, and limit against n."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4.2))
    for shape in dict.fromkeys(row["shape"] for row in rows):
        mine = [row for row in rows if row["shape"] == shape]
        n = [row["n"] for row in mine]
        (line,) = axes.loglog(n, [row["step_us"] for row in mine], "o-", label=shape)
        for key, style in (("bare_us", "--"), ("limit_us", ":")):
            axes.loglog(n, [row[key] for row in mine], style, color=line.get_color())
    axes.plot([], [], "k--", label="recording the last state only")
    axes.plot([], [], "k:", label="read the factor twice")
    axes.set(xlabel="unknowns", ylabel="time of a contact step [µs]")
    axes.legend()
    axes.grid(alpha=0.3)
    measure.save_chart(figure, "step_cost", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Run the benchmark; return its rows."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--sizes-2d", type=int, nargs="*", default=SIZES_2D)
    arguments.add_argument("--sizes-3d", type=int, nargs="*", default=SIZES_3D)
    arguments.add_argument("--shapes", nargs="*", default=list(speed_scenes.SHAPES))
    arguments.add_argument("--solver", choices=speed_scenes.SOLVERS, default="dissection")
    arguments.add_argument("--fit-from", type=int, default=9_000, help="smallest n of the fit")
    options = measure.parse(arguments, argv)
    if options.quick:
        options.shapes, options.sizes_2d = ["delaunay"], [80, 150]
    rows = []
    for shape in options.shapes:
        for n in options.sizes_3d if shape == "box" else options.sizes_2d:
            # About as long for every size; at least 20 steps, so that contact is closed.
            steps = 20 if options.quick else int(np.clip(2_000_000 // n, 20, 500))
            row = measure_step(shape, n, options.solver, steps, options.dtype, options.repeats)
            measure.print_table([row])
            rows.append(row)
            jax.clear_caches()
    exponents = growth_exponents(rows, 0 if options.quick else options.fit_from)
    print("growth exponents:", {shape: round(p, 3) for shape, p in exponents.items()})
    measure.save(
        "step_cost",
        rows,
        options.out,
        dtype=str(options.dtype),
        solver=options.solver,
        exponents=exponents,
    )
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
