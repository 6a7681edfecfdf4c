"""Does the gradient through an impact converge, and with which contact law?

By the height of a drop (bars with an exact solution, one between two walls) and by the gap of
bodies thrown at a plane. Each gradient is taken at 8 phases of the touch within a time step. Bias:
their mean over the exact gradient minus one. Spread: their standard deviation, of a bar over the
exact gradient. Of a body the gradient of its height at the end should be minus its rebound
velocity: miss is the mean distance. A gradient of one run is worth sqrt(bias^2 + spread^2).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import alternatives, measure

import jaxcontact as jc

PHASES = 8
SCHEMES = {
    "ContactImplicit": jc.ContactImplicit(),
    "ContactStabilized": jc.ContactStabilized(),
    "RedistributedMass": jc.RedistributedMass(),
    "BackwardEuler": jc.BackwardEuler(),
    "Trapezoidal": jc.Trapezoidal(),
}
LAWS = ("exact", "RelaxedContact", "SmoothedContact")


class Drop(NamedTuple):
    """A run of which the gradient of the height at the end by the gap is taken."""

    stepper: jc.Stepper
    initial: jc.State
    steps: int
    speed: float
    """Closing speed at touch, [m/s]."""

    exact: float
    """Exact gradient; NaN if it is not known."""

    def with_law(self, law: str) -> Drop:
        """Return the run with a contact law of the size that the law finds for the scene."""
        if law == "exact":
            return self
        found = getattr(jc, law).for_scene(self.stepper, self.initial)
        return self._replace(stepper=jc.with_contact(self.stepper, found))


def dropped_from(stepper: jc.Stepper, higher: Any) -> jc.Stepper:
    """Return a stepper whose body starts higher, [m]; between two walls farther from the first."""
    system = stepper.system
    away = jnp.ones_like(system.gap)
    if system.dimension == 1:
        away = away.at[1:].set(-1.0)
    return dataclasses.replace(stepper, system=system.with_gap(system.gap + higher * away))


def height(stepper: jc.Stepper, displacement: jax.Array) -> jax.Array:
    """Return the last component of the mean displacement, the centre of mass."""
    weights = stepper.system.nodal_mass @ jnp.ones((stepper.system.n_nodes, 1))
    return jnp.sum(weights[:, 0] * displacement[:, -1]) / jnp.sum(weights)


def simulated(stepper: jc.Stepper, initial: jc.State, steps: int) -> jc.State:
    """Return the last state of the package's own motion."""
    return jc.simulate(stepper, steps=steps, initial=initial).final


def penalized(stepper: jc.Stepper, initial: jc.State, steps: int) -> jc.State:
    """Return the last state of a penalty model; its velocity is not used."""
    nothing = jnp.zeros((steps, *stepper.system.points.shape))
    last = alternatives.penalty(stepper, initial, nothing)[-1]
    return jc.State(last, jnp.zeros_like(last))


