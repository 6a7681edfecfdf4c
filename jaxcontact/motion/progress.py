"""News of a simulation while it runs, also under jit."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

State = TypeVar("State")
#: Called with the number of steps that are done and the number of all steps.
Report = Callable[[int, int], None]

#: When the first report of the present run came, and of which step.
_begin: dict[str, float] = {}


def print_progress(done: int, steps: int) -> None:
    """Write a line on stderr, over the last one: steps done, and the time that is left."""
    now = time.perf_counter()
    if done <= _begin.get("done", steps):
        _begin.update(done=done, time=now)
    passed = done - _begin["done"]
    left = (now - _begin["time"]) / passed * (steps - done) if passed else None
    text = "" if left is None else f", {left:.0f} s left"
    sys.stderr.write(f"\rstep {done} of {steps}{text:<14}" + ("\n" if done >= steps else ""))
    sys.stderr.flush()
    if done >= steps:
        _begin.clear()


@dataclass(frozen=True)
class Progress:
    """Report how far a simulation is, every so many steps; also under jit, grad and vmap.

    The reports come while the program runs; `jax.effects_barrier()` waits for the last one. Each
    takes about a millisecond. A program is compiled for its `report`: give a function that is
    defined once, no new lambda.
    """

    every: int | None = None
    """Number of steps between reports; None is a twentieth of all steps."""

    report: Report = field(default=print_progress)
    """Called with the number of steps that are done and the number of all steps."""

    def __post_init__(self) -> None:
        """Check the fields, which are never traced.

        Raises:
            ValueError: if the number is not positive or the report is no function.
        """
        if (self.every is not None and self.every < 1) or not callable(self.report):
            raise ValueError(
                "Progress(every, report) takes a positive number of steps and a function of (done, "
                f"steps), got {self.every!r} and {self.report!r}"
            )

    def watch(
        self, step: Callable[[State, Any], tuple[State, Any]], inputs: Any, steps: int
    ) -> tuple[Any, Any]:
        """Return a step that reports, and its inputs.

        Args:
            step: maps (state, inputs of the step) to (state, record).
            inputs: of all steps.
            steps: number of all steps T.
        """

        def send(done: Array) -> None:
            self.report(int(done), steps)

        every = max(1, steps // 20) if self.every is None else self.every

        def watched(state: State, inputs: tuple[Array, Any]) -> tuple[State, Any]:
            done, rest = inputs
            result = step(state, rest)
            is_time = (done % every == 0) | (done == steps)
            jax.lax.cond(is_time, lambda: jax.debug.callback(send, done), lambda: None)
            return result

        return watched, (jnp.arange(1, steps + 1), inputs)
