"""The command line; what a command needs is loaded when it runs, so that the help is there at once.

    jaxcontact half-disc             the control problem of the paper's section 5
    jaxcontact run scene.toml        simulate a scene file, or print it as a Python program
    jaxcontact check scene.toml      say what is wrong with a scene file, or what it describes
    jaxcontact info mesh.msh         sets, regions, quality and Courant number of a mesh

An application, so this is the one place that switches float64 on and turns words into objects.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxcontact import __version__

#: Words for the command line only; in Python a method is an object.
METHODS = ("steepest-descent", "adam", "lbfgs", "newton-cg")
#: Radius of the half disc, `jaxcontact.scenes.RADIUS`, and the largest number of steps.
RADIUS, MOST = 15.0, 2**31 - 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Args:
        arguments: words after the program's name; default those of the process.

    Returns:
        0 when everything was done, 1 when a time step could not be solved, a file could not be
        written or the memory does not hold the problem, 2 when a scene file is wrong, 130 after
        Ctrl-C.

    Raises:
        SystemExit: with code 2 and a message on stderr if an argument is wrong.
    """
    options = _parser().parse_args(arguments)
    try:
        _configure()
        return importlib.import_module(options.module).run(options)
    except (RuntimeError, OSError, MemoryError) as error:
        # A `SolveError` is a RuntimeError.
        print(f"jaxcontact: {error}", file=sys.stderr)
        return 1
    except ValueError as error:
        print(f"jaxcontact: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxcontact: interrupted", file=sys.stderr)
        return 130


def _configure() -> None:
    """Switch float64 on, and keep compiled programs for the next time, if nothing else is said."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
        folder = (Path(home) if home else Path.home() / ".cache") / "jaxcontact"
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="jaxcontact", description="Dynamic contact in JAX.")
    parser.add_argument("--version", action="version", version=f"jaxcontact {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, module: str, help: str, description: str) -> argparse.ArgumentParser:
        added = commands.add_parser(
            name,
            help=help,
            description=description,
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        added.set_defaults(module=f"jaxcontact.cli.{module}", parser=added, command=name)
        return added

    add = command(
        "half-disc",
        "half_disc",
        "optimal control of a half disc that bounces on a plane",
        "Solve the optimal control problem of a viscoelastic half disc that bounces on a rigid "
        "plane (Mueller and Schiela, section 5), starting from no control.",
    ).add_argument
    add("--h", type=_mesh_size, default=1.25, help="mesh size [m]; the radius is 15 m")
    add("--steps", type=_count, default=150, help="time steps; the paper has 150 and 1500")
    add("--dt", type=_positive, default=5e-5, help="length of a time step [s]")
    add("--gap", type=_not_negative, default=0.8, help="height of the body above the plane [m]")
    add("--iterations", type=_count, default=400, help="most iterations of the optimisation")
    add("--method", choices=METHODS, default="steepest-descent", help="optimisation method")
    add("--out", type=Path, default=Path("half-disc"), help="folder for the results")

    add = command(
        "run",
        "scene_run",
        "simulate a scene file",
        "Simulate the scene that a TOML file describes and write what it asks for.",
    ).add_argument
    add("scene", type=Path, help="scene file, TOML")
    add("--out", type=Path, default=None, help="folder for the results; None is the file's name")
    add("--as-python", action="store_true", help="print the Python program instead of running it")

    add = command(
        "check",
        "scene_run",
        "check a scene file",
        "Say everything that is wrong with a scene file, or what system it makes.",
    ).add_argument
    add("scene", type=Path, help="scene file, TOML")

    add = command(
        "info",
        "mesh_info",
        "describe a mesh file",
        "Print the facet sets, regions, bodies and quality of a mesh, and its Courant number.",
    ).add_argument
    add("mesh", type=Path, help="mesh file of any format of meshio")
    add("--dimension", type=_count, default=None, help="dimension of the cells to read")
    add("--young", type=_positive, default=None, help="Young's modulus [Pa]")
    add("--poisson", type=float, default=0.3, help="Poisson's ratio")
    add("--density", type=_positive, default=1.0, help="density [kg/m^d]")
    add("--dt", type=_positive, default=None, help="length of a time step [s]")
    return parser


def _mesh_size(text: str) -> float:
    return _checked(text, float, lambda h: 0.0 < h <= RADIUS, f"above 0 and at most {RADIUS:g}")


def _positive(text: str) -> float:
    return _checked(text, float, lambda value: 0.0 < value < math.inf, "a positive number")


def _not_negative(text: str) -> float:
    return _checked(text, float, lambda value: 0.0 <= value < math.inf, "zero or a positive number")


def _count(text: str) -> int:
    wanted = f"a whole number from 1 to {MOST}"
    return _checked(text, int, lambda value: 1 <= value <= MOST, wanted)


def _checked(text: str, kind: type, is_valid: Callable[..., bool], wanted: str):
    with contextlib.suppress(ValueError):
        if is_valid(value := kind(text)):
            return value
    raise argparse.ArgumentTypeError(f"must be {wanted}, got {text!r}")
