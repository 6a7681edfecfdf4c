"""The command line: `jaxcontact half-disc` solves the control problem of the paper's section 5.

It simulates the motion under the reference control, optimises from u = 0, prints a summary and
writes history, control, time series and the pictures that correspond to the paper's figures.
An application, so this is the one place that switches float64 on and turns words into objects.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import importlib.metadata
import importlib.util
import json
import math
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

import jaxcontact as jc
from jaxcontact.linear.memory import available_memory
from jaxcontact.optimize import LBFGS, NewtonCG, Optax, SteepestDescent
from jaxcontact.output.export import write_time_series
from jaxcontact.output.figures import draw_figures
from jaxcontact.transforms.files import atomic_write, make_folder

#: Time levels in a time series; longer motions are thinned out to about as many.
MAX_LEVELS = 150

#: Memory that a node takes at least: rows of four sparse matrices with 14 entries of 8 bytes in
#: each of two components; and what it takes per step: target, reference, control, gradient,
#: displacement and velocity, two components of 8 bytes each.
NODE_BYTES, STEP_BYTES = 4 * 14 * 2 * 8, 6 * 2 * 8

# Words for the command line only; in Python a method is an object.
METHODS = {
    "steepest-descent": SteepestDescent(),
    "adam": Optax(optax.adam(2e-2)),
    "lbfgs": LBFGS(),
    "newton-cg": NewtonCG(),
}


@dataclass
class Output:
    """The folder of results: every file that was written is reported once."""

    folder: Path
    """Where the files go."""

    written: list[str] = field(default_factory=list)
    """Names of the files so far, relative to the folder."""

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Return the path for a file, and note it down once it is written."""
        path = self.folder / name
        note = f"{name} (replaced)" if path.exists() else name
        yield path
        self.written.append(note)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Args:
        arguments: words after the program's name; default those of the process.

    Returns:
        0 when everything was done, 1 when a time step could not be solved, a file could not be
        written or the memory does not hold the problem, 130 after Ctrl-C.

    Raises:
        SystemExit: with code 2 and a message on stderr if an argument is wrong.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    output = Output(options.out)
    try:
        make_folder(output.folder)
    except OSError as error:
        parser.error(f"argument --out: {error}")
    jax.config.update("jax_enable_x64", True)
    try:
        _check_room(options.h, options.steps)
        return _solve(_problem(parser, options), options, output)
    except (jc.SolveError, OSError, MemoryError) as error:
        print(f"jaxcontact: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("jaxcontact: interrupted", file=sys.stderr)
        return 130
    finally:
        if output.written:
            print(f"\nwrote to {output.folder}:")
            print("".join(f"  {name}\n" for name in output.written), end="")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="jaxcontact", description="Dynamic contact in JAX.")
    version = f"jaxcontact {importlib.metadata.version('jaxcontact')}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    half_disc = commands.add_parser(
        "half-disc",
        help="optimal control of a half disc that bounces on a plane",
        description="Solve the optimal control problem of a viscoelastic half disc that bounces "
        "on a rigid plane (Mueller and Schiela, section 5), starting from no control.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = half_disc.add_argument
    add("--h", type=_mesh_size, default=1.25, help="mesh size [m]; the radius is 15 m")
    add("--steps", type=_count, default=150, help="time steps; the paper has 150 and 1500")
    add("--dt", type=_positive, default=5e-5, help="length of a time step [s]")
    add("--gap", type=_not_negative, default=0.8, help="height of the body above the plane [m]")
    add("--iterations", type=_count, default=400, help="most iterations of the optimisation")
    add("--method", choices=METHODS, default="steepest-descent", help="optimisation method")
    add("--out", type=Path, default=Path("half-disc"), help="folder for the results")
    return parser


def _check_room(h: float, steps: int) -> None:
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


