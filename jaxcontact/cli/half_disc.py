"""`jaxcontact half-disc` solves the control problem of the paper's section 5 and explains it.

It simulates the motion under the reference control, optimises from u = 0, prints a summary and
writes history, control, time series, an animation and the pictures that correspond to the paper's
figures, with a page that says what they show.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import math
import platform
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

import jaxcontact as jc
from jaxcontact.cli.output import Keeper, Output
from jaxcontact.linear.memory import available_memory
from jaxcontact.optimize import LBFGS, NewtonCG, Optax, SteepestDescent
from jaxcontact.output.export import write_time_series
from jaxcontact.output.figures import draw_figures
from jaxcontact.output.page import write_page
from jaxcontact.transforms.files import atomic_write, make_folder

#: Time levels in a time series; longer motions are thinned out to about as many.
MAX_LEVELS = 150

#: Memory that a node takes at least: rows of four sparse matrices with 14 entries of 8 bytes in
#: each of two components; and what it takes per step: target, reference, control, gradient,
#: displacement and velocity, two components of 8 bytes each.
NODE_BYTES, STEP_BYTES = 4 * 14 * 2 * 8, 6 * 2 * 8

METHODS = {
    "steepest-descent": SteepestDescent(),
    "adam": Optax(optax.adam(2e-2)),
    "lbfgs": LBFGS(),
    "newton-cg": NewtonCG(),
}


def run(options: argparse.Namespace) -> int:
    """Solve the problem, write the results and return the exit code.

    Raises:
        SystemExit: with code 2 if the problem or the folder cannot be.
        SolveError: if a step was not solved.
        OSError: if a file cannot be written.
        MemoryError: if there is less memory than the problem needs at least.
    """
    output = Output(options.out)
    try:
        make_folder(output.folder)
    except OSError as error:
        options.parser.error(f"argument --out: {error}")
    try:
        check_room(options.h, options.steps)
        print("making the scene and its target, the first time with compilation ...", flush=True)
        return _solve(_problem(options), options, output)
    finally:
        if output.written:
            print(f"\nwrote to {output.folder}:")
            print("".join(f"  {name}\n" for name in output.written), end="")


def check_room(h: float, steps: int) -> None:
    """Refuse a problem that the memory cannot hold before its mesh is made.

    Raises:
        MemoryError: if there is less memory than the problem needs at least.
    """
    rings = jc.scenes.RADIUS / h
    nodes = 1.5 * rings * rings
    needed, available = nodes * (NODE_BYTES + STEP_BYTES * steps), available_memory()
    if available is not None and needed > available:
        raise MemoryError(
            f"about {nodes:.2g} nodes over {steps} steps need more than {needed / 1e9:.2g} GB of "
            f"memory, and {available / 1e9:.2g} GB are free; choose a larger --h or fewer --steps"
        )


def _problem(options: argparse.Namespace) -> jc.scenes.ControlProblem:
    parser: argparse.ArgumentParser = options.parser
    try:
        return jc.scenes.half_disc_control(options.h, options.steps, options.dt, options.gap)
    except ValueError as error:
        parser.error(str(error))


def _solve(problem: jc.scenes.ControlProblem, options: argparse.Namespace, output: Output) -> int:
    system = problem.system
    print(
        f"half disc: {system.n_nodes} nodes, {system.size} unknowns, {len(system.contact_nodes)} "
        f"contact nodes, {problem.steps} steps of {problem.dt:g} s"
    )
    with output.writing("config.json") as path:
        _write_config(path, options)
    has_bar = importlib.util.find_spec("tqdm") is not None
    if not has_bar:
        print("no progress bar; for one: pip install 'jaxcontact[progress]'")
    print("optimising, the first time with compilation before the first iteration ...", flush=True)
    keeper = Keeper(output, lambda u: float(distance(system, problem.dt, u, problem.reference)))
    try:
        result = jc.optimize(
            problem.objective,
            jnp.zeros_like(problem.reference),
            method=METHODS[options.method],
            system=system,
            dt=problem.dt,
            iterations=options.iterations,
            progress=has_bar,
            callback=keeper.see,
        )
    except BaseException as error:
        keeper.keep(getattr(error, "result", None))
        raise
    keeper.keep(result)

    print("simulating the result ...", flush=True)
    force = problem.control_scale * result.control
    trajectory = jc.simulate(problem.stepper, force)
    ledger = jc.energy(problem.stepper, trajectory, force)
    summary = _summary(problem, result, ledger)
    width = max(map(len, summary))
    print("\n" + "\n".join(f"  {name:<{width}}  {text}" for name, text in summary.items()))

    every = math.ceil(problem.steps / MAX_LEVELS)
    with output.writing("half-disc.pvd") as path:
        files = write_time_series(path, problem.scene.mesh, system, trajectory, force, every=every)
    output.written.append(f"half-disc/: {len(files) - 1} VTU files, every {every} steps")
    print("\ndrawing ...", flush=True)
    try:
        pictures = draw_figures(problem, result, keeper.distances, trajectory, ledger)
    except ImportError as error:
        print(f"\nno pictures: {error}")
        pictures = {}
    for name, figure in pictures.items():
        with output.writing(f"{name}.png") as path, atomic_write(path, "wb") as file:
            figure.savefig(file, format="png", dpi=150)
    if pictures:
        with output.writing("motion.gif") as path:
            jc.plot.animate(
                problem.scene,
                trajectory,
                path,
                values=lambda level: jnp.linalg.norm(result.control[max(level - 1, 0)], axis=1),
                label="control [MN/m²]",
                frames=24,
            )
        with output.writing("index.html") as path:
            write_page(path, summary, problem)
    return 130 if result.status is jc.Ending.INTERRUPTED else 0


@jax.jit
def distance(system: jc.System, dt: float, control: Array, reference: Array) -> Array:
    """Return the relative L2(0,T; L2) distance of a control to the reference."""
    difference = control - reference
    return jnp.sqrt(
        jc.control_dot(system, dt, difference, difference)
        / jc.control_dot(system, dt, reference, reference)
    )


def _summary(
    problem: jc.scenes.ControlProblem, result: jc.Result, ledger: jc.Energy
) -> dict[str, str]:
    history, mesh = result.history, problem.scene.mesh
    magnitude = np.linalg.norm(np.asarray(result.control), axis=2)
    clamped = np.unique(mesh.facets["clamped"])
    first, last = float(history.value[0]), result.value
    residual = np.max(np.abs(ledger.residual)) / np.max(np.asarray(ledger.total), initial=1e-300)
    end = float(distance(problem.system, problem.dt, result.control, problem.reference))
    return {
        "ended": result.status,
        "value at the start": f"{first:.6g}",
        "value at the result": f"{last:.6g} (reduced {first / last:.3g} times)",
        "value at the reference control": f"{float(problem.objective(problem.reference)):.6g}",
        "gradient norm, start and end": (
            f"{history.gradient_norm[0]:.3g}, {history.gradient_norm[-1]:.3g}"
        ),
        "relative distance to the reference": f"{end:.4f}",
        "largest control": (
            f"{np.max(magnitude):.3g}, on the clamped side {np.max(magnitude[:, clamped]):.2g}"
        ),
        "energy ledger": f"closed to {residual:.1e} of the largest energy",
        "iterations, gradients": f"{len(history.value) - 1}, {history.evaluations[-1]}",
        "time of the optimisation": f"{history.seconds[-1]:.1f} s",
    }


def _write_config(path: Path, options: argparse.Namespace) -> None:
    packages = ("jax", "jaxlib", "numpy", "scipy", "meshio", "optax")
    names = ("h", "steps", "dt", "gap", "iterations", "method")
    config = {
        "arguments": {name: getattr(options, name) for name in names},
        "versions": {"python": platform.python_version(), "jaxcontact": jc.__version__}
        | {name: importlib.metadata.version(name) for name in packages},
        "backend": jax.default_backend(),
    }
    with atomic_write(path, "w") as file:
        file.write(json.dumps(config, indent=2) + "\n")
