"""What an optimisation returns, and how it is kept in a file."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


@dataclass(frozen=True)
class History:
    """The course of an optimisation; entry 0 is the start, K iterations."""

    value: np.ndarray
    """Value of the objective, (K+1,)."""

    gradient_norm: np.ndarray
    """Norm of the gradient, (K+1,); with bounds of u - P(u - G)."""

    evaluations: np.ndarray
    """Evaluations of value and gradient so far, (K+1,) int."""

    hessian_products: np.ndarray
    """Products with the Hessian so far, (K+1,) int."""

    seconds: np.ndarray
    """Time since the start, compilation included, (K+1,) [s]."""

    def to_csv(self, path: str | Path) -> None:
        """Write one line per iteration, with a header line."""
        names = [column.name for column in fields(self)]
        with open(path, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["iteration", *names])
            columns = [getattr(self, name).tolist() for name in names]
            writer.writerows((k, *row) for k, row in enumerate(zip(*columns, strict=True)))


@dataclass(frozen=True)
class Result:
    """The best control found, with the course of the optimisation."""

    control: Array = field(repr=False)
    """The control with the lowest value that was met, (T, N, d)."""

    parameters: Array = field(repr=False)
    """What was optimised: the control itself, or the argument of the map `controls`."""

    value: float
    """Value of the objective at the control."""

    history: History = field(repr=False)
    """One entry per iteration."""

    status: str
    """Why the optimisation ended, in words."""

    stationarity: Any = None
    """Certificate of strong stationarity; None if there is none."""

    method: str = ""
    """Name of the method."""

    state: Any = field(default=None, repr=False)
    """Everything the method needs to go on as if it had not been interrupted."""

    def save(self, path: str | Path) -> None:
        """Write the result to an .npz file, from which `load_result` and `optimize` go on."""
        names = [column.name for column in fields(History)]
        data = {f"history_{name}": getattr(self.history, name) for name in names}
        for number, leaf in enumerate(jax.tree.leaves(self.state)):
            data[f"state_{number:03d}"] = np.asarray(leaf)
        with open(path, "wb") as file:  # a file object: NumPy would append .npz to a bare name
            np.savez_compressed(
                file,
                control=np.asarray(self.control),
                parameters=np.asarray(self.parameters),
                value=self.value,
                status=self.status,
                method=self.method,
                **data,
            )


def load_result(path: str | Path) -> Result:
    """Read a result that `Result.save` wrote; hand it to `optimize` as start to go on.

    Raises:
        ValueError: if the file holds something else.
    """
    with np.load(path, allow_pickle=False) as data:
        needed = {"control", "parameters", "value", "status", "method"}
        missing = (needed | {f"history_{column.name}" for column in fields(History)}) - set(data)
        if missing:
            raise ValueError(f"{path} holds no saved result; {sorted(missing)} are missing")
        names = sorted(name for name in data.files if name.startswith("state_"))
        return Result(
            control=jnp.asarray(data["control"]),
            parameters=jnp.asarray(data["parameters"]),
            value=float(data["value"]),
            history=History(
                **{column.name: data[f"history_{column.name}"] for column in fields(History)}
            ),
            status=str(data["status"]),
            method=str(data["method"]),
            state=[data[name] for name in names],
        )


def rebuild_state(template: Any, result: Result, method: str) -> Any:
    """Return the state of a result in the structure, types and shapes of a template.

    Raises:
        ValueError: if the result comes from another method or from another problem.
    """
    leaves, structure = jax.tree.flatten(template)
    saved = jax.tree.leaves(result.state)
    fits = len(leaves) == len(saved) and all(
        np.shape(new) == np.shape(old) for new, old in zip(leaves, saved, strict=True)
    )
    if result.method != method or not fits:
        raise ValueError(
            f"the result of {result.method or 'an unknown method'} with a state of "
            f"{len(saved)} arrays cannot be continued by {method}, which needs {len(leaves)}; use "
            "the same method and problem, or start anew from result.parameters"
        )

    def restore(new, old):
        return type(new)(old) if isinstance(new, bool | int | float) else jnp.asarray(old)

    return structure.unflatten([restore(n, o) for n, o in zip(leaves, saved, strict=True)])
