"""Scene files: TOML tables whose keys are checked one by one, by name, with what is allowed.

[mesh]              a shape or a file; or several bodies, [mesh.NAME], that are joined
[sets.NAME]         boundary facets chosen by the place of their centre and by their normal
[material]          one, or one for each region, [material.NAME]
[contact.NAME]      what a facet set may touch
[supports]          clamped sets and rollers
[loads]             constant forces
[schedule]          forces and motions as rows of a time and values, linear in between
[start]             displacement and velocity at time zero
[run]               time step, number of steps, scheme, whether free bodies turn
[output]            what is written
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any


class SceneFileError(ValueError):
    """A scene file that cannot be read; the message has one line for each wrong key."""


@dataclass(frozen=True)
class Key:
    """What the value of a key has to be."""

    is_valid: Callable[[Any], bool]
    """Whether a value is allowed."""

    wanted: str
    """What is allowed, in words."""

    is_required: bool = False
    """Whether the key must be there."""


Keys = Mapping[str, Key]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_vector(value: Any, length: int | None = None) -> bool:
    is_list = isinstance(value, list) and all(map(_is_number, value))
    return is_list and len(value) in ((1, 2, 3) if length is None else (length,))


def _is_rows(value: Any) -> bool:
    is_list = isinstance(value, list) and all(isinstance(row, list) for row in value)
    return (
        is_list
        and len(value) > 1
        and all(all(map(_is_number, row)) and len(row) == len(value[0]) > 1 for row in value)
    )


def _by_name(is_valid: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, dict) and all(map(is_valid, value.values()))


def _choice(*names: str) -> Key:
    return Key(lambda value: value in names, "one of " + ", ".join(map(repr, names)), True)


NUMBER = Key(_is_number, "a number")
POSITIVE = Key(lambda x: _is_number(x) and x > 0, "a positive number")
LENGTH = Key(POSITIVE.is_valid, "a positive length [m]", True)
COUNT = Key(lambda x: type(x) is int and x > 0, "a positive whole number")
FLAG = Key(lambda x: isinstance(x, bool), "true or false")
TEXT = Key(lambda x: isinstance(x, str) and x != "", "a text")
VECTOR = Key(_is_vector, "a list of as many numbers as the mesh has dimensions")
PLACE = Key(_is_vector, VECTOR.wanted, True)
NAMES = Key(lambda x: isinstance(x, list) and all(isinstance(n, str) for n in x), "a list of names")
VECTORS = Key(_by_name(_is_vector), "a table of vectors by name")
ROLLERS = Key(
    _by_name(lambda x: x == "normal" or _is_vector(x)), "a table by facet set: 'normal' or a vector"
)
FIELD = Key(
    lambda x: _is_vector(x) or VECTORS.is_valid(x), "a vector, or a table of vectors by region"
)
ROWS = Key(_is_rows, "a list of rows [time, values ...], all of one length")
ROWS_BY_NAME = Key(_by_name(_is_rows), "a table by name of rows [time, values ...]")

#: Keys of a mesh by its shape.
SHAPES: Mapping[str, Keys] = {
    "interval": {"length": LENGTH},
    "rectangle": {"lengths": Key(lambda x: _is_vector(x, 2), "two lengths [m]", True)},
    "box": {"lengths": Key(lambda x: _is_vector(x, 3), "three lengths [m]", True)},
    "disc": {"radius": LENGTH, "contact": Key(lambda x: _is_vector(x, 2), "two angles [degrees]")},
    "half_disc": {"radius": LENGTH},
    "ball": {"radius": LENGTH},
    "half_ball": {"radius": LENGTH},
}
PLACED: Keys = {"translation": VECTOR}
FILE: Keys = {"file": TEXT, "dimension": COUNT}
MATERIAL: Keys = {
    "young": Key(POSITIVE.is_valid, "a positive number [Pa]", True),
    "poisson": Key(_is_number, "a number", True),
    "density": POSITIVE,
    "bulk_viscosity": NUMBER,
    "shear_viscosity": NUMBER,
}
OBSTACLES: Mapping[str, Keys] = {
    "plane": {"point": PLACE, "normal": PLACE},
    "ball": {"center": PLACE, "radius": LENGTH},
    "bowl": {"center": PLACE, "radius": LENGTH},
    "body": {"facets": Key(TEXT.is_valid, "the name of a facet set", True), "along": VECTOR},
}
SETS: Keys = {"normal": VECTOR, "low": VECTOR, "high": VECTOR}
SCHEMES = {
    "contact-implicit": "ContactImplicit",
    "contact-stabilized": "ContactStabilized",
    "redistributed-mass": "RedistributedMass",
    "backward-euler": "BackwardEuler",
    "trapezoidal": "Trapezoidal",
}
SECTIONS: Mapping[str, Keys] = {
    "supports": {"clamped": NAMES, "rollers": ROLLERS},
    "loads": {"body_force": VECTOR, "traction": VECTORS},
    "schedule": {
        "traction": ROWS_BY_NAME,
        "pressure": ROWS_BY_NAME,
        "body_force": ROWS,
        "obstacle": ROWS_BY_NAME,
        "motion": ROWS_BY_NAME,
    },
    "start": {"displacement": FIELD, "velocity": FIELD},
    "run": {
        "dt": Key(POSITIVE.is_valid, "a positive time [s]", True),
        "steps": Key(COUNT.is_valid, COUNT.wanted, True),
        "save_every": COUNT,
        "large_rotation": FLAG,
        "scheme": Key(_choice(*SCHEMES).is_valid, _choice(*SCHEMES).wanted),
    },
    "output": dict.fromkeys(("series", "animation", "force", "stress", "trajectory"), FLAG),
}


def read_scene_file(path: str | Path) -> dict[str, Any]:
    """Return the tables of a scene file, all of them checked.

    Raises:
        OSError: if the file cannot be read.
        SceneFileError: if it is no TOML, or a key is unknown, missing, or has a wrong value; every
            one of them has a line.
    """
    try:
        with open(path, "rb") as file:
            tables = tomllib.load(file)
    except tomllib.TOMLDecodeError as error:
        raise SceneFileError(f"{path}: no TOML: {error}") from error
    wrong = _check_file(tables)
    if wrong:
        raise SceneFileError("\n".join(f"{path}: {line}" for line in wrong))
    return tables


def _check_file(tables: Mapping[str, Any]) -> list[str]:
    """Return a line for each thing that is wrong."""
    named = {"mesh": True, "material": True, "sets": False, "contact": False}
    known = [*named, *SECTIONS]
    wrong = [
        f"[{name}] is unknown; {_nearest(name, known)}" for name in tables if name not in known
    ]
    wrong += [f"[{name}] is missing" for name in ("mesh", "material", "run") if name not in tables]
    for name, table in tables.items():
        if name not in known:
            continue
        if not isinstance(table, dict):
            wrong.append(f"{name} must be a table: [{name}]")
        elif name in SECTIONS:
            wrong += _check_table(name, table, SECTIONS[name])
        elif named[name] and not all(isinstance(part, dict) for part in table.values()):
            wrong += _check_part(name, name, table)
        else:
            for part, values in table.items():
                where = f"{name}.{part}"
                if isinstance(values, dict):
                    wrong += _check_part(where, name, values)
                else:
                    wrong.append(f"{where} must be a table: [{where}]")
    return wrong


def _check_part(where: str, kind: str, table: Mapping[str, Any]) -> list[str]:
    """Return what is wrong in a mesh, a material, a facet set or an obstacle."""
    if kind == "material":
        return _check_table(where, table, MATERIAL)
    if kind == "sets":
        return _check_table(where, table, SETS)
    if kind == "contact":
        choice, ways = "obstacle", OBSTACLES
    elif "file" in table:
        return _check_table(where, table, {**FILE, **PLACED})
    else:
        choice, ways = "shape", SHAPES
    key = _choice(*ways)
    if table.get(choice) not in ways:
        more = " or a file = ..." if choice == "shape" else ""
        return [f"[{where}] needs {choice} = {key.wanted}{more}; got {table.get(choice)!r}"]
    keys = {choice: key, **ways[table[choice]]}
    if choice == "shape":
        keys |= {"h": LENGTH, **PLACED}
    return _check_table(where, table, keys)


def _check_table(where: str, table: Mapping[str, Any], keys: Keys) -> list[str]:
    """Return a line for each key of a table that is unknown, missing or has a wrong value."""
    wrong = []
    for name, value in table.items():
        if name not in keys:
            wrong.append(f"[{where}] has no key {name!r}; {_nearest(name, list(keys))}")
        elif not keys[name].is_valid(value):
            wrong.append(f"[{where}] {name} must be {keys[name].wanted}, got {value!r}")
    missing = [name for name, key in keys.items() if key.is_required and name not in table]
    return wrong + [f"[{where}] needs {name}, {keys[name].wanted}" for name in missing]


def _nearest(name: str, known: list[str]) -> str:
    """Return what was meant, and everything that there is."""
    near = difflib.get_close_matches(name, known, 1)
    meant = f"do you mean {near[0]!r}? " if near else ""
    return f"{meant}there are {', '.join(known)}"
