"""Does `recommend` hold its tolerance, and what does its advice cost against the cheapest one?

A bar and a block that are thrown on a floor and the half disc that is pressed on one; the quantity
is the mean displacement over the body and the time. Every mesh, time step and scheme of a grid is
run, in three phases of the touch. That judges the advice for three tolerances: its error is that
against the exact bar or a finer run; its time, T (a + b n^1.2), is compared with the cheapest
configuration of the grid that is within the tolerance together with its two finer neighbours
(others are within it by chance), and with the cheapest of these beside the coarsest mesh, which is
never advised. The same grid gives the effectivity of the space-time estimate,
estimated over true error; `reduction_error` is judged on the half disc under random loads.
"""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import controlled_bodies, measure
from common.advised_scenes import CASES, Case

import jaxcontact as jc
from jaxcontact.accuracy.estimate import ORDER_FACTOR
from jaxcontact.accuracy.probe import PHASES
from jaxcontact.accuracy.recommend import GROWTH
from jaxcontact.control.inner_product import nodal_norms

#: Seconds of a step without unknowns and of one unknown to the power `GROWTH`, per contact problem.
STEP, UNKNOWN = 1e-5, 1.6e-8
SCHEMES = (jc.ContactImplicit(), jc.ContactStabilized())
#: Name of the rows on `reduction_error`.
REDUCED = "reduced half disc"
#: Steps of one compiled program: a run of any number of steps is made of these.
BLOCK = 32


@partial(jax.jit, static_argnums=3)
def advance(
    stepper: jc.Stepper, state: jc.State, left: jax.Array, block: int
) -> tuple[jc.State, jax.Array]:
    """Advance by a block; return the state and the sum of the mean displacements.

    By the trapezoidal rule over the first `left` steps of the block.
    """
    motion = jc.simulate(stepper, steps=block, initial=state)
    weights = stepper.system.nodal_mass @ jnp.ones(stepper.system.n_nodes)
    means = motion.displacement[..., -1] @ weights / jnp.sum(weights)
    steps = 0.5 * (means[1:] + means[:-1])
    return motion.final, jnp.sum(steps, where=jnp.arange(block) < left)


@dataclasses.dataclass
class MeanDisplacement:
    """The mean displacement along the last axis over body and time of a stepper, [m]."""

    case: Case
    seen: set = dataclasses.field(default_factory=set)
    """Steppers of before: the second run of one is for its time, and is one program."""

    def __call__(self, stepper: jc.Stepper) -> float:
        """Simulate in blocks, which one program of a mesh does, and again in one piece."""
        system, steps = stepper.system, round(self.case.end / float(stepper.dt))
        velocity = jnp.zeros_like(system.points).at[:, -1].set(-self.case.speed)
        is_clamped = system.node_numbers == len(system.free_nodes)
        state = jc.State(jnp.zeros_like(velocity), jnp.where(is_clamped[:, None], 0.0, velocity))
        key = (system.size, system.mark, float(stepper.dt), stepper.scheme)
        block = steps if key in self.seen else BLOCK
        self.seen.add(key)
        total = jnp.zeros(())
        for begin in range(0, steps, block):
            state, part = advance(stepper, state, jnp.asarray(steps - begin), block)
            total = total + part
        return float(total) / steps


def predicted(size: int, scheme: Any, steps: int) -> float:
    """Return the predicted time of a run, [s]."""
    problems = 2 if isinstance(scheme, jc.ContactStabilized) else 1
    return steps * problems * (STEP + UNKNOWN * size**GROWTH)


def grid(case: Case) -> tuple[dict[tuple, np.ndarray], dict[int, int]]:
    """Return the quantity of (level of h, of dt, scheme) at three phases, and the unknowns."""
    values, sizes, quantity = {}, {}, MeanDisplacement(case)
    for i in range(case.levels):
        system = jc.discretize(case.build(case.h / 2**i))
        sizes[i] = system.size
        for k, scheme in enumerate(SCHEMES):
            for j in range(case.dt_levels):
                steps = case.dt / 2**j * np.array(PHASES)
                runs = [quantity(jc.prepare(system, dt, scheme=scheme)) for dt in steps]
                values[i, j, k] = np.array(runs)
        print(f"grid: {system.size} unknowns")
    return values, sizes


def root_mean_square(x: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(x**2)))


