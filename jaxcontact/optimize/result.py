"""What an optimisation returns, and how it is kept in a file."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.optimize.certificate import Stationarity
from jaxcontact.optimize.method import Ending, MethodState, S
from jaxcontact.transforms.files import atomic_write, check_is_file
from jaxcontact.transforms.show import shown_by


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

    gap_rows: np.ndarray
    """Derivatives of the gap of one pair in one step so far, (K+1,) int; of an exact finish."""

    simulations: np.ndarray
    """Motions without a derivative so far, (K+1,) int; of an exact finish."""

    seconds: np.ndarray
    """Time since the start, compilation included, (K+1,) [s]."""

    def to_csv(self, path: str | Path) -> None:
        """Write one line per iteration, with a header line."""
        names = [column.name for column in fields(self)]
        with atomic_write(path, "w") as file:
            writer = csv.writer(file)
            writer.writerow(["iteration", *names])
            columns = [getattr(self, name).tolist() for name in names]
            writer.writerows((k, *row) for k, row in enumerate(zip(*columns, strict=True)))


@dataclass(frozen=True)
class Result:
    """The best control found, with the course of the optimisation."""

    control: Array = field(repr=False)
    """The control with the lowest value that was met, (T, N, d) or (T, n)."""

    parameters: Array = field(repr=False)
    """What was optimised: the control itself, or the argument of the map `controls`."""

    value: float
    """Value of the objective at the control."""

    history: History = field(repr=False)
    """One entry per iteration."""

    status: Ending
    """Why the optimisation ended: text that says what it means and what to do next."""

    stationarity: Stationarity | None = None
    """Certificate of strong stationarity; None if there is none, see `uncertified`."""

    uncertified: str = ""
    """Why there is no certificate and what to do for one; empty if there is one."""

    method: str = ""
    """Name of the method."""

    state: MethodState | Sequence[np.ndarray] | None = field(default=None, repr=False)
    """Everything the method needs to go on as if it had not been interrupted; from a file the
    leaves alone."""

    def _facts(self) -> dict[str, object]:
        return {
            "value": self.value,
            "start": float(self.history.value[0]),
            "iterations": len(self.history.value) - 1,
            "gradients": int(self.history.evaluations[-1]),
            "method": self.method,
            "status": self.status.name,
            "advice": self.status.partition(": ")[2],
            "stationarity": self.stationarity or self.uncertified,
        }

    __repr__, _repr_html_ = shown_by(_facts)

    def save(self, path: str | Path) -> None:
        """Write the result to an .npz file, from which `load_result` and `optimize` go on.

        The certificate is not kept, but `uncertified` is. If the writing fails or is killed, a
        file that was there before is still there.
        """
        data = {f"history_{name}": getattr(self.history, name) for name in COLUMNS}
        leaves = jax.tree.leaves(self.state)
        data |= {_state_name(number): np.asarray(leaf) for number, leaf in enumerate(leaves)}
        with atomic_write(path, "wb") as file:
            np.savez_compressed(
                file,
                control=np.asarray(self.control),
                parameters=np.asarray(self.parameters),
                value=self.value,
                state_size=len(leaves),
                status=self.status.name,
                method=self.method,
                uncertified=self.uncertified or NOT_KEPT,
                **data,
            )


#: What `uncertified` says of a result that had a certificate before it was saved.
NOT_KEPT = "a file does not keep the certificate; jc.stationarity makes it anew"

COLUMNS = tuple(column.name for column in fields(History))


def load_result(path: str | Path) -> Result:
    """Read a result that `Result.save` wrote; hand it to `optimize` as start to go on.

    Raises:
        OSError: if there is no such file, it is a folder, or it may not be read.
        ValueError: if the file is damaged or holds something else.
    """
    check_is_file(path)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
            data = {name: arrays[name] for name in arrays.files}
    except PermissionError:
        raise
    # Whatever the readers of zip and npy raise on bytes that they do not expect.
    except Exception as error:
        raise ValueError(
            f"{path} cannot be read as a saved result ({type(error).__name__}: {error}); it is "
            "damaged or another kind of file. Load a copy, or run the optimisation again"
        ) from error
    needed = {"control", "parameters", "value", "state_size", "status", "method"}
    missing = (needed | {f"history_{name}" for name in COLUMNS}) - set(data)
    if missing:
        raise ValueError(f"{path} holds no saved result; {sorted(missing)} are missing")
    history = History(**{name: data[f"history_{name}"] for name in COLUMNS})
    is_whole = (
        all(data[name].shape == () for name in ("value", "state_size", "status", "method"))
        and data["value"].dtype.kind == "f"
        and data["state_size"].dtype.kind == "i"
        and str(data["status"]) in Ending.__members__
        and all(data[name].dtype.kind == "f" for name in ("control", "parameters"))
        and history.value.ndim == 1
        and history.value.size > 0
        and all(getattr(history, name).shape == history.value.shape for name in COLUMNS)
        and all(_state_name(k) in data for k in range(data["state_size"]))
    )
    if not is_whole:
        raise ValueError(
            f"{path} holds a result whose parts do not fit each other; it is damaged or of another "
            f"version. Start anew from numpy.load({str(path)!r})['parameters']"
        )
    return Result(
        control=jnp.asarray(data["control"]),
        parameters=jnp.asarray(data["parameters"]),
        value=float(data["value"]),
        history=history,
        status=Ending[str(data["status"])],
        method=str(data["method"]),
        uncertified=str(data.get("uncertified", NOT_KEPT)),
        state=[data[_state_name(k)] for k in range(data["state_size"])],
    )


def _state_name(number: int) -> str:
    return f"state_{number:03d}"


def rebuild_state(template: S, result: Result, method: str) -> S:
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
