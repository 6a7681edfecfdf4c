"""From the tables of a scene file to the Python program that does the same.

`jaxcontact run` runs this program, so that what `--as-python` prints is what was run. Every value
is written by its repr, after it was checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxcontact.cli.scene_file import SCHEMES

_START = """\
from pathlib import Path

import jax
import numpy as np

import jaxcontact as jc

jax.config.update("jax_enable_x64", True)
"""
_LINEAR = '''

def linear(rows):
    """Return the linear interpolation of rows (time, values ...), a function of time."""
    times, *columns = np.transpose(rows)
    return lambda t: np.squeeze([np.interp(t, times, column) for column in columns])

'''
#: What each output is written by.
_OUTPUTS = {
    "series": 'jc.export.write_time_series(out / "motion.pvd", mesh, system, motion)',
    "animation": 'jc.plot.animate(scene, motion, out / "motion.gif")',
    "force": """\
jc.plot.plot_force(motion).figure.savefig(out / "force.png", dpi=150)
force = np.asarray(motion.contact_force).sum(axis=1)
np.savetxt(out / "force.csv", force, header="total contact force of each step [N]")""",
    "stress": """\
stress = np.asarray(jc.stress(scene, motion.displacement).von_mises)
worst = int(np.argmax(stress.max(axis=1)))
unit = ["N", "N/m", "Pa"][mesh.dimension - 1]
picture = jc.plot.plot_body(
    scene, motion.displacement[worst], stress[worst], label=f"von Mises stress [{unit}]"
)
picture.set_title(f"largest stress, t = {float(motion.time[worst]):.3g} s")
picture.figure.savefig(out / "stress.png", dpi=150)""",
    "trajectory": 'motion.save(out / "motion.npz")',
}


@dataclass(frozen=True)
class Program:
    """The program in the order in which it runs."""

    build: str
    """Scene, system and stepper."""

    simulate: str
    """The motion."""

    output: str
    """What is written."""

    @property
    def text(self) -> str:
        """The program as a whole."""
        return f"{self.build}\n{self.simulate}\n{self.output}"


def scene_program(tables: Mapping[str, Any], folder: Path, out: Path) -> Program:
    """Return the program of checked tables.

    Args:
        tables: from `read_scene_file`.
        folder: folder of the scene file, where mesh files are looked for.
        out: folder for the results.
    """
    run, schedule = tables["run"], tables.get("schedule", {})
    scheme = SCHEMES[run.get("scheme", "contact-implicit")]
    build = [
        _START + (_LINEAR if schedule else ""),
        *_mesh(tables, folder),
        *_call("scene = jc.Scene(", ["mesh=mesh", *_scene(tables)]),
        "system = jc.discretize(scene)",
        f"stepper = jc.prepare(system, dt={run['dt']!r}, scheme=jc.{scheme}())",
    ]
    simulate, options = [f"steps = {run['steps']!r}"], ["stepper", "steps=steps"]
    if tables.get("start"):
        fields = [f"{name}={value!r}" for name, value in tables["start"].items()]
        simulate += _call("initial = jc.State.of(", ["scene", *fields])
        options.append("initial=initial")
    if schedule:
        simulate += _call("schedule = jc.Schedule(", _schedule(schedule))
        options.append("schedule=schedule")
    if run.get("save_every", 1) > 1:
        options.append(f"save_every={run['save_every']}")
    simulate += _call("motion = jc.simulate(", options)
    simulate.append("print(motion)")
    wanted = tables.get("output", {})
    output = [
        f"out = Path({str(out)!r})",
        "out.mkdir(parents=True, exist_ok=True)",
        *(lines for name, lines in _OUTPUTS.items() if wanted.get(name)),
    ]
    return Program(*("\n".join([*part, ""]) for part in (build, simulate, output)))


def _mesh(tables: Mapping[str, Any], folder: Path) -> list[str]:
    table = tables["mesh"]
    if all(isinstance(part, dict) for part in table.values()):
        bodies = [f"{name!r}: {_body(part, folder)}" for name, part in table.items()]
        lines = _call("mesh = jc.join({", bodies, "})")
    else:
        lines = [f"mesh = {_body(table, folder)}"]
    for name, part in tables.get("sets", {}).items():
        lines.append(f"mesh = mesh.with_set({name!r}, lambda x, n: {_predicate(part)})")
    return lines


def _body(table: Mapping[str, Any], folder: Path) -> str:
    if "file" in table:
        more = f", dimension={table['dimension']}" if "dimension" in table else ""
        made = f"jc.read_mesh({str(folder / table['file'])!r}{more})"
    else:
        known = ("shape", "h", "translation", "contact")
        (size,) = (value for name, value in table.items() if name not in known)
        more = f", contact={tuple(table['contact'])!r}" if "contact" in table else ""
        size = tuple(size) if isinstance(size, list) else size
        made = f"jc.meshes.{table['shape']}({size!r}, h={table['h']!r}{more})"
    moved = f".moved(translation={table['translation']!r})" if "translation" in table else ""
    return made + moved


def _predicate(table: Mapping[str, Any]) -> str:
    """Return a condition on centres x and outward normals n of facets."""
    conditions = []
    if "normal" in table:
        length = math.hypot(*table["normal"])
        unit = [component / length for component in table["normal"]]
        conditions.append(f"(n @ np.array({unit!r}) > 0.7)")
    if "low" in table:
        conditions.append(f"np.all(x >= {table['low']!r}, axis=1)")
    if "high" in table:
        conditions.append(f"np.all(x <= {table['high']!r}, axis=1)")
    return " & ".join(conditions) or "np.ones(len(x), bool)"


def _scene(tables: Mapping[str, Any]) -> list[str]:
    material, supports, loads = (tables.get(name, {}) for name in ("material", "supports", "loads"))
    if all(isinstance(part, dict) for part in material.values()):
        regions = [f"{name!r}: {_material(part)}" for name, part in material.items()]
        lines = ["\n    ".join(_call("material={", regions, "}"))]
    else:
        lines = [f"material={_material(material)}"]
    if supports.get("clamped"):
        lines.append(f"clamped={tuple(supports['clamped'])!r}")
    if supports.get("rollers"):
        held = {k: None if v == "normal" else v for k, v in supports["rollers"].items()}
        lines.append(f"rollers={held!r}")
    if tables.get("contact"):
        obstacles = [f"{name!r}: {_obstacle(part)}" for name, part in tables["contact"].items()]
        lines.append("\n    ".join(_call("contact={", obstacles, "}")))
    lines += [f"{name}={value!r}" for name, value in loads.items()]
    return lines + ["large_rotation=True"] * tables["run"].get("large_rotation", False)


def _material(table: Mapping[str, Any]) -> str:
    return f"jc.KelvinVoigt({', '.join(f'{name}={value!r}' for name, value in table.items())})"


def _obstacle(table: Mapping[str, Any]) -> str:
    kind = table["obstacle"]
    if kind == "plane":
        return f"jc.HalfSpace(point={table['point']!r}, normal={table['normal']!r})"
    if kind == "body":
        more = f", along={table['along']!r}" if "along" in table else ""
        return f"jc.Facets({table['facets']!r}{more})"
    inside = ", inside=True" if kind == "bowl" else ""
    return f"jc.Ball(center={table['center']!r}, radius={table['radius']!r}{inside})"


def _schedule(table: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, value in table.items():
        levels = ", levels=True" if name in ("obstacle", "motion") else ""
        if isinstance(value, list):
            lines.append(f"{name}=jc.sample(linear({value!r}), stepper, steps)")
            continue
        parts = [
            f"{part!r}: jc.sample(linear({rows!r}), stepper, steps{levels})"
            for part, rows in value.items()
        ]
        lines.append(f"{name}={{{', '.join(parts)}}}")
    return lines


def _call(start: str, arguments: list[str], end: str = ")") -> list[str]:
    """Return a call, one argument a line if it is long."""
    line = start + ", ".join(arguments) + end
    if len(line) <= 88 and "\n" not in line:
        return [line]
    return [start, *(f"    {argument}," for argument in arguments), end]
