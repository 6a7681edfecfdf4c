"""Dataclasses of arrays in one .npz file: every array under its path, their structure as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcontact.transforms.files import atomic_write, check_is_file
from jaxcontact.transforms.traced import is_traced

#: Name of the entry that holds the structure, and the version of its form.
STRUCTURE, VERSION = "structure", 1


def save_dataclass(path: str | Path, node: object) -> None:
    """Write a dataclass of arrays, numbers, None, and dataclasses and dictionaries of these.

    Raises:
        ValueError: if an array is traced.
        OSError: if the file cannot be written.
    """
    if is_traced(node):
        raise ValueError(f"a traced {type(node).__name__} has no values to save; save it outside")
    arrays: dict[str, Any] = {}
    structure = {"version": VERSION, "node": _take_apart(node, type(node).__name__, arrays)}
    arrays[STRUCTURE] = np.asarray(json.dumps(structure))
    with atomic_write(path, "wb") as file:
        np.savez_compressed(file, **arrays)


def load_dataclass(path: str | Path, kinds: Iterable[type]) -> Any:
    """Read what `save_dataclass` wrote; the first one of the kinds is what the file must hold.

    Raises:
        OSError: if there is no such file, it is a folder, or it may not be read.
        ValueError: if the file is damaged or holds something else.
        RuntimeError: if it holds float64 while JAX has it switched off.
    """
    kinds = list(kinds)
    wanted = kinds[0].__name__
    check_is_file(path)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
            structure = json.loads(str(arrays[STRUCTURE]))
            if structure["version"] != VERSION or structure["node"]["kind"] != wanted:
                raise ValueError("it is of another version or kind")
            return _put_together(structure["node"], arrays, {kind.__name__: kind for kind in kinds})
    except (PermissionError, RuntimeError):
        raise
    # Whatever the readers of zip, npy and JSON raise on bytes that they do not expect.
    except Exception as error:
        raise ValueError(
            f"{path} cannot be read as a saved {wanted} ({type(error).__name__}: {error}); it is "
            "damaged or another kind of file. Load a copy, or make and save it again"
        ) from error


def _take_apart(node: object, name: str, arrays: dict[str, np.ndarray]) -> dict:
    """Return the structure of a node; its arrays go into the dictionary."""
    if is_dataclass(node):
        parts = {
            part.name: _take_apart(getattr(node, part.name), f"{name}.{part.name}", arrays)
            for part in fields(node)
        }
        return {"kind": type(node).__name__, "parts": parts}
    if isinstance(node, dict):
        entries = {key: _take_apart(x, f"{name}[{key}]", arrays) for key, x in node.items()}
        return {"entries": entries}
    if node is None or isinstance(node, bool | int | float | str):
        return {"value": node}
    arrays[name] = np.asarray(node)
    return {"array": name, "is_on_host": isinstance(node, np.ndarray)}


def _put_together(structure: Any, arrays: Any, kinds: dict[str, type]) -> Any:
    if "kind" in structure:
        parts = structure["parts"].items()
        return kinds[structure["kind"]](
            **{name: _put_together(part, arrays, kinds) for name, part in parts}
        )
    if "entries" in structure:
        return {key: _put_together(x, arrays, kinds) for key, x in structure["entries"].items()}
    if "value" in structure:
        return structure["value"]
    values = arrays[structure["array"]]
    if structure["is_on_host"]:
        return values
    if values.dtype == np.float64 and not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "the file holds float64, which is switched off in JAX. Add "
            "jax.config.update('jax_enable_x64', True) at the start of the program"
        )
    return jnp.asarray(values)
