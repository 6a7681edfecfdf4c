"""Is contact between two meshes as exact as contact with a plane, and what does it cost?

Patch test: two blocks, nothing clamped, are pressed together by equal tractions; the stress must be
the same in every cell, on any two meshes. Hertz: two half discs of one radius, the cells of the
second one smaller by 1.5, against one half disc on the plane between them and the formula. Cost:
a step of two half discs against one of one half disc of as many unknowns on a plane, in turns.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import measure

import jaxcontact as jc

RADIUS = jc.scenes.RADIUS
DEPTH = 0.08
MATERIAL = jc.KelvinVoigt(young=1.0, poisson=0.3)
#: Dimension, cells of an edge of the lower and of the upper block, tilt [rad].
PATCHES = [(2, 8, 8, 0.0), (2, 16, 24, 0.0), (2, 24, 16, 0.4), (3, 4, 3, 0.0), (3, 3, 4, 0.4)]


def patch(d: int, lower: int, upper: int, tilt: float) -> dict[str, Any]:
    """Return the largest error of stress and pressure of two unit cubes, relative to the traction.

    Args:
        d: dimension.
        lower: cells along an edge of the lower block.
        upper: those of the upper one, whose nodes have the contact pairs.
        tilt: by which both are turned, [rad].
    """
    make = jc.meshes.rectangle if d == 2 else jc.meshes.box
    up = np.eye(d)[-1]
    turn = np.eye(d)
    c, s = np.cos(tilt), np.sin(tilt)
    turn[[0, 0, -1, -1], [0, -1, 0, -1]] = c, -s, s, c
    blocks = {"lower": make((1.0,) * d, h=1.0 / lower), "upper": make((1.0,) * d, h=1.0 / upper)}
    blocks["upper"] = blocks["upper"].moved(translation=up)
    mesh = jc.join(blocks).moved(rotation=turn)
    pressure = 0.01
    scene = jc.Scene(
        mesh,
        MATERIAL,
        contact={"upper/bottom": jc.Facets("lower/top")},
        traction={"upper/top": -pressure * turn @ up, "lower/bottom": pressure * turn @ up},
    )
    found = jc.solve_static(jc.discretize(scene))
    stress = np.asarray(jc.stress(scene, found.displacement).cells)
    exact = -pressure * np.outer(turn @ up, turn @ up)
    name = f"{d}D, {lower} on {upper}" + (", tilted" if tilt else "")
    return {
        "case": "patch",
        "name": name,
        "stress_error": float(np.max(np.abs(stress - exact))) / pressure,
        "pressure_error": float(np.max(np.abs(found.contact_pressure / pressure - 1.0))),
    }


def pressed(scene: jc.Scene, depth: float) -> tuple[jc.System, jc.StaticContact]:
    """Return system and equilibrium of bodies that are pushed into each other by a depth, [m]."""
    system = jc.discretize(scene)
    return system, jc.solve_static(system.with_gap(system.gap - depth))


def hertz(n: int) -> dict[str, Any]:
    """Return load and pressure of two half discs with R/h = n and 1.5 n."""
    upper = jc.meshes.half_disc(RADIUS, h=RADIUS / n)
    lower = jc.meshes.half_disc(RADIUS, h=RADIUS / (1.5 * n))
    lower = lower.moved(np.diag([-1.0, -1.0]), [0.0, -2.0 * RADIUS])
    plane = jc.HalfSpace([0.0, -RADIUS], [0.0, 1.0])
    one = jc.Scene(upper, jc.scenes.RUBBER, clamped=("clamped",), contact={"contact": plane})
    two = jc.Scene(
        jc.join({"upper": upper, "lower": lower}),
        jc.scenes.RUBBER,
        clamped=("upper/clamped", "lower/clamped"),
        contact={"upper/contact": jc.Facets("lower/contact", along=np.array([0.0, -1.0]))},
    )
    _, alone = pressed(one, DEPTH)
    system, both = pressed(two, 2.0 * DEPTH)
    load = float(np.sum(both.contact_force))
    # Half-width a^2 = 4 P R / (pi E), with R and E of both bodies together.
    modulus = jc.scenes.RUBBER.young / (1.0 - jc.scenes.RUBBER.poisson**2) / 2.0
    width = np.sqrt(4.0 * load * 0.5 * RADIUS / (np.pi * modulus))
    x = np.asarray(system.points)[system.contact_nodes, 0]
    expected = 2.0 * load / (np.pi * width) * np.sqrt(np.maximum(1.0 - (x / width) ** 2, 0.0))
    miss = np.linalg.norm(both.contact_pressure - expected) / np.linalg.norm(expected)
    return {
        "case": "hertz",
        "name": f"R/{n} on R/{1.5 * n:.0f}",
        "n": system.size,
        "cells_of_radius": n,
        "load_over_one_body": load / float(np.sum(alone.contact_force)),
        "pressure_error": float(miss),
    }


def fall(scene: jc.Scene, bodies: dict[str, float]) -> tuple[jc.Stepper, jc.State]:
    """Return a prepared scene of half discs with the vertical velocities of its bodies, [m/s]."""
    stepper = jc.prepare(jc.discretize(scene), 5e-5)
    velocity = jnp.zeros(scene.mesh.points.shape)
    for name, speed in bodies.items():
        nodes = np.unique(scene.mesh.cells[scene.mesh.regions[name]]) if name else slice(None)
        velocity = velocity.at[nodes, 1].set(speed)
    return stepper, jc.State(jnp.zeros_like(velocity), velocity)


def cost(n: int, steps: int, repeats: int) -> dict[str, Any]:
    """Return the time of a step of about n unknowns, of one body on a plane and of two bodies."""
    rings = np.sqrt(n / 3.0)
    free = {"clamped": ()}
    one = jc.Scene(**vars(jc.scenes.half_disc(RADIUS / rings, gap=1e-3)) | free)
    two = jc.Scene(**vars(jc.scenes.two_half_discs(RADIUS / rings * 2**0.5, gap=1e-3)) | free)
    scenes = {"one": fall(one, {"": -50.0}), "two": fall(two, {"upper": -50.0, "lower": 50.0})}
    run = partial(jc.simulate, steps=steps, save_every=steps)
    programs, row = {}, {"case": "cost", "name": "half discs"}
    for name, (stepper, initial) in scenes.items():
        program, _ = measure.compiled(
            lambda stepper, initial: run(stepper, initial=initial), stepper, initial
        )
        motion = program(stepper, initial)
        row |= {
            f"{name}_n": stepper.system.size,
            f"{name}_pairs": stepper.system.normals.count,
            f"{name}_closed": float(jnp.mean(jnp.any(motion.active, axis=1))),
        }
        programs[name] = partial(program, stepper, initial)
    seconds = measure.interleaved_seconds(programs, repeats)
    row |= {f"{name}_us": 1e6 * value / steps for name, value in seconds.items()}
    return row | {"two_over_one": seconds["two"] / seconds["one"]}


def chart(rows: list[dict]):
    """Return the figure: errors of the patch test, Hertz over the mesh, time of a step."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    patches, discs, costs = (
        [r for r in rows if r["case"] == c] for c in ("patch", "hertz", "cost")
    )
    left.barh([r["name"] for r in patches], [r["stress_error"] for r in patches], log=True)
    left.set(xlabel="largest error of the stress / traction", xlim=(1e-16, 1.0), title="patch test")
    n = [r["cells_of_radius"] for r in discs]
    middle.loglog(n, [r["pressure_error"] for r in discs], "o-", label="pressure, L2 against Hertz")
    loads = [abs(r["load_over_one_body"] - 1.0) for r in discs]
    middle.loglog(n, loads, "s-", label="load against one body")
    middle.set(xlabel="cells along the radius", title="two half discs, relative error")
    middle.legend(frameon=False, loc="upper right")
    for k, name in enumerate(("one", "two")):
        x = np.arange(len(costs)) + 0.4 * k
        right.bar(x, [r[f"{name}_us"] for r in costs], 0.4, label=("one body", "two bodies")[k])
    right.set_xticks(np.arange(len(costs)) + 0.2, [f"n = {r['one_n']}" for r in costs])
    right.set(ylabel="time of a step [µs]", title="cost")
    right.legend(frameon=False)
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
    return figure


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw."""
    options = measure.parse(measure.parser(__doc__), argv)
    quick = options.quick
    rows = [patch(*case) for case in (PATCHES[:1] if quick else PATCHES)]
    rows += [hertz(n) for n in ([6, 12] if quick else [16, 24, 48])]
    for n in [300] if quick else [2_000, 10_000]:
        rows.append(cost(n, 20 if quick else 200, options.repeats))
        jax.clear_caches()
    for case in ("patch", "hertz", "cost"):
        measure.print_table([row for row in rows if row["case"] == case])
    measure.save("two_bodies", rows, options.out)
    measure.save_chart(chart(rows), "two_bodies", options.out)
    return rows


if __name__ == "__main__":
    main()
