"""`jaxcontact run` and `jaxcontact check`: a scene file is the short form of a Python program."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from jaxcontact.cli.scene_file import read_scene_file
from jaxcontact.cli.scene_program import scene_program


def run(options: argparse.Namespace) -> int:
    """Run, print or check the program of a scene file.

    Raises:
        ValueError: if the file or the scene is wrong.
        OSError: if a file cannot be read or written.
        SolveError: if a step was not solved.
    """
    path: Path = options.scene
    tables = read_scene_file(path)
    out = getattr(options, "out", None) or Path(path.stem)
    program = scene_program(tables, path.parent, out)
    if getattr(options, "as_python", False):
        print(program.text, end="")
        return 0
    names: dict = {"__name__": "scene"}
    print(f"{path}: making the scene, and compiling for it ...", flush=True)
    _execute(program.build, path, names)
    print(f"  {names['mesh']}\n  {names['stepper']}")
    if options.command == "check":
        print(f"{path}: nothing is wrong")
        return 0
    print("simulating, the first time with compilation ...", flush=True)
    begin = time.perf_counter()
    _execute(program.simulate, path, names)
    print(f"  in {time.perf_counter() - begin:.1f} s")
    before = _times(out)
    _execute(program.output, path, names)
    written = sorted(name for name, when in _times(out).items() if before.get(name) != when)
    print(f"wrote to {out}: {', '.join(written) or 'nothing, [output] asks for nothing'}")
    return 0


def _execute(source: str, path: Path, names: dict) -> None:
    """Run a part of the program; its values were checked and are literals."""
    exec(compile(source, f"{path} as Python", "exec"), names)


def _times(folder: Path) -> dict[str, int]:
    """Return when each file of a folder was written."""
    return {file.name: file.stat().st_mtime_ns for file in folder.glob("*")}
