"""What a command writes: every file once in the list, and the course of an optimisation kept."""

from __future__ import annotations

import contextlib
import csv
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jax import Array

from jaxcontact.optimize.result import Result
from jaxcontact.transforms.files import atomic_write

#: Seconds between two copies of control and history.
PERIOD = 2.0


@dataclass
class Output:
    """The folder of results: every file that was written is reported once."""

    folder: Path
    """Where the files go."""

    written: list[str] = field(default_factory=list)
    """Names of the files so far, relative to the folder."""

    found: set[str] = field(default_factory=set)
    """Names of the files that were there before."""

    def __post_init__(self) -> None:
        """Look what is there."""
        self.found = {path.name for path in self.folder.glob("*")}

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Return the path for a file, and note it down once it is written."""
        path = self.folder / name
        note = f"{name} (replaced)" if name in self.found else name
        yield path
        self.written.append(note)


@dataclass
class Keeper:
    """Keeps the best control and the history in files, whatever ends the optimisation.

    They are written every few seconds, so that even a kill costs no more, and at the end with
    Ctrl-C held back.
    """

    output: Output
    """Where the files go."""

    distance: Callable[[Array], float]
    """Maps a control to its relative distance to the reference."""

    values: list[float] = field(default_factory=list)
    """Value of the objective at every iterate so far."""

    norms: list[float] = field(default_factory=list)
    """Gradient norm at every iterate so far."""

    measured: list[float] = field(default_factory=list)
    """Distance at every iterate so far."""

    best: Array | None = None
    """The control with the least value so far, (T, N, d)."""

    _last: float = field(default_factory=time.monotonic)

    def see(self, iteration: int, control: Array, value: float, norm: float) -> None:
        """Take note of an iterate; the callback of `optimize`."""
        measured = self.distance(control)
        if not self.values or value < min(self.values):
            self.best = control
        self.values.append(value)
        self.norms.append(norm)
        self.measured.append(measured)
        if time.monotonic() > self._last + PERIOD:
            self._write_history(self.output.folder / "history.csv", None)
            self._write_control(self.output.folder / "control.npz")
            self._last = time.monotonic()

    @property
    def distances(self) -> np.ndarray:
        """Distance of every iterate; NaN where Ctrl-C fell between iterate and callback."""
        padded = np.full(self._rows, np.nan)
        padded[: len(self.measured)] = self.measured
        return padded

    def keep(self, result: Result | None) -> None:
        """Write both files: of the result, or of what was seen if there is none."""
        if result is not None:
            self._rows, self.best = len(result.history.value), result.control
        if self.best is None:
            return
        with _no_interrupt():
            with self.output.writing("history.csv") as path:
                self._write_history(path, result)
            with self.output.writing("control.npz") as path:
                self._write_control(path)

    _rows: int = 0

    def _write_history(self, path: Path, result: Result | None) -> None:
        if result is None:
            columns = [self.values, self.norms, self.measured, [np.nan] * len(self.values)]
        else:
            history = result.history
            columns = [history.value, history.gradient_norm, self.distances, history.evaluations]
            columns = [column.tolist() for column in columns]
        with atomic_write(path, "w") as file:
            rows = csv.writer(file)
            rows.writerow("iteration value gradient_norm distance_to_reference evaluations".split())
            rows.writerows((k, *row) for k, row in enumerate(zip(*columns, strict=True)))

    def _write_control(self, path: Path) -> None:
        with atomic_write(path, "wb") as file:
            np.savez_compressed(file, control=np.asarray(self.best))


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """Hold Ctrl-C back."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
