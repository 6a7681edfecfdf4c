"""What does a reduced model cost, and how wrong is it?

The half disc of the paper under two loads: A, 0.7 times the uniform reference control, and B,
smooth in space and time, not symmetric and stronger; and a half ball in three dimensions, where
modes buy much less. Errors are those against the full model on the same mesh and step: of the
displacement (largest L2 norm over time), of the accumulated impulse, of the force of each step
(sum of absolute values over the impulse) and of the gradient of the tracking cost (L2, without
the control's own part). Times: forward, value and gradient with the control on all nodes or in
unknowns, a whole optimisation with the full cost at its minimiser, and a batch.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import measure
from jax.tree_util import Partial

import jaxcontact as jc
from jaxcontact.control.inner_product import nodal_norms

SCALE, WEIGHT, FINAL, DT = 1e6, 1e-2, 7.5e-4, 5e-5


class Body(NamedTuple):
    """A full model with its problem."""

    name: str
    stepper: jc.Stepper
    cost: jc.TrackingCost
    target: jax.Array
    loads: dict[str, jax.Array]
    """Controls before scaling, (T, N, d)."""


def make_body(name: str, scene: jc.Scene, steps: int, dtype: Any) -> Body:
    """Return the full model and the two loads."""
    system = jc.discretize(scene, dtype=dtype)
    stepper = jc.prepare(system, DT)
    down = np.broadcast_to(-np.eye(system.dimension)[-1], (steps, *system.points.shape))
    reference = jnp.asarray(down, dtype)
    loads = {"A": 0.7 * reference, "B": jnp.asarray(smooth(system, steps), dtype)}
    target = jc.simulate(stepper, SCALE * reference).displacement
    return Body(name, stepper, tracking(system, target), target, loads)


def tracking(system: jc.System, target: jax.Array) -> jc.TrackingCost:
    """Return the paper's cost."""
    return jc.TrackingCost(system, dt=DT, target=target, control_weight=WEIGHT, final_weight=FINAL)


def smooth(system: jc.System, steps: int, n_waves: int = 4) -> np.ndarray:
    """Return a control that is smooth in space and time, (T, N, d), about one downwards."""
    rng = np.random.default_rng(0)
    x = np.asarray(system.points) / np.max(np.abs(system.points))
    time = np.arange(steps) / steps
    d = system.dimension
    control = np.zeros((steps, *x.shape))
    for _ in range(n_waves):
        place = np.cos(x @ rng.normal(size=d) * 3.0 + rng.uniform(0.0, 6.0))
        course = np.cos(2.0 * np.pi * rng.uniform(0.0, 2.0) * time + rng.uniform(0.0, 6.0))
        control += course[:, None, None] * place[None, :, None] * rng.normal(size=d)
    control[..., -1] -= 2.0
    return control


def objective(stepper: jc.Stepper, cost: jc.TrackingCost, u: jax.Array) -> jax.Array:
    """Return the cost of a control (T, N, d) or (T, n), before scaling."""
    return cost(jc.simulate(stepper, SCALE * u), u)


def motion_part(stepper: jc.Stepper, cost: jc.TrackingCost, u: jax.Array) -> jax.Array:
    """Return the cost without the control's own part."""
    return cost(jc.simulate(stepper, SCALE * u))


value_and_grad = jax.jit(jax.value_and_grad(objective, argnums=2))
motion_gradient = jax.jit(jax.grad(motion_part, argnums=2))


def errors(body: Body, load: str, system: jc.System) -> dict[str, float]:
    """Return the errors of a reduced system under a load."""
    u, full = body.loads[load], body.stepper.system
    stepper = jc.prepare(system, DT)
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


def times(body: Body, reduced: jc.System, repeats: int) -> dict[str, float]:
    """Return times of the full model over those of a reduced one."""
    u = body.loads["A"]
    c = reduced.restrict_control(u)
    stepper, cost = jc.prepare(reduced, DT), tracking(reduced, body.target)
    forward = jax.jit(lambda stepper, u: jc.simulate(stepper, SCALE * u).unknowns)
    runs: dict[str, Callable[[], Any]] = {
        "full": lambda: value_and_grad(body.stepper, body.cost, u),
        "nodal": lambda: value_and_grad(stepper, cost, u),
        "reduced": lambda: value_and_grad(stepper, cost, c),
        "full_forward": lambda: forward(body.stepper, u),
        "reduced_forward": lambda: forward(stepper, c),
    }
    seconds = measure.interleaved_seconds(runs, repeats)
    return {
        "full_gradient_ms": 1e3 * seconds["full"],
        "reduced_gradient_ms": 1e3 * seconds["reduced"],
        "reduced_forward_ms": 1e3 * seconds["reduced_forward"],
        "gradient_speedup_nodal": seconds["full"] / seconds["nodal"],
        "gradient_speedup": seconds["full"] / seconds["reduced"],
        "forward_speedup": seconds["full_forward"] / seconds["reduced_forward"],
    }


def pairs_in_reach(body: Body) -> np.ndarray:
    """Return the pairs that touch under the load A, with their neighbours, (C,) bool."""
    motion = jc.simulate(body.stepper, SCALE * body.loads["A"])
    is_closed = np.any(np.asarray(motion.active), axis=0)
    places = np.asarray(body.stepper.system.points)[body.stepper.system.contact_nodes]
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    reach = 1.5 * np.max(np.sort(distance, axis=1)[:, 1])
    return np.any(distance[:, is_closed] < reach, axis=1)