def final_height(
    stepper: jc.Stepper, initial: jc.State, run: Callable, steps: int, higher: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return height and velocity of the centre of mass at the end."""
    end = run(dropped_from(stepper, higher), initial, steps)
    return higher + height(stepper, end.displacement), height(stepper, end.velocity)


@partial(jax.jit, static_argnames=("run", "steps"))
def gradients(
    stepper: jc.Stepper, initial: jc.State, run: Callable, steps: int, higher: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return height, velocity and gradient of the height by the start, (m,) each."""
    at = partial(final_height, stepper, initial, run, steps)

    def one(x: jax.Array):
        (value, velocity), slope = jax.value_and_grad(at, has_aux=True)(x)
        return value, velocity, slope

    return jax.lax.map(one, higher)


@partial(jax.jit, static_argnames="steps")
def mean_gradients(
    stepper: jc.Stepper, initial: jc.State, steps: int, speed: float, higher: jax.Array
) -> jax.Array:
    """Return the gradient of the mean over the phases of exact contact, (m,)."""

    def one(x: jax.Array):
        def value(stepper: jc.Stepper, more: jax.Array) -> jax.Array:
            return final_height(stepper, initial, simulated, steps, more)[0]

        objective = jax.tree_util.Partial(value, dropped_from(stepper, x))
        return jax.grad(jc.phase_mean(objective, speed))(0.0)

    return jax.lax.map(one, higher)


def phases(drop: Drop, count: int = PHASES, periods: float = 1.0) -> jax.Array:
    """Return by how much to start higher for touches of equally spaced phases, (count,) [m]."""
    step = drop.speed * float(drop.stepper.dt)
    return jnp.asarray(periods * step * np.arange(count) / count, drop.stepper.system.dtype)


def bar(exact: jc.reference.FallingBar, n: int, scheme: Any, dtype: Any) -> Drop:
    """Return the drop of a bar of n cells at Courant number 1, to 0.73 of its second flight."""
    h, c = exact.length / n, float(exact.wave_speed())
    scene = jc.Scene(
        mesh=jc.meshes.interval(exact.length, h=h),
        material=jc.KelvinVoigt(young=exact.young, poisson=0.0, density=exact.density),
        contact={"left": jc.HalfSpace(point=np.array([-exact.gap]), normal=np.array([1.0]))},
        body_force=np.array([-exact.density * exact.gravity]),
    )
    stepper = jc.prepare(jc.discretize(scene, dtype=dtype), h / c, scheme=scheme)
    speed = float(exact.rebound_velocity())
    last = float(exact.contact_interval()[1]) + 0.733 * speed / exact.gravity
    steps = round(last / float(stepper.dt))
    x = (jnp.arange(2000) + 0.5) / 2000 * exact.length

    def mean(gap: jax.Array) -> jax.Array:
        moved = dataclasses.replace(exact, gap=gap)
        return gap + jnp.mean(moved.displacement(x, steps * float(stepper.dt)))

    start = rest(stepper, 0.0)
    return Drop(stepper, start, steps, speed, float(jax.grad(mean)(exact.gap)))


def two_walls(n: int, impacts: int = 6) -> Drop:
    """Return a bar that flies between two walls: after an even number of impacts dJ/dgap = 1."""
    length, young, gap, speed = 10.0, 900.0, 5.0, 10.0
    h, c = length / n, 30.0
    scene = jc.Scene(
        mesh=jc.meshes.interval(length, h=h),
        material=jc.KelvinVoigt(young=young, poisson=0.0),
        contact={
            "left": jc.HalfSpace(point=np.array([-gap]), normal=np.array([1.0])),
            "right": jc.HalfSpace(point=np.array([length + gap]), normal=np.array([-1.0])),
        },
    )
    stepper = jc.prepare(jc.discretize(scene), h / c)
    time = gap / speed + impacts * 2.0 * length / c + (impacts - 1) * 2.0 * gap / speed
    steps = round((time + 0.5 * gap / speed) / float(stepper.dt))
    return Drop(stepper, rest(stepper, -speed), steps, speed, float((-1) ** impacts))


def rest(stepper: jc.Stepper, velocity: float) -> jc.State:
    """Return the undeformed body with a velocity along the last axis."""
    nothing = jnp.zeros_like(stepper.system.points)
    return jc.State(nothing, nothing.at[:, -1].set(velocity))


def tilted(mesh: jc.Mesh, degrees: float) -> jc.Mesh:
    """Return a mesh turned about the second but last axis, in 3D about the first one too."""
    points = mesh.points
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    for axis in range(points.shape[1] - 1):
        turn = np.eye(points.shape[1])
        turn[np.ix_([axis, -1], [axis, -1])] = [[c, -s], [s, c]]
        points = points @ turn.T
    return dataclasses.replace(mesh, points=points)


BODIES: dict[str, tuple[Callable[[float], jc.Mesh], str, float, int]] = {
    "disc": (lambda h: jc.meshes.disc(1.0, h=h), "boundary", 1 / 16, 11),
    "square, tilted": (
        lambda h: tilted(jc.meshes.rectangle((1.0, 1.0), h=h), 5.0),
        "bottom",
        1 / 16,
        12,
    ),
    "square, flat": (lambda h: jc.meshes.rectangle((1.0, 1.0), h=h), "bottom", 1 / 16, 12),
    "cube, tilted": (
        lambda h: tilted(jc.meshes.box((1.0, 1.0, 1.0), h=h), 5.0),
        "bottom",
        1 / 6,
        12,
    ),
    "half ball": (lambda h: jc.meshes.half_ball(1.0, h=h), "contact", 1 / 6, 11),
}


def body(name: str, h: float) -> Drop:
    """Return a body thrown at a plane with a tenth of its wave speed, gap 0.1, to time 11 or 12."""
    build, contact, _, time = BODIES[name]
    mesh = build(h)
    up = np.eye(mesh.dimension)[-1]
    lowest = mesh.points[np.unique(mesh.facets[contact])][:, -1].min()
    scene = jc.Scene(
        mesh=mesh,
        material=jc.KelvinVoigt(young=1.0, poisson=0.3),
        contact={contact: jc.HalfSpace(point=(lowest - 0.1) * up, normal=up)},
    )
    stepper = jc.prepare(jc.discretize(scene), h)
    return Drop(stepper, rest(stepper, -0.1), round(time / h), 0.1, np.nan)


def judged(drop: Drop, run: Callable = simulated) -> dict[str, float]:
    """Return value, bias and spread of the gradients of a drop."""
    found = gradients(drop.stepper, drop.initial, run, drop.steps, phases(drop))
    value, velocity, slope = (np.asarray(x, float) for x in found)
    known = {"bias": slope.mean() / drop.exact - 1, "spread": slope.std() / abs(drop.exact)}
    miss = {"miss": float(np.abs(slope + velocity / drop.speed).mean()), "spread": slope.std()}
    return {
        "value": value.mean(),
        "rebound": velocity.mean() / drop.speed,
        "gradient": slope.mean(),
        "exact": drop.exact,
        **(miss if np.isnan(drop.exact) else known),
    }


def phase_mean_judged(drop: Drop) -> dict[str, float]:
    """Return gradient, bias and spread of the mean over the phases of exact contact."""
    found = mean_gradients(drop.stepper, drop.initial, drop.steps, drop.speed, phases(drop))
    slope = np.asarray(found, float)
    bias, spread = slope.mean() / drop.exact - 1.0, slope.std() / abs(drop.exact)
    return {"gradient": slope.mean(), "exact": drop.exact, "bias": bias, "spread": spread}


def measure_bars(is_quick: bool, dtype: Any) -> list[dict[str, Any]]:
    """Return the rows of the bars."""
    sizes = [20] if is_quick else [50, 100, 200, 400]
    cases = {
        "bar P3": jc.reference.FallingBar(),
        "bar 4 m": jc.reference.FallingBar(length=4.0, young=400.0, gravity=8.0, gap=2.0),
        "bar 2 m": jc.reference.FallingBar(
            length=2.0, young=100.0, density=2.0, gravity=5.0, gap=1.5
        ),
    }
    rows = []
    for case, exact in list(cases.items())[: 1 if is_quick else None]:
        schemes = SCHEMES if case == "bar P3" else {"ContactImplicit": SCHEMES["ContactImplicit"]}
        for n in sizes:
            for name, scheme in schemes.items():
                drop = bar(exact, n, scheme, dtype)
                laws = LAWS if name == "ContactImplicit" else LAWS[::2]
                for law in laws:
                    row = {"case": case, "n": n, "scheme": name, "law": law}
                    rows.append(row | judged(drop.with_law(law)))
                if len(schemes) > 1 and name == "ContactImplicit":
                    row = {"case": case, "n": n, "scheme": name}
                    rows.append(row | {"law": "penalty"} | judged(drop, penalized))
                    rows.append(row | {"law": "phase mean"} | phase_mean_judged(drop))
            print(f"measured {case}, {n} cells", flush=True)
    for n in sizes:
        drop = two_walls(n)
        row = {"case": "two walls", "n": n, "scheme": "ContactImplicit"}
        rows += [row | {"law": law} | judged(drop.with_law(law)) for law in LAWS]
        wide = jc.with_contact(drop.stepper, jc.SmoothedContact(1.5 * drop.speed))
        rows.append(row | {"law": "1.5 times the speed"} | judged(drop._replace(stepper=wide)))
    return rows


def measure_bodies(is_quick: bool) -> list[dict[str, Any]]:
    """Return the rows of the bodies."""
    rows = []
    for name in list(BODIES)[: 1 if is_quick else None]:
        finest = BODIES[name][2]
        for h in [4 * finest] if is_quick else [2 * finest, finest]:
            drop = body(name, h)
            for law in LAWS:
                row = {"case": name, "h": h, "scheme": "ContactImplicit", "law": law}
                rows.append(row | judged(drop.with_law(law)))
        print(f"measured the {name}", flush=True)
    return rows


def measure_times(is_quick: bool, repeats: int) -> list[dict[str, Any]]:
    """Return run times of value and gradient, the laws in turns."""
    rows = []
    for name in ("disc", "square, tilted", "cube, tilted")[: 1 if is_quick else None]:
        drop = body(name, BODIES[name][2] * (4 if is_quick else 1))
        runs = {law: drop.with_law(law) for law in LAWS}
        functions = {
            law: partial(gradients, x.stepper, x.initial, simulated, x.steps, phases(x, 1))
            for law, x in runs.items()
        }
        seconds = measure.interleaved_seconds(functions, repeats)
        for law in LAWS:
            ratio = seconds[law] / seconds["exact"]
            rows.append({"case": name, "law": law, "gradient_s": seconds[law], "over_exact": ratio})
    return rows


def curves(n: int, count: int) -> dict[str, Any]:
    """Return the gradient over the height of the drop of bar P3 for two laws, to be drawn."""
    drop = bar(jc.reference.FallingBar(), n, SCHEMES["ContactImplicit"], jnp.float64)
    found: dict[str, Any] = {"cells": n, "solution": drop.exact}
    found["phase"] = np.arange(count) * 2.0 / count
    for law in LAWS[::2]:
        x = drop.with_law(law)
        higher = phases(x, count, 2.0)
        found[law] = np.asarray(gradients(x.stepper, x.initial, simulated, x.steps, higher)[2])
    return {key: x.tolist() if isinstance(x, np.ndarray) else x for key, x in found.items()}


def chart(rows: list[dict], lines: dict[str, Any]):
    """Return the figure: over the phase, over the mesh, and for five bodies."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    left.axhline(lines["solution"], color="k", ls="--", label="exact solution")
    left.plot(lines["phase"], lines["exact"], "C3.", ms=4, label="exact contact")
    left.plot(lines["phase"], lines["SmoothedContact"], "C0", lw=2, label="SmoothedContact")
    left.set(
        xlabel="place of the touch within its time step",
        ylabel="d(height after the bounce) / d(drop height)",
        title=f"a falling bar, {lines['cells']} cells",
        ylim=(-1.6, 3.8),
    )
    left.legend(loc="upper right")
    styles = {
        ("ContactImplicit", "exact"): "C3o-",
        ("ContactStabilized", "exact"): "C1s-",
        ("RedistributedMass", "exact"): "C5^-",
        ("BackwardEuler", "exact"): "C7v-",
        ("ContactImplicit", "penalty"): "C8x--",
        ("ContactImplicit", "phase mean"): "C4d-",
        ("ContactImplicit", "RelaxedContact"): "C2o-",
        ("ContactImplicit", "SmoothedContact"): "C0o-",
    }
    mine = [row for row in rows if row["case"] == "bar P3"]
    for (scheme, law), style in styles.items():
        line = [row for row in mine if (row["scheme"], row["law"]) == (scheme, law)]
        sizes, errors = [r["n"] for r in line], [np.hypot(r["bias"], r["spread"]) for r in line]
        label = scheme if law == "exact" else law
        middle.plot(sizes, errors, style, lw=2 if law == "SmoothedContact" else 1, label=label)
    middle.set(xscale="log", yscale="log", xlabel="cells", title="relative error of the gradient")
    middle.legend(fontsize=7)
    names = list(dict.fromkeys(row["case"] for row in rows if "h" in row))
    for k, law in enumerate(LAWS):
        finest = [[r for r in rows if (r["case"], r["law"]) == (name, law)][-1] for name in names]
        right.bar(
            np.arange(len(names)) + 0.27 * (k - 1),
            [row["spread"] for row in finest],
            0.25,
            color=("C3", "C2", "C0")[k],
            label="exact contact" if law == "exact" else law,
        )
    right.set(yscale="log", title="spread of d(height)/d(gap) over the phase", ylim=(None, 60.0))
    right.set_xticks(range(len(names)), [name.replace(", ", ",\n") for name in names])
    right.legend(loc="upper right", ncols=3, fontsize=7)
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
    return figure


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw."""
    options = measure.parse(measure.parser(__doc__), argv)
    rows = measure_bars(options.quick, options.dtype)
    rows += measure_bodies(options.quick)
    lines = curves(*((20, 8) if options.quick else (100, 128)))
    times = measure_times(options.quick, options.repeats)
    keys = ("case", "n", "h", "scheme", "law", "gradient", "exact", "bias", "spread", "miss")
    measure.print_table([{key: row.get(key) for key in keys} for row in rows])
    measure.print_table(times)
    measure.save("gradient_convergence", rows, options.out, over_the_phase=lines, times=times)
    measure.save_chart(chart(rows, lines), "gradient_convergence", options.out)
    return rows


if __name__ == "__main__":
    main()
