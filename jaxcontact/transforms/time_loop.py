"""The scan over time, with a choice of what is recorded and of what the adjoint recomputes.

Plain: one scan over T steps. With `save_every = k`, a scan over T/k blocks of k steps, of which
only the last state is recorded. With checkpoints, a scan over segments of blocks: the backward
pass keeps the state at the start of each segment and recomputes what happened inside, so that with
sqrt(T) segments it holds O(sqrt(T)) steps at a time. Source: Griewank, Walther, Evaluating
Derivatives (2008), 12, with two levels, one scan inside the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp

State = TypeVar("State")
Inputs = TypeVar("Inputs")
Record = TypeVar("Record")
Tree = TypeVar("Tree")
#: Maps (state, input of one step) to (state, record of the step).
Step = Callable[[State, Inputs], tuple[State, Record]]


@dataclass(frozen=True)
class Checkpoint:
    """Recompute the steps of a segment in the backward pass instead of storing them."""

    segments: int | None = None
    """Number of segments; None is about the square root of the number of recorded states."""

    def __post_init__(self) -> None:
        """Check the number, which is never traced.

        Raises:
            ValueError: if it is not positive.
        """
        if self.segments is not None and self.segments < 1:
            raise ValueError(
                f"Checkpoint.segments must be 1 or more, got {self.segments}; leave it out for "
                "about the square root of the number of recorded states"
            )

    def count(self, n_blocks: int) -> int:
        """Return the number of segments for a number of recorded states."""
        wanted = math.isqrt(n_blocks - 1) + 1 if self.segments is None else self.segments
        return min(wanted, n_blocks)


def scan_steps(
    step: Step[State, Inputs, Record],
    start: State,
    inputs: Inputs,
    steps: int,
    save_every: int = 1,
    checkpoint: Checkpoint | None = None,
) -> tuple[State, Record]:
    """Scan over the steps.

    Args:
        step: one step.
        start: state at time zero.
        inputs: pytree of inputs, each (T, ...), or None.
        steps: number of steps T.
        save_every: number of steps k between recorded states; divides T.
        checkpoint: what the backward pass recomputes; None stores everything.

    Returns:
        The states after steps k, 2k, ..., T, each (T/k, ...), and the records of all steps, each
        (T, ...).
    """

    def block(state: State, block_inputs: Inputs) -> tuple[State, tuple[State, Record]]:
        state, records = jax.lax.scan(step, state, block_inputs, length=save_every)
        return state, (state, records)

    def single(state: State, step_input: Inputs) -> tuple[State, tuple[State, Record]]:
        state, record = step(state, step_input)
        return state, (state, record)

    n_blocks = steps // save_every
    if save_every > 1:
        inputs = _split(inputs, n_blocks)
    scan_blocks = partial(jax.lax.scan, single if save_every == 1 else block)
    if checkpoint is None:
        _, (states, records) = scan_blocks(start, inputs, length=n_blocks)
    else:
        length = -(-n_blocks // checkpoint.count(n_blocks))
        states, records = _scan_segments(scan_blocks, start, inputs, n_blocks, length)
    return states, (records if save_every == 1 else _join(records))


def _scan_segments(
    scan_blocks: Callable, start: object, inputs: object, n_blocks: int, length: int
) -> tuple:
    """Scan over checkpointed segments of equal length and a shorter last one."""
    n_whole = n_blocks // length
    n_inside = n_whole * length

    @partial(jax.checkpoint, prevent_cse=False, static_argnums=2)  # type: ignore
    def segment(state: object, segment_inputs: object, n: int) -> tuple:
        return scan_blocks(state, segment_inputs, length=n)

    whole = jax.tree.map(lambda x: x[:n_inside], inputs)
    state, recorded = jax.lax.scan(
        lambda state, x: segment(state, x, length), start, _split(whole, n_whole), length=n_whole
    )
    recorded = _join(recorded)
    if n_inside < n_blocks:
        rest = jax.tree.map(lambda x: x[n_inside:], inputs)
        _, last = segment(state, rest, n_blocks - n_inside)
        recorded = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), recorded, last)
    return recorded


def _split(tree: Tree, n: int) -> Tree:
    """Return leaves (n m, ...) as (n, m, ...)."""
    return jax.tree.map(lambda x: x.reshape(n, x.shape[0] // n, *x.shape[1:]), tree)


def _join(tree: Tree) -> Tree:
    """Return leaves (n, m, ...) as (n m, ...)."""
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), tree)
