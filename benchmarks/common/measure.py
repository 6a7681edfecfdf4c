"""What every benchmark shares: timing, memory, machine description, JSON and charts."""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

RESULTS = Path(__file__).parents[1] / "results"


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return a command line with the options that every benchmark has."""
    arguments = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--quick", action="store_true", help="smallest sizes, a few seconds")
    arguments.add_argument("--dtype", choices=("float64", "float32"), default="float64")
    arguments.add_argument("--out", type=Path, default=RESULTS, help="folder of JSON and chart")
    arguments.add_argument("--repeats", type=int, default=5, help="runs of which the median counts")
    return arguments


def parse(arguments: argparse.ArgumentParser, argv: list[str] | None) -> argparse.Namespace:
    """Read a command line, switch float64 on and replace `dtype` by the type of that name."""
    options = arguments.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    options.dtype = jnp.dtype(options.dtype)
    return options


def seconds(function: Callable[[], Any], repeats: int = 5, budget: float = 10.0) -> float:
    """Return the median run time of a function of no arguments, [s]; compiled beforehand.

    Stops early when the budget [s] is spent, after at least two runs.
    """
    jax.block_until_ready(function())
    times = []
    while len(times) < repeats and (len(times) < 2 or sum(times) < budget):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def interleaved_seconds(
    functions: dict[str, Callable[[], Any]], repeats: int = 5, budget: float = 20.0
) -> dict[str, float]:
    """Return median run times of functions that take turns, so that a busy machine hits all.

    A timed run follows an untimed one of the same function: the one before has left its own data
    in the caches, and threads of a BLAS library that spin for a while and hold a core.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    begin = time.perf_counter()
    for turn in range(repeats):
        if turn >= 2 and time.perf_counter() - begin > budget:
            break
        for name, function in functions.items():
            jax.block_until_ready(function())
            start = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return the compiled program of a function and the time to trace and compile it, [s]."""
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - start


def memory(program: Any) -> dict[str, int]:
    """Return the bytes of a compiled program: arguments, outputs and temporaries."""
    analysis = program.memory_analysis()
    return {
        "argument_bytes": int(analysis.argument_size_in_bytes),
        "output_bytes": int(analysis.output_size_in_bytes),
        "temporary_bytes": int(analysis.temp_size_in_bytes),
    }


def peak_memory() -> float | None:
    """Return the largest memory that this process has had, [MB]; None where it is not known."""
    try:
        import resource
    except ImportError:
        return None
    unit = 1e-6 if sys.platform == "darwin" else 1.024e-3
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def machine() -> dict[str, Any]:
    """Return what the figures depend on: processor, devices and versions."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "devices": [device.device_kind for device in jax.devices()],
        "python": platform.python_version(),
        **{name: version(name) for name in ("jax", "jaxlib", "numpy", "scipy", "jaxcontact")},
    }


def _processor() -> str:
    try:
        text = subprocess.run(["lscpu"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in text.splitlines() if "Model name" in line]
    return names[0] if names else platform.machine()


def save(name: str, rows: Any, directory: Path | None = None, **settings: Any) -> Path:
    """Write the rows of a benchmark with machine and settings as JSON; return the path."""
    directory = RESULTS if directory is None else Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{name}.json"
    record = {"benchmark": name, "machine": machine(), "settings": settings, "rows": rows}
    path.write_text(json.dumps(record, indent=1, default=str) + "\n")
    print(f"wrote {path}")
    return path


def save_chart(figure: Any, name: str, directory: Path | None = None) -> Path:
    """Write a matplotlib figure as PNG next to the JSON; return the path."""
    directory = RESULTS if directory is None else Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{name}.png"
    figure.savefig(path, dpi=130, bbox_inches="tight")
    print(f"wrote {path}")
    return path


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print rows of equal keys as an aligned table."""
    if not rows:
        return
    names = list(rows[0])
    cells = [[_format(row.get(name)) for name in names] for row in rows]
    widths = [max(len(name), *(len(row[i]) for row in cells)) for i, name in enumerate(names)]
    print("  ".join(name.rjust(width) for name, width in zip(names, widths, strict=True)))
    for row in cells:
        print("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)))


def _format(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
