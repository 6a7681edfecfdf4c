"""How fast is an accurate gradient: a finer mesh, or a reduced model of a fine one?

The half disc that is pressed on a plane: error of the displacement against a fine run, relative,
over the nodes and the time, against the time of value and gradient of the mean displacement. The
time step is halved with the mesh size; the reduced models are those of the finest mesh, with its
time step.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
from common import half_disc_runs, measure

import jaxcontact as jc


@jax.jit
def mean_functional(system: jc.System) -> jax.Array:
    """Return the unknowns' weights (n,) in the mean vertical displacement."""
    density = jnp.zeros_like(system.points).at[:, -1].set(1.0)
    return system.control_load(density) / jnp.sum(system.nodal_mass @ density)


def mean_height(
    stepper: jc.Stepper, functional: jax.Array, push: jax.Array, steps: int
) -> jax.Array:
    """Return the mean vertical displacement over body and time under a factor of the load."""
    system = dataclasses.replace(stepper.system, load=push * stepper.system.load)
    motion = jc.simulate(dataclasses.replace(stepper, system=system), steps=steps)
    return jnp.mean(motion.unknowns @ functional)


value_and_grad = jax.jit(jax.value_and_grad(mean_height, argnums=2), static_argnums=3)


def measure_models(
    rings: list[int], steps: int, modes: list[int], fine: half_disc_runs.Reference, repeats: int
) -> list[dict]:
    """Return one row per full model, `steps` steps on the coarsest mesh, and per reduced one."""
    models = []
    for m in rings:
        count = steps * m // rings[0]
        stepper = half_disc_runs.prepare(m, half_disc_runs.DURATION / count, jc.ContactImplicit())
        models.append(("full", m, stepper, count))
    for count_modes in modes:
        reduced = jc.prepare(jc.reduce(stepper.system, count_modes), stepper.dt)
        models.append(("reduced", m, reduced, count))
    rows, runs = [], {}
    for number, (model, m, stepper, count) in enumerate(models):
        arguments = stepper, mean_functional(stepper.system), jnp.ones(())
        motion = jc.simulate(stepper, steps=count)
        found = half_disc_runs.errors(stepper, motion, count, fine)
        row = {"model": model, "rings": m, "n": stepper.system.size, "steps": count}
        rows.append(row | {key: found[key] for key in ("displacement", "force")})
        runs[str(number)] = lambda x=arguments, count=count: value_and_grad(*x, count)
    seconds = measure.interleaved_seconds(runs, repeats, budget=60.0)
    return [row | {"gradient_s": time} for row, time in zip(rows, seconds.values(), strict=True)]


def draw(rows: list[dict], out: Path) -> None:
    """Draw the errors of full and reduced models against the time."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    labels = {"full": "full models, finer and finer", "reduced": "reduced models of the finest"}
    for (model, label), color in zip(labels.items(), ("C3", "C0"), strict=True):
        mine = [row for row in rows if row["model"] == model]
        times, errors = ([row[key] for row in mine] for key in ("gradient_s", "displacement"))
        axis.loglog(times, errors, "o-", color=color, label=label, lw=2, ms=7)
        for row in mine:
            axis.annotate(
                f"{row['n']}",
                (row["gradient_s"], row["displacement"]),
                textcoords="offset points",
                xytext=(7, 5) if model == "full" else (-20, -3),
                color=color,
            )
    axis.set(xlabel="time for value and gradient [s]", ylabel="relative error")
    axis.set_title("Numbers: unknowns. Lower left is better.", fontsize=10)
    axis.margins(0.12)
    axis.grid(alpha=0.3, which="both")
    axis.legend()
    measure.save_chart(figure, "speed_accuracy", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw."""
    options = measure.parse(measure.parser(__doc__), argv)
    rings, steps, modes = (
        ([2, 4], 30, [4]) if options.quick else ([4, 8, 16, 32], 75, [5, 10, 20, 40])
    )
    fine_size = (8, 120) if options.quick else (64, 2400)
    fine = half_disc_runs.reference(*fine_size, jc.ContactStabilized(), 1)
    rows = measure_models(rings, steps, modes, fine, options.repeats)
    measure.print_table(rows)
    measure.save("speed_accuracy", rows, options.out, reference_rings_and_steps=fine_size)
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
