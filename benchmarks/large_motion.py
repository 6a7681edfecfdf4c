"""How right is a motion with one frame per body, and what does it cost?

Flight: a block that spins and vibrates, against St.Venant-Kirchhoff on the same mesh with the same
steps. Impact: a tilted, spinning block hits a plane with a corner; the impulse against the same
reference, and that of small displacements. Tumble: between two plates for many steps; ledger of
every step. Conservation: free flight. Cost: a step and a gradient against small displacements on
the same mesh, in turns.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import measure, st_venant

import jaxcontact as jc

POISSON, DENSITY = 0.3, 1000.0
#: Speed of a compression wave over the root of modulus over density.
WAVE = np.sqrt((1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON)))
SHAPES = {2: (1.0, 0.5), 3: (1.0, 0.6, 0.4)}
STABILIZED = jc.ContactStabilized()


def block(d: int, h: float) -> jc.Mesh:
    """Return a block with its middle at the origin."""
    mesh = (jc.meshes.rectangle if d == 2 else jc.meshes.box)(SHAPES[d], h=h)
    return mesh.moved(translation=-0.5 * np.array(SHAPES[d]))


def spinning(points: np.ndarray, spin: float) -> np.ndarray:
    """Return the velocity of a rotation in the first two axes, in 3D tilted, (N, d) [m/s]."""
    if points.shape[1] == 2:
        return spin * np.stack([-points[:, 1], points[:, 0]], axis=1)
    axis = np.array([0.2, 0.3, 1.0])
    return np.cross(spin * axis / np.linalg.norm(axis), points)


def stepper_of(
    mesh: jc.Mesh,
    young: float,
    dt: float,
    large_rotation: bool = True,
    contact: Any = None,
    viscosity: float = 0.0,
    scheme: Any = STABILIZED,
) -> jc.Stepper:
    """Return the prepared block; contact is an obstacle, or a tuple of them, for all its sides."""
    material = jc.KelvinVoigt(
        young=young,
        poisson=POISSON,
        bulk_viscosity=viscosity,
        shear_viscosity=viscosity,
        density=DENSITY,
    )
    sides = {} if contact is None else dict.fromkeys(mesh.facets, contact)
    scene = jc.Scene(mesh, material, contact=sides, large_rotation=large_rotation)
    return jc.prepare(jc.discretize(scene), dt, scheme=scheme)


def flight(d: int, strain: float, spin: float, angle: float) -> dict[str, Any]:
    """Compare with the reference after a rotation by the angle, [rad]."""
    h, young = (0.125, 1e6) if d == 2 else (0.2, 1e6)
    mesh = block(d, h)
    X = np.asarray(mesh.points)
    dt = h / (WAVE * np.sqrt(young / DENSITY))
    u = np.zeros_like(X)
    u[:, 0] = strain / np.pi * np.sin(np.pi * X[:, 0])
    v = spinning(X + u, spin)
    steps = round(angle / spin / dt)
    body = st_venant.body(X, np.asarray(mesh.cells), young, POISSON, DENSITY)
    state = st_venant.State(X + u, v)
    for _ in range(steps):
        state = st_venant.step(body, state, dt)[0]
    size = np.sum(X * (body.mass @ X))
    row: dict[str, Any] = {
        "case": "flight",
        "d": d,
        "strain": strain,
        "angle": angle,
        "steps": steps,
    }
    for name, large in (("frames", True), ("small", False)):
        stepper = stepper_of(mesh, young, dt, large, scheme=jc.ContactImplicit())
        motion = jax.jit(partial(jc.simulate, steps=steps, save_every=steps))(
            stepper, initial=jc.State(jnp.asarray(u), jnp.asarray(v))
        )
        miss = X + np.asarray(motion.displacement[-1]) - state.x
        row[f"{name}_error"] = float(np.sqrt(np.sum(miss * (body.mass @ miss)) / size))
        if large:
            row["sweeps"] = float(jnp.mean(motion.iterations))
    return row


def impact(ratio: float, n: int = 8) -> dict[str, Any]:
    """Compare the impulse of a corner that hits a plane at a speed over that of a wave."""
    mesh, young = block(2, 1.0 / n), 1e7
    wave = WAVE * np.sqrt(young / DENSITY)
    dt, speed = 0.5 / n / wave, ratio * wave
    c, s = np.cos(0.5), np.sin(0.5)
    mesh = mesh.moved(np.array([[c, -s], [s, c]]))
    X = np.asarray(mesh.points)
    v = spinning(X, 2.0 * speed) - np.array([0.0, speed])
    # Sixteen wave lengths of the block: the corner is off again, and no other one near.
    steps = 16 * 2 * n
    floor = float(X[:, 1].min() - 2.2 * dt * speed)
    body = st_venant.body(X, np.asarray(mesh.cells), young, POISSON, DENSITY)
    sides = np.unique(np.concatenate([np.ravel(facets) for facets in mesh.facets.values()]))
    rows = np.zeros((len(sides), X.size))
    rows[np.arange(len(sides)), 2 * sides + 1] = -1.0
    state, impulse = st_venant.State(X.copy(), v), 0.0
    for _ in range(steps):
        state, p, _ = st_venant.step(body, state, dt, rows, -floor)
        impulse += float(np.sum(p))
    row: dict[str, Any] = {"case": "impact", "ratio": ratio, "reference": impulse}
    for name, large in (("frames", True), ("small", False)):
        plane = jc.HalfSpace([0.0, floor], [0.0, 1.0])
        motion = jax.jit(partial(jc.simulate, steps=steps))(
            stepper_of(mesh, young, dt, large, plane), initial=jc.State(None, jnp.asarray(v))
        )
        row[name] = float(jnp.sum(motion.contact_impulse))
        row[f"{name}_error"] = abs(row[name] / impulse - 1.0)
    return row


def tumble(d: int, scheme: Any, steps: int) -> dict[str, Any]:
    """Throw a block between two plates 3 m apart and look at the ledger of every step."""
    h, young = (0.125, 1e8) if d == 2 else (0.3, 1e8)
    mesh = block(d, h)
    e = np.eye(d)[-1]
    dt = 0.5 * h / (WAVE * np.sqrt(young / DENSITY))
    plates = (jc.HalfSpace(-1.5 * e, e), jc.HalfSpace(1.5 * e, -e))
    stepper = stepper_of(mesh, young, dt, contact=plates, scheme=scheme)
    X = np.asarray(mesh.points)
    state = jc.State(jnp.zeros(X.shape), jnp.asarray(spinning(X, 9.0) - 8.0 * e))

    @jax.jit
    def chunk(state: jc.State) -> tuple[jc.State, dict[str, jax.Array]]:
        motion = jc.simulate(stepper, steps=min(steps, 10_000), initial=state)
        ledger = jc.energy(stepper, motion)
        closed = jnp.any(motion.strong, axis=1)
        return motion.final, {
            "start": ledger.total[0],
            "end": ledger.total[-1],
            "residual": jnp.max(jnp.abs(ledger.residual)),
            "gain": jnp.max(ledger.change - ledger.work),
            "gap": jnp.min(motion.gap),
            "sweeps": jnp.mean(motion.iterations),
            "touches": jnp.sum(closed[1:] & ~closed[:-1]),
        }

    found = []
    for _ in range(max(steps // 10_000, 1)):
        state, values = chunk(state)
        found.append({name: float(value) for name, value in values.items()})
    start = found[0]["start"]
    return {
        "case": "tumble", "d": d, "scheme": type(scheme).__name__, "steps": steps,
        "residual": max(x["residual"] for x in found) / start,
        "largest_gain": max(x["gain"] for x in found) / start,
        "least_gap": min(x["gap"] for x in found),
        "end": found[-1]["end"] / start,
        "touches": sum(x["touches"] for x in found),
        "sweeps": float(np.mean([x["sweeps"] for x in found])),
    }  # fmt: skip


def conservation(d: int, steps: int) -> dict[str, Any]:
    """Return what free flight of a spinning, vibrating block loses."""
    h, young = (0.125, 1e6) if d == 2 else (0.2, 1e6)
    mesh = block(d, h)
    X = np.asarray(mesh.points)
    dt = h / (WAVE * np.sqrt(young / DENSITY))
    u = np.zeros_like(X)
    u[:, 0] = 1e-2 / np.pi * np.sin(np.pi * X[:, 0])
    v = spinning(X + u, 3.0) + 1.0
    stepper = stepper_of(mesh, young, dt, scheme=jc.ContactImplicit())
    motion = jc.simulate(stepper, steps=steps, initial=jc.State(jnp.asarray(u), jnp.asarray(v)))
    total, momenta = np.asarray(jc.energy(stepper, motion).total), jc.momentum(stepper, motion)
    row = {"case": "conservation", "d": d, "steps": steps}
    row["energy"] = float(np.max(np.abs(total / total[0] - 1.0)))
    for name in ("linear", "angular"):
        value = np.asarray(getattr(momenta, name))
        row[name] = float(np.max(np.abs(value - value[0])) / np.linalg.norm(value[0]))
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(d, d)))[0]
    Q[0] *= np.linalg.det(Q)
    turned = jc.State(jnp.asarray((X + u) @ Q.T - X), jnp.asarray(v @ Q.T))
    other = jc.simulate(stepper, steps=200, initial=turned)
    expected = (X + np.asarray(motion.displacement[200])) @ Q.T - X
    row["frame_indifference"] = float(np.max(np.abs(other.displacement[-1] - expected)))
    return row


def cost(n: int, is_contact: bool, steps: int, repeats: int) -> dict[str, Any]:
    """Return the time of a step and a gradient of about n unknowns over small displacements."""
    cells = round(np.sqrt(n / 1.0))
    mesh, young = block(2, 1.0 / cells), 1e7
    dt = 0.5 / cells / (WAVE * np.sqrt(young / DENSITY))
    X = np.asarray(mesh.points)
    c, s = np.cos(0.1), np.sin(0.1)
    mesh = mesh.moved(np.array([[c, -s], [s, c]]))
    u = np.zeros_like(X)
    u[:, 0] = 1e-2 / np.pi * np.sin(np.pi * X[:, 0])
    v = spinning(np.asarray(mesh.points), 3.0) - np.array([0.0, 1.0])
    floor = jc.HalfSpace([0.0, float(np.asarray(mesh.points)[:, 1].min()) - 1e-2], [0.0, 1.0])
    programs, row = {}, {"case": "cost", "contact": is_contact}
    for name, large in (("small", False), ("frames", True)):
        stepper = stepper_of(mesh, young, dt, large, floor if is_contact else None, 10.0)

        def end(stepper, velocity):
            start = jc.State(jnp.asarray(u), velocity)
            motion = jc.simulate(stepper, steps=steps, initial=start, save_every=steps)
            return jnp.sum(motion.displacement[-1] ** 2), motion

        for kind, function in (
            ("step", end),
            ("gradient", jax.value_and_grad(lambda s, v, end=end: end(s, v)[0], 1)),
        ):
            program, seconds = measure.compiled(function, stepper, jnp.asarray(v))
            row[f"{name}_{kind}_compile_s"] = seconds
            programs[f"{name}_{kind}"] = partial(program, stepper, jnp.asarray(v))
        if large:
            motion = programs["frames_step"]()[1]
            row |= {"n": stepper.system.size, "pairs": stepper.system.normals.count}
            row |= {"sweeps": float(jnp.mean(motion.iterations))}
            row |= {"closed": float(jnp.mean(jnp.any(motion.active, axis=1)))}
    times = measure.interleaved_seconds(programs, repeats)
    row |= {f"{name}_us": 1e6 * value / steps for name, value in times.items()}
    row["frames_over_small"] = times["frames_step"] / times["small_step"]
    row["frames_over_small_and_sweep"] = row["frames_over_small"] / row["sweeps"]
    row["gradient_over_forward"] = times["frames_gradient"] / times["frames_step"]
    return row


def chart(rows: list[dict]):
    """Return the figure: error in flight, error of an impulse, time of a step."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    of = {name: [r for r in rows if r["case"] == name] for name in ("flight", "impact", "cost")}
    for d, strain in sorted({(r["d"], r["strain"]) for r in of["flight"]}):
        own = [r for r in of["flight"] if (r["d"], r["strain"]) == (d, strain)]
        angles, label = [r["angle"] for r in own], f"{d}D, strain {strain:g}"
        (line,) = left.loglog(angles, [r["frames_error"] for r in own], "o-", label=label)
        left.loglog(angles, [r["small_error"] for r in own], "x:", color=line.get_color())
    left.set(xlabel="turned [rad]", title="error in flight (dotted: small displacements)")
    left.legend(frameon=False, fontsize=8)
    speeds = [r["ratio"] for r in of["impact"]]
    for name, style in (("frames", "o-"), ("small", "x:")):
        middle.loglog(speeds, [r[f"{name}_error"] for r in of["impact"]], style, label=name)
    middle.set(xlabel="speed / wave speed", title="error of the impulse of a corner")
    middle.legend(frameon=False)
    names = [f"n = {r['n']}\n" + ("contact" if r["contact"] else "flight") for r in of["cost"]]
    for k, name in enumerate(("small", "frames")):
        x = np.arange(len(names)) + 0.4 * k
        right.bar(x, [r[f"{name}_step_us"] for r in of["cost"]], 0.4, label=name)
    right.set_xticks(np.arange(len(names)) + 0.2, names)
    right.set(ylabel="time of a step [µs]", title="cost", yscale="log")
    right.legend(frameon=False)
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
    return figure


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure and draw."""
    options = measure.parse(measure.parser(__doc__), argv)
    quick = options.quick
    cases = (
        [(2, 1e-2, 3.0)]
        if quick
        else [(d, *x) for d in (2, 3) for x in ((1e-2, 3.0), (1e-3, 0.95))]
    )
    rows = [
        flight(*case, angle) for case in cases for angle in ((0.1,) if quick else (0.1, 1.0, 10.0))
    ]
    rows += [impact(ratio) for ratio in ((1e-2,) if quick else (3e-2, 1e-2, 3e-3, 1e-3))]
    jax.clear_caches()
    for d in (2,) if quick else (2, 3):
        rows.append(conservation(d, 300 if quick else 10_000))
        for scheme in (jc.ContactImplicit(), jc.ContactStabilized()):
            rows.append(tumble(d, scheme, 500 if quick else 100_000 if d == 2 else 10_000))
            jax.clear_caches()
    for n in (300,) if quick else (10_000,):
        rows += [cost(n, is_contact, 100, options.repeats) for is_contact in (False, True)]
        jax.clear_caches()
    for case in ("flight", "impact", "conservation", "tumble", "cost"):
        measure.print_table([row for row in rows if row["case"] == case])
    measure.save("large_motion", rows, options.out)
    measure.save_chart(chart(rows), "large_motion", options.out)
    return rows


if __name__ == "__main__":
    main()
