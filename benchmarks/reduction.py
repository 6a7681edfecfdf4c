"""What does a reduced model cost, and how wrong is it?

The half disc of the paper under two loads, see `common/controlled_bodies.py`, and a half ball in
three dimensions, where modes buy much less. The parts of the record, each under three minutes:

errors        against the full model on the same mesh and step: displacement (largest L2 norm over
              time), accumulated impulse, force of each step (sum of absolute values over the
              impulse), gradient of the tracking cost (L2, without the control's own part)
times         of the full model over the reduced one: forward, value and gradient, with the control
              on all nodes or in unknowns; of a step whose contact set is out of reach over one
              without contact
optimisation  time of a whole one, and the full cost at the minimiser of the reduced model
batch         time per scene of 256 controls over that of one, by vmap, and in chunks on all cores
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import measure
from common.controlled_bodies import (
    DT,
    SCALE,
    Body,
    half_disc,
    make_body,
    motion_gradient,
    objective,
    smooth,
    tracking,
    value_and_grad,
)
from jax.sharding import NamedSharding, PartitionSpec
from jax.tree_util import Partial

import jaxcontact as jc
from jaxcontact.control.inner_product import nodal_norms

#: Scenes of a batch that one core computes at once: their states stay in its cache.
CHUNK = 32


def half_ball(rings: int, steps: int, dtype: Any) -> Body:
    """Return a half ball of the same radius and material."""
    floor = jc.HalfSpace(np.array([0.0, 0.0, -15.8]), np.array([0.0, 0.0, 1.0]))
    scene = jc.Scene(
        mesh=jc.meshes.half_ball(15.0, h=15.0 / rings),
        material=jc.scenes.half_disc(h=7.5).material,
        clamped=("clamped",),
        contact={"contact": floor},
    )
    return make_body("half ball", scene, steps, dtype)


def errors(body: Body, load: str, reduced: jc.System) -> dict[str, float]:
    """Return the errors of a reduced system under a load."""
    u, full = body.loads[load], body.stepper.system
    stepper = jc.prepare(reduced, DT)
    found, exact = jc.simulate(stepper, SCALE * u), jc.simulate(body.stepper, SCALE * u)
    norms = partial(nodal_norms, full.nodal_mass)
    squares = [norms(x) for x in (found.displacement - exact.displacement, exact.displacement)]
    forces = [jnp.sum(x.contact_impulse, axis=1) for x in (found, exact)]
    gradients = [motion_gradient(x, body.cost, u) for x in (stepper, body.stepper)]
    riesz = [jc.l2_value_and_grad(lambda u, g=g: jnp.vdot(g, u), full, DT)(u)[1] for g in gradients]
    lengths = [jnp.sum(norms(x)) for x in (riesz[0] - riesz[1], riesz[1])]
    impulse = jnp.sum(forces[1])
    return {
        f"displacement_{load}": float(jnp.sqrt(jnp.max(squares[0]) / jnp.max(squares[1]))),
        f"impulse_{load}": float(jnp.max(jnp.abs(jnp.cumsum(forces[0] - forces[1]))) / impulse),
        f"force_{load}": float(jnp.sum(jnp.abs(forces[0] - forces[1])) / impulse),
        f"gradient_{load}": float(jnp.sqrt(lengths[0] / lengths[1])),
    }


def bases(body: Body, modes: int) -> dict[str, jc.System]:
    """Return the reduced systems of a number of modes."""
    system, pattern = body.stepper.system, body.loads["A"][0]
    return {
        "contact": jc.reduce(system, modes),
        "contact, load": jc.reduce(system, modes, loads=[pattern]),
        "contact, load, step": jc.reduce(system, modes, loads=[pattern], step_responses=DT),
    }


def measure_errors(options: Any) -> list[dict]:
    """Return one row per body, basis and number of modes."""
    ball = 3 if options.quick else 5
    bodies = [
        (half_disc(options.rings[0], options.steps, options.dtype), options.modes),
        (half_ball(ball, options.steps, options.dtype), options.modes[:2]),
    ]
    rows = []
    for body, modes in bodies:
        for count in modes:
            for name, reduced in bases(body, count).items():
                row = {"body": body.name, "n": body.stepper.system.size, "basis": name}
                row |= {"modes": count, "unknowns": reduced.size}
                for load in body.loads:
                    row |= errors(body, load, reduced)
                rows.append(row)
                print(f"measured {body.name}, {name}, {count} modes")
    return rows


def measure_times(options: Any) -> list[dict]:
    """Return one row per mesh and number of modes."""
    rows = []
    for rings in options.rings:
        body = half_disc(rings, options.steps, options.dtype)
        system, u = body.stepper.system, body.loads["A"]
        forward = jax.jit(lambda stepper, u: jc.simulate(stepper, SCALE * u).unknowns)
        runs: dict[str, Callable[[], Any]] = {
            "full": lambda body=body, u=u: value_and_grad(body.stepper, body.cost, u),
            "forward": lambda body=body, u=u, forward=forward: forward(body.stepper, u),
        }
        for count in options.timed_modes:
            reduced = jc.reduce(system, count, loads=[u[0]])
            stepper, cost = jc.prepare(reduced, DT), tracking(reduced, body.target)
            c = reduced.restrict_control(u)
            runs |= {
                f"nodal{count}": partial(value_and_grad, stepper, cost, u),
                f"full{count}": partial(value_and_grad, stepper, cost, c),
                f"forward{count}": partial(forward, stepper, c),
            }
            rows.append({"n": system.size, "modes": count, "unknowns": reduced.size})
        seconds = measure.interleaved_seconds(runs, options.repeats)
        for row in rows[-len(options.timed_modes) :]:
            count = row["modes"]
            row |= {
                "full_gradient_ms": 1e3 * seconds["full"],
                "full_forward_ms": 1e3 * seconds["forward"],
                "gradient_ms": 1e3 * seconds[f"full{count}"],
                "forward_ms": 1e3 * seconds[f"forward{count}"],
                "gradient_speedup": seconds["full"] / seconds[f"full{count}"],
                "gradient_speedup_nodal": seconds["full"] / seconds[f"nodal{count}"],
                "forward_speedup": seconds["forward"] / seconds[f"forward{count}"],
            }
    rows[0] |= out_of_reach(options)
    return rows


def out_of_reach(options: Any) -> dict[str, float]:
    """Return the time of a step with a contact set out of reach over that without one."""
    scene = jc.scenes.half_disc(h=15.0 / options.rings[0])
    without = jc.discretize(replace(scene, contact={}), dtype=options.dtype)
    far = jc.discretize(scene, dtype=options.dtype).with_pairs([])
    load = jnp.asarray(smooth(without, options.steps), options.dtype)
    run = jax.jit(lambda stepper, u: jc.simulate(stepper, u).unknowns)
    runs = {
        name: partial(run, jc.prepare(system, DT), load)
        for name, system in (("far", far), ("without", without))
    }
    seconds = measure.interleaved_seconds(runs, 4 * options.repeats)
    return {"out_of_reach_over_without": seconds["far"] / seconds["without"]}


def measure_optimisation(options: Any) -> list[dict]:
    """Return the full cost at the minimisers of both models, and the ratio of their times."""
    body = half_disc(options.rings[0], options.steps, options.dtype)
    u = jnp.zeros_like(body.loads["A"])
    reduced = jc.reduce(body.stepper.system, options.timed_modes[0], loads=[body.loads["A"][0]])
    c = jnp.zeros((len(u), reduced.size), u.dtype)
    full = Partial(objective, body.stepper, body.cost)
    small = Partial(objective, jc.prepare(reduced, DT), tracking(reduced, body.target))
    found = {}
    for name, function, start, system in (
        ("full", full, u, body.stepper.system),
        ("reduced", small, c, reduced),
    ):
        choices = {"system": system, "dt": DT}
        jc.optimize(function, start, iterations=2, **choices)
        found[name] = jc.optimize(function, start, iterations=options.iterations, **choices)
    spent = {name: result.history.seconds[-1] for name, result in found.items()}
    row = {
        "n": body.stepper.system.size,
        "unknowns": reduced.size,
        "value_full": found["full"].value,
        "value_reduced": found["reduced"].value,
        "full_value_at_reduced": float(full(reduced.lift(found["reduced"].control))),
        "optimisation_s": spent["reduced"],
        "optimisation_speedup": spent["full"] / spent["reduced"],
    }
    return [row]


def pairs_in_reach(body: Body) -> np.ndarray:
    """Return the pairs that touch under the load A, with their neighbours, (C,) bool."""
    motion = jc.simulate(body.stepper, SCALE * body.loads["A"])
    is_closed = np.any(np.asarray(motion.active), axis=0)
    places = np.asarray(body.stepper.system.points)[body.stepper.system.contact_nodes]
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    reach = 1.5 * np.max(np.sort(distance, axis=1)[:, 1])
    return np.any(distance[:, is_closed] < reach, axis=1)


def measure_batch(options: Any) -> list[dict]:
    """Return the time per scene of a batch over that of a single one; all pairs, those in reach."""
    body = half_disc(options.rings[0], options.steps, options.dtype)
    cores = jax.make_mesh((jax.device_count(),), ("scene",))
    all_of, along = PartitionSpec(), PartitionSpec("scene")
    programs = {"forward": lambda s, cost, c: jc.simulate(s, SCALE * c).unknowns[-1]}
    programs["gradient"] = jax.value_and_grad(objective, argnums=2)
    rows = []
    for pairs in (None, pairs_in_reach(body)):
        load = [body.loads["A"][0]]
        reduced = jc.reduce(body.stepper.system, options.timed_modes[-1], loads=load, pairs=pairs)
        stepper, cost = jc.prepare(reduced, DT), tracking(reduced, body.target)
        c = reduced.restrict_control(body.loads["A"])
        many = jnp.linspace(0.5, 1.5, options.batch, dtype=c.dtype)[:, None, None] * c[None]
        parted = jax.device_put(many, NamedSharding(cores, along))
        row: dict[str, Any] = {"batch": options.batch, "cores": jax.device_count()}
        row |= {"unknowns": reduced.size, "pairs": reduced.normals.count}
        for name, program in programs.items():

            def chunks(stepper, cost, controls, program=program):
                return jax.lax.map(partial(program, stepper, cost), controls, batch_size=CHUNK)

            spread = jax.shard_map(
                chunks,
                mesh=cores,
                in_specs=(all_of, all_of, along),
                out_specs=along,
                check_vma=False,
            )
            runs = {
                "single": partial(jax.jit(program), stepper, cost, c),
                "vmap": partial(jax.jit(jax.vmap(program, (None, None, 0))), stepper, cost, many),
                "spread": partial(jax.jit(spread), stepper, cost, parted),
            }
            seconds = measure.interleaved_seconds(runs, options.repeats)
            for way in ("vmap", "spread"):
                row[f"{name}_{way}"] = seconds[way] / (options.batch * seconds["single"])
        rows.append(row)
    return rows


PARTS = {
    "errors": measure_errors,
    "times": measure_times,
    "optimisation": measure_optimisation,
    "batch": measure_batch,
}


def draw(rows: list[dict], out: Path) -> None:
    """Draw the errors against the unknowns."""
    import matplotlib.pyplot as plt

    rows = [row for row in rows if row["part"] == "errors"]
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained", sharex=True)
    for body in dict.fromkeys(row["body"] for row in rows):
        for number, basis in enumerate(dict.fromkeys(row["basis"] for row in rows)):
            mine = [row for row in rows if row["body"] == body and row["basis"] == basis]
            style = {"marker": "o", "color": f"C{number}", "label": f"{body}, {basis}"}
            style["ls"] = "-" if "disc" in body else ":"
            for axis, name in zip(axes, ("displacement", "force", "gradient"), strict=True):
                x, y = ([row[key] for row in mine] for key in ("unknowns", f"{name}_A"))
                axis.loglog(x, y, **style)
                axis.set(xlabel="unknowns", title=f"error of the {name}")
                axis.set_ylabel("relative error")
    for axis in axes:
        axis.set_xticks([30, 50, 100, 200], ["30", "50", "100", "200"])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=7)
    measure.save_chart(figure, "reduction", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw; parts that are not named keep the rows of an earlier record."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--parts", nargs="*", choices=list(PARTS), default=list(PARTS))
    arguments.add_argument("--rings", type=int, nargs="*", default=[24, 64])
    arguments.add_argument("--modes", type=int, nargs="*", default=[15, 35, 75, 150])
    arguments.add_argument("--timed-modes", type=int, nargs="*", default=[35, 75])
    arguments.add_argument("--iterations", type=int, default=150, help="of the optimisations")
    arguments.add_argument("--batch", type=int, default=256)
    options = measure.parse(arguments, argv)
    options.steps = 75 if options.quick else 150
    if options.quick:
        options.rings, options.modes, options.timed_modes = [8], [10], [10]
        options.iterations, options.batch = 3, 4 * jax.device_count()
    record = Path(options.out) / "reduction.json"
    rows = json.loads(record.read_text())["rows"] if record.exists() else []
    for part in options.parts:
        found = [{"part": part} | row for row in PARTS[part](options)]
        measure.print_table(found)
        rows = [row for row in rows if row["part"] != part] + found
        jax.clear_caches()
    measure.save("reduction", rows, options.out, dtype=str(options.dtype))
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    # One device for each core, for the batch; before JAX starts.
    jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    main()