def _problem(parser: argparse.ArgumentParser, options: argparse.Namespace):
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
    distances = []
    result = jc.optimize(
        problem.objective,
        jnp.zeros_like(problem.reference),
        method=METHODS[options.method],
        system=system,
        dt=problem.dt,
        iterations=options.iterations,
        progress=has_bar,
        callback=lambda _iteration, control, _value, _norm: distances.append(
            float(_distance(system, problem.dt, control, problem.reference))
        ),
    )
    # Ctrl-C may fall between an iteration and its callback.
    distance = np.full(len(result.history.value), np.nan)
    distance[: len(distances)] = distances
    with output.writing("history.csv") as path:
        _write_history(path, result.history, distance)
    with output.writing("control.npz") as path, atomic_write(path, "wb") as file:
        np.savez_compressed(file, control=np.asarray(result.control))

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
    try:
        figures = draw_figures(problem, result, distance, trajectory, ledger)
    except ImportError as error:
        print(f"\nno pictures: {error}")
        figures = {}
    for name, figure in figures.items():
        with output.writing(f"{name}.png") as path, atomic_write(path, "wb") as file:
            figure.savefig(file, format="png", dpi=150)
    return 130 if result.status is jc.Ending.INTERRUPTED else 0


@jax.jit
def _distance(system: jc.System, dt: float, control: Array, reference: Array) -> Array:
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
    return {
        "ended": result.status,
        "value at the start": f"{first:.6g}",
        "value at the result": f"{last:.6g} (reduced {first / last:.3g} times)",
        "value at the reference control": f"{float(problem.objective(problem.reference)):.6g}",
        "gradient norm, start and end": (
            f"{history.gradient_norm[0]:.3g}, {history.gradient_norm[-1]:.3g}"
        ),
        "relative distance to the reference": (
            f"{float(_distance(problem.system, problem.dt, result.control, problem.reference)):.4f}"
        ),
        "largest control": (
            f"{np.max(magnitude):.3g}, on the clamped side {np.max(magnitude[:, clamped]):.2g}"
        ),
        "energy ledger": f"closed to {residual:.1e} of the largest energy",
        "iterations, gradients": f"{len(history.value) - 1}, {history.evaluations[-1]}",
        "time of the optimisation": f"{history.seconds[-1]:.1f} s",
    }


def _write_config(path: Path, options: argparse.Namespace) -> None:
    packages = ("jaxcontact", "jax", "jaxlib", "numpy", "scipy", "meshio", "optax")
    config = {
        "arguments": {name: value for name, value in vars(options).items() if name != "out"},
        "versions": {"python": platform.python_version()}
        | {name: importlib.metadata.version(name) for name in packages},
        "backend": jax.default_backend(),
    }
    with atomic_write(path, "w") as file:
        file.write(json.dumps(config, indent=2) + "\n")


def _write_history(path: Path, history: jc.History, distance: np.ndarray) -> None:
    columns = (history.value, history.gradient_norm, distance, history.evaluations)
    with atomic_write(path, "w") as file:
        names = "iteration value gradient_norm distance_to_reference evaluations"
        rows = csv.writer(file)
        rows.writerow(names.split())
        for iteration, row in enumerate(zip(*columns, strict=True)):
            rows.writerow([iteration, *(value.item() for value in row)])


def _mesh_size(text: str) -> float:
    radius = jc.scenes.RADIUS
    return _checked(text, float, lambda h: 0.0 < h <= radius, f"above 0 and at most {radius:g}")


def _positive(text: str) -> float:
    return _checked(text, float, lambda value: 0.0 < value < math.inf, "a positive number")


def _not_negative(text: str) -> float:
    return _checked(text, float, lambda value: 0.0 <= value < math.inf, "zero or a positive number")


def _count(text: str) -> int:
    most = np.iinfo(np.int32).max
    wanted = f"a whole number from 1 to {most}"
    return _checked(text, int, lambda value: 1 <= value <= most, wanted)


def _checked(text: str, kind: type, is_valid: Callable[..., bool], wanted: str):
    with contextlib.suppress(ValueError):
        if is_valid(value := kind(text)):
            return value
    raise argparse.ArgumentTypeError(f"must be {wanted}, got {text!r}")