def batch(body: Body, reduced: jc.System, size: int, repeats: int) -> float:
    """Return the time per scene of a batch of controls over that of a single scene."""
    stepper, cost = jc.prepare(reduced, DT), tracking(reduced, body.target)
    c = reduced.restrict_control(body.loads["A"])
    many = jnp.linspace(0.5, 1.5, size, dtype=c.dtype)[:, None, None] * c[None]
    batched = jax.jit(jax.vmap(jax.value_and_grad(objective, argnums=2), in_axes=(None, None, 0)))
    seconds = measure.interleaved_seconds(
        {
            "single": lambda: value_and_grad(stepper, cost, c),
            "batch": lambda: batched(stepper, cost, many),
        },
        repeats,
    )
    return seconds["batch"] / (size * seconds["single"])


def optimisation(body: Body, reduced: jc.System, iterations: int) -> dict[str, float]:
    """Return the full cost at the minimisers of both models, and the ratio of their times."""
    u = jnp.zeros_like(body.loads["A"])
    c = jnp.zeros((len(u), reduced.size), u.dtype)
    stepper, cost = jc.prepare(reduced, DT), tracking(reduced, body.target)
    full = Partial(objective, body.stepper, body.cost)
    small = Partial(objective, stepper, cost)
    found = {}
    for name, function, start, system in (
        ("full", full, u, body.stepper.system),
        ("reduced", small, c, reduced),
    ):
        options = {"system": system, "dt": DT}
        jc.optimize(function, start, iterations=2, **options)
        found[name] = jc.optimize(function, start, iterations=iterations, **options)
    at_reduced = float(full(reduced.lift(found["reduced"].control)))
    spent = {name: result.history.seconds[-1] for name, result in found.items()}
    return {
        "value_full": found["full"].value,
        "value_reduced": found["reduced"].value,
        "full_value_at_reduced": at_reduced,
        "optimisation_s": spent["reduced"],
        "optimisation_speedup": spent["full"] / spent["reduced"],
    }


def measure_body(body: Body, modes: list[int], options: Any, iterations: int, size: int) -> list:
    """Return one row per basis and number of modes."""
    rows = []
    for count in modes:
        for name, reduced in bases(body, count).items():
            row = {"body": body.name, "n": body.stepper.system.size, "basis": name}
            row |= {"modes": count, "unknowns": reduced.size}
            for load in body.loads:
                row |= errors(body, load, reduced)
            rows.append(row | times(body, reduced, options.repeats))
            print(f"measured {body.name}, {name}, {count} modes")
    if iterations:
        rows[-1] |= optimisation(body, reduced, iterations)
    if size:
        pruned = jc.reduce(
            body.stepper.system,
            modes[0],
            loads=[body.loads["A"][0]],
            pairs=pairs_in_reach(body),
        )
        rows[-1] |= {
            "batch": size,
            "batch_per_scene": batch(body, reduced, size, options.repeats),
            "batch_per_scene_pruned": batch(body, pruned, size, options.repeats),
        }
    return rows


def draw(rows: list[dict], out: Path) -> None:
    """Draw the errors against the unknowns, and against the time of value and gradient."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for body in dict.fromkeys(row["body"] for row in rows):
        for number, basis in enumerate(dict.fromkeys(row["basis"] for row in rows)):
            mine = [row for row in rows if row["body"] == body and row["basis"] == basis]
            style = {"marker": "o", "color": f"C{number}", "label": f"{body}, {basis}"}
            style["ls"] = "-" if "disc" in body else ":"
            for axis, x, y in (
                (axes[0], "unknowns", "displacement_A"),
                (axes[1], "unknowns", "force_A"),
                (axes[2], "reduced_gradient_ms", "displacement_A"),
            ):
                axis.loglog([row[x] for row in mine], [row[y] for row in mine], **style)
    for axis, x, y in (
        (axes[0], "unknowns", "error of the displacement"),
        (axes[1], "unknowns", "error of the force of a step"),
        (axes[2], "value and gradient [ms]", "error of the displacement"),
    ):
        axis.set(xlabel=x, ylabel=y)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=7)
    measure.save_chart(figure, "reduction", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--rings", type=int, nargs="*", default=[24, 64])
    arguments.add_argument("--modes", type=int, nargs="*", default=[15, 35, 75, 150])
    arguments.add_argument("--iterations", type=int, default=150, help="of the optimisations")
    arguments.add_argument("--batch", type=int, default=256)
    options = measure.parse(arguments, argv)
    steps = 20 if options.quick else 150
    if options.quick:
        options.rings, options.modes, options.iterations, options.batch = [8], [10], 3, 4
    rows = []
    for m in options.rings:
        body = make_body("half disc", jc.scenes.half_disc(h=15.0 / m), steps, options.dtype)
        # A full optimisation of the finest mesh takes minutes.
        is_first = m == options.rings[0]
        iterations = options.iterations if is_first else 0
        rows += measure_body(body, options.modes, options, iterations, options.batch * is_first)
    ball = jc.meshes.half_ball(15.0, h=15.0 / (3 if options.quick else 5))
    scene = jc.scenes.half_disc(h=7.5)
    scene = jc.Scene(
        mesh=ball,
        material=scene.material,
        clamped=("clamped",),
        contact={"contact": jc.HalfSpace(np.array([0.0, 0.0, -15.8]), np.array([0.0, 0.0, 1.0]))},
    )
    body = make_body("half ball", scene, steps, options.dtype)
    rows += measure_body(body, options.modes[:3], options, 0, 0)
    measure.print_table(rows)
    measure.save("reduction", rows, options.out, dtype=str(options.dtype))
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
