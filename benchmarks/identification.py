"""Does an optimiser find modulus and speed of a bar from how it bounced?

A free bar flies against a wall. Measured are its centre and its free end, 20 times until half a
second after the rebound, on the exact solution. L-BFGS looks for modulus and speed from random
starts, through exact contact and through the smooth laws. A start has converged if both are found
as well as the mesh allows: within 5 %.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import measure

import jaxcontact as jc
from jaxcontact.control.inner_product import Weighted

TRUTH = jc.reference.FreeBar()
WAVE_SPEED = (TRUTH.young / TRUTH.density) ** 0.5
CLOSE = 0.05
#: Ranges of the starts: factors of modulus and speed.
YOUNG, SPEED = (0.6, 1.6), (0.75, 1.3)
DURATION, SAMPLES = 5.0 / 3.0, 20


def stepper_of(young: Any, cells: int) -> jc.Stepper:
    """Return the bar of a modulus; its time step is that of Courant number 1 at the true one."""
    h = TRUTH.length / cells
    scene = jc.Scene(
        mesh=jc.meshes.interval(TRUTH.length, h=h),
        material=jc.KelvinVoigt(young=young, poisson=0.0, density=TRUTH.density),
        contact={"left": jc.HalfSpace(point=np.array([-TRUTH.gap]), normal=np.array([1.0]))},
    )
    return jc.prepare(jc.discretize(scene), h / WAVE_SPEED)


def samples(cells: int) -> np.ndarray:
    """Return the time levels that are measured, (SAMPLES,)."""
    steps = round(DURATION * WAVE_SPEED * cells / TRUTH.length)
    return np.linspace(0, steps, SAMPLES + 1)[1:].round().astype(int)


def measured(cells: int) -> jax.Array:
    """Return centre and free end of the exact motion at the samples, (SAMPLES, 2) [m]."""
    times = samples(cells) * TRUTH.length / cells / WAVE_SPEED
    x = (jnp.arange(2000) + 0.5) / 2000 * TRUTH.length
    centre = jnp.mean(TRUTH.displacement(x[None, :], times[:, None]), axis=1)
    return jnp.stack([centre, TRUTH.displacement(TRUTH.length, times)], axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Misfit:
    """How far a motion is from what was measured."""

    law: Any
    """The contact law."""

    data: jax.Array
    """What was measured, (SAMPLES, 2) [m]."""

    cells: int = field(metadata={"static": True})
    """Cells of the bar."""

    def value(self, logarithms: jax.Array) -> jax.Array:
        """Return the mean square of what the motion misses, relative to the gap, scalar.

        Args:
            logarithms: of modulus and speed over the true ones, (2,).
        """
        young, speed = jnp.exp(logarithms) * jnp.array([TRUTH.young, TRUTH.impact_speed])
        stepper = jc.with_contact(stepper_of(young, self.cells), self.law)
        ones = jnp.ones((self.cells + 1, 1))
        start = jc.State(0.0 * ones, -speed * ones)
        levels = samples(self.cells)
        motion = jc.simulate(stepper, steps=int(levels[-1]), initial=start)
        y = motion.displacement[levels, :, 0]
        found = jnp.stack([jnp.trapezoid(y, dx=1.0 / self.cells), y[:, -1]], axis=1)
        return jnp.mean(((found - self.data) / TRUTH.gap) ** 2)


def identify(problem: Misfit, start: np.ndarray, iterations: int) -> tuple[np.ndarray, int]:
    """Return modulus and speed over the true ones, (2,), and the gradients it took."""
    result = jc.optimize(
        problem.value,
        jnp.log(start),
        method=jc.LBFGS(),
        inner_product=Weighted(jnp.ones(2)),
        iterations=iterations,
    )
    return np.exp(np.asarray(result.control)), int(result.history.evaluations[-1])


def laws(cells: int) -> dict[str, Any]:
    """Return the contact laws, the smooth ones for the bar at the middle of the starts."""
    stepper = stepper_of(TRUTH.young, cells)
    speed = TRUTH.impact_speed
    return {
        "exact": jc.SemismoothNewton(),
        "RelaxedContact": jc.RelaxedContact.for_scene(stepper, speed=speed),
        "SmoothedContact": jc.SmoothedContact.for_scene(stepper, speed=speed),
    }


def chart(rows: list[dict]):
    """Return the figure: where each start ended, by law and mesh."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(row["law"] for row in rows))
    figure, axes = plt.subplots(1, len(names), figsize=(12, 3.6), sharey=True, layout="constrained")
    for axis, name in zip(axes, names, strict=True):
        row = [row for row in rows if row["law"] == name][-1]
        starts, ends = np.array(row["starts"]), np.array(row["ends"])
        for start, end in zip(starts, ends, strict=True):
            axis.plot(*np.stack([start, end]).T, color="0.8", lw=0.8)
        axis.plot(*starts.T, ".", color="0.5", label="start")
        axis.plot(*ends.T, "C0o", ms=4, label="end")
        axis.plot(1.0, 1.0, "k+", ms=14, label="truth")
        title = "exact contact" if name == "exact" else name
        axis.set(title=f"{title}: {row['converged']} of {len(ends)}", xlabel="modulus / true one")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("speed / true one")
    axes[0].legend()
    return figure


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw."""
    options = measure.parse(measure.parser(__doc__), argv)
    sizes, count, iterations = ([20], 4, 8) if options.quick else ([100], 20, 40)
    rng = np.random.default_rng(0)
    factors = np.stack([rng.uniform(*YOUNG, count), rng.uniform(*SPEED, count)], axis=1)
    rows = []
    for cells in sizes:
        data = measured(cells)
        for name, law in laws(cells).items():
            problem = Misfit(law, data, cells)
            found = [identify(problem, start, iterations) for start in factors]
            ends = np.array([end for end, _ in found])
            miss = np.max(np.abs(ends - 1.0), axis=1)
            rows.append(
                {
                    "law": name,
                    "cells": cells,
                    "converged": int(np.sum(miss < CLOSE)),
                    "median_miss": float(np.median(miss)),
                    "median_gradients": float(np.median([count for _, count in found])),
                    "starts": factors.tolist(),
                    "ends": ends.tolist(),
                }
            )
    columns = ("law", "cells", "converged", "median_miss", "median_gradients")
    measure.print_table([{key: row[key] for key in columns} for row in rows])
    measure.save("identification", rows, options.out, close=CLOSE, iterations=iterations)
    measure.save_chart(chart(rows), "identification", options.out)
    return rows


if __name__ == "__main__":
    main()