def judge(name: str, is_quick: bool) -> list[dict]:
    """Return one row per tolerance, and one of the effectivity of the estimate."""
    case = CASES[name]
    if is_quick:
        case = case._replace(levels=3, dt_levels=3, tolerances=(0.2,))
    values, sizes = grid(case)
    finest = values[case.levels - 1, case.dt_levels - 1, 1]
    exact = float(np.mean(finest)) if case.exact is None else case.exact
    miss = {key: root_mean_square(found - exact) for key, found in values.items()}

    def time_of(i: int, j: int, k: int) -> float:
        return predicted(sizes[i], SCHEMES[k], round(case.end * 2**j / case.dt))

    rows, effectivity = [], []
    # Of the two finest levels the error against the finest is not known.
    last = (1, 1) if case.exact is None else (0, 0)
    for i, j, k in values:
        if 0 < i < case.levels - 1 - last[0] and j < case.dt_levels - 1 - last[1]:
            space = root_mean_square(values[i, j, k] - values[i + 1, j, k])
            time = root_mean_square(values[i, j, k] - values[i, j + 1, k])
            effectivity.append(ORDER_FACTOR * (space + time) / miss[i, j, k])
    for tolerance in case.tolerances:
        allowed = tolerance * abs(exact)
        robust = [
            key
            for key in values
            if all(
                miss.get((key[0] + a, key[1] + b, key[2]), np.inf) <= allowed
                for a, b in ((0, 0), (1, 0), (0, 1))
            )
        ]
        quantity = MeanDisplacement(case)
        advice = jc.recommend(case.build, quantity, tolerance, h=case.h, dt=case.dt)
        wanted = (advice.h, advice.dt, advice.scheme, advice.dtype, advice.modes, False)
        chosen = next(x for x in advice.evidence if x.choice == wanted)
        system = jc.discretize(case.build(advice.h))
        if advice.modes is not None:
            system = jc.reduce(system, advice.modes)
        found = quantity(jc.prepare(system, advice.dt, scheme=advice.scheme))
        time = predicted(chosen.unknowns, advice.scheme, round(case.end / advice.dt))
        cheapest = min((time_of(*key) for key in robust), default=None)
        finer = min((time_of(*key) for key in robust if key[0]), default=None)
        rows.append(
            {
                "scene": name,
                "tolerance": tolerance,
                "h": advice.h,
                "dt": advice.dt,
                "modes": advice.modes,
                "scheme": type(advice.scheme).__name__,
                "unknowns": chosen.unknowns,
                "is_reached": advice.is_reached,
                "estimate": advice.error / abs(exact),
                "error": abs(found - exact) / abs(exact),
                "time_over_cheapest": None if cheapest is None else time / cheapest,
                "time_over_cheapest_but_coarsest": None if finer is None else time / finer,
            }
        )
        print(f"{name}, {tolerance}: {rows[-1]}")
    factors = np.array(effectivity)
    rows.append(
        {
            "scene": name,
            "configurations": len(factors),
            "median_effectivity": float(np.median(factors)),
            "within_0.3_to_3": float(np.mean((factors > 0.3) & (factors < 3.0))),
        }
    )
    return rows


def reduction_estimates(is_quick: bool) -> list[dict]:
    """Return `reduction_error` over the true error for three random loads and three sizes."""
    steps, sizes, seeds = (20, [8], [0]) if is_quick else (150, [15, 30, 60], [0, 1, 2])
    stepper = controlled_bodies.half_disc(8 if is_quick else 16, steps, jnp.float64).stepper
    norms, rows = partial(nodal_norms, stepper.system.nodal_mass), []
    for seed in seeds:
        u = jnp.asarray(controlled_bodies.smooth(stepper.system, steps, seed=seed))
        run = partial(jc.simulate, control=controlled_bodies.SCALE * u)
        exact = run(stepper)
        for modes in sizes:
            reduced = jc.prepare(jc.reduce(stepper.system, modes), stepper.dt)
            found, motion = jc.reduction_error(stepper.system, reduced, run), run(reduced)
            missed, size = (
                float(jnp.sqrt(jnp.max(norms(y))))
                for y in (motion.displacement - exact.displacement, exact.displacement)
            )
            pushed = [jnp.cumsum(jnp.sum(x.contact_impulse, axis=1)) for x in (motion, exact)]
            impulse = float(jnp.max(jnp.abs(pushed[0] - pushed[1])) / pushed[1][-1])
            row = {"scene": REDUCED, "seed": seed, "modes": modes}
            row["effectivity_displacement"] = found.displacement * size / missed
            rows.append(row | {"effectivity_impulse": found.impulse / impulse})
    return rows


def draw(rows: list[dict], out: Path) -> None:
    """Draw the error against the tolerance, and the time over the cheapest."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    advice = [row for row in rows if "tolerance" in row]
    for number, name in enumerate(dict.fromkeys(row["scene"] for row in advice)):
        mine = [row for row in advice if row["scene"] == name]
        tolerances = [row["tolerance"] for row in mine]
        style = {"marker": "os^"[number % 3], "color": f"C{number}"}
        axes[0].loglog(tolerances, [row["error"] for row in mine], label=name, **style)
        axes[0].loglog(tolerances, [row["estimate"] for row in mine], ":", mfc="none", **style)
        costs = [row["time_over_cheapest_but_coarsest"] or np.nan for row in mine]
        axes[1].semilogx(tolerances, costs, label=name, **style)
    ends = np.array([min(row["tolerance"] for row in advice), max(r["tolerance"] for r in advice)])
    axes[0].loglog(ends, ends, "k-", lw=0.8)
    axes[0].plot([], [], "k:", label="estimate")
    axes[0].set(xlabel="tolerance", ylabel="relative error")
    axes[1].set(xlabel="tolerance", ylabel="predicted time / cheapest robust")
    axes[1].set_ylim(bottom=0.0)
    axes[0].legend()
    for axis in axes:
        axis.grid(alpha=0.3)
    measure.save_chart(figure, "recommend", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw; scenes that are not named keep the rows of an earlier record."""
    arguments = measure.parser(__doc__)
    names = [*CASES, REDUCED]
    arguments.add_argument("--scenes", nargs="*", choices=names, default=names)
    options = measure.parse(arguments, argv)
    if options.quick:
        options.scenes = ["bar", REDUCED]
    record = Path(options.out) / "recommend.json"
    rows = json.loads(record.read_text())["rows"] if record.exists() else []
    for name in options.scenes:
        rows = [row for row in rows if row["scene"] != name]
        rows += (
            reduction_estimates(options.quick) if name == REDUCED else judge(name, options.quick)
        )
    measure.print_table([row for row in rows if "tolerance" in row])
    measure.print_table([row for row in rows if "configurations" in row])
    measure.print_table([row for row in rows if row["scene"] == REDUCED])
    measure.save("recommend", rows, options.out, step=STEP, unknown=UNKNOWN, growth=GROWTH)
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
