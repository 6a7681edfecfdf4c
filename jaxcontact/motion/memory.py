"""Predict the memory of a run and of its gradient before anything runs.

With T steps, K = T / save_every recorded states and S segments of a checkpoint, in numbers:

    trajectory    2 K n                      unknowns and their velocity
                  K N d                      in a gradient, whose cost reads nodal displacements
    residuals     T C / 8                    one boolean per pair and step: loads, initial state
                  T (5 n + 3 C)              if matrices are differentiated (y, v, w, ...)
    checkpoint    (T / S) (...) + 2 S n      residuals of one segment, and the start of each
    cotangents    K N d + T N d              of the recorded displacement and of the control, this
                                             twice where a checkpoint cuts blocks of save_every

The factors are those of the compiled programs; the prediction holds within a factor of two.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
import numpy as np

from jaxcontact.motion.stepper import Stepper
from jaxcontact.transforms.time_loop import Checkpoint

#: Vectors (n,) that one step needs beside its state, for the sweeps over the factor.
WORKSPACE_VECTORS = 32
#: Vectors (n,) and (C,) that a step keeps for the derivative by a matrix.
MATRIX_RESIDUALS = (5, 3)


@dataclass(frozen=True)
class MemoryEstimate:
    """Predicted memory of a run, in bytes."""

    stepper: int
    """Matrices and factor; an argument of the run."""

    trajectory: int
    """Recorded states and contact records; in a gradient, what a cost of displacements reads."""

    residuals: int
    """What the steps keep for the backward pass, states at checkpoints included."""

    cotangents: int
    """Derivatives by the recorded displacement, the control, and the matrices if asked for."""

    workspace: int
    """Vectors of one step."""

    @property
    def total(self) -> int:
        """Sum of all parts."""
        return sum(getattr(self, part.name) for part in fields(self))

    def __str__(self) -> str:
        """Return one line per part."""
        names = [*(part.name for part in fields(self)), "total"]
        return "\n".join(f"{name:<11}{_readable(getattr(self, name)):>10}" for name in names)


def estimate_memory(
    stepper: Stepper,
    steps: int,
    *,
    gradient: bool = False,
    matrix_gradient: bool = False,
    save_every: int = 1,
    checkpoint: Checkpoint | None = None,
) -> MemoryEstimate:
    """Predict the memory of `simulate` and of its gradient; nothing is run or compiled.

    Args:
        stepper: from `prepare`, or its shapes by `jax.eval_shape`.
        steps: number of steps T.
        gradient: add what value and gradient by control (T, N, d) and initial state need.
        matrix_gradient: add what the gradient by material, obstacle or dt needs.
        save_every: as in `simulate`.
        checkpoint: as in `simulate`.

    Returns:
        The estimate. The control and what the cost function holds, such as a target, are not
        in it.

    Raises:
        ValueError: if steps or save_every are not positive or save_every does not divide steps.
    """
    if steps < 1 or save_every < 1 or steps % save_every:
        raise ValueError(
            f"save_every={save_every} must be a positive divisor of the number of steps, {steps}"
        )
    system = stepper.system
    item = jnp.dtype(system.dtype).itemsize
    n_pairs = system.normals.count
    vector, pairs = item * system.size, item * n_pairs
    field = item * system.n_nodes * system.dimension
    n_records = steps // save_every

    is_gradient = gradient or matrix_gradient
    kept = field if is_gradient else 2 * vector
    trajectory = (n_records + 1) * (kept + pairs + item)
    n_problems = len(stepper.operators.problems)
    trajectory += steps * (pairs + 2 * n_problems * (pairs + n_pairs) + 8 + item)
    residuals = cotangents = 0
    if is_gradient:
        per_step = n_pairs + item
        if matrix_gradient:
            per_step += MATRIX_RESIDUALS[0] * vector + MATRIX_RESIDUALS[1] * pairs
        residuals = steps * per_step
        cotangents = n_records * field
        if checkpoint is not None:
            segments = checkpoint.count(n_records)
            length = -(-n_records // segments) * save_every
            residuals = length * per_step + segments * (2 * vector + pairs + n_pairs)
    if gradient:
        # A checkpoint rearranges the control by segments of blocks: a second copy.
        cotangents += steps * field * (1 if checkpoint is None or save_every == 1 else 2)
    if matrix_gradient:
        cotangents += _float_bytes(system)
    return MemoryEstimate(
        stepper=_bytes(stepper),
        trajectory=trajectory,
        residuals=residuals,
        cotangents=cotangents,
        workspace=WORKSPACE_VECTORS * vector,
    )


def check_run_memory(
    stepper: Stepper, steps: int, *, save_every: int = 1, available: int | None = None
) -> None:
    """Check that the states of a run have room, before JAX asks the machine for it.

    Args:
        stepper: from `prepare`; may be traced.
        steps: number of steps T.
        save_every: as in `simulate`.
        available: bytes that there are; None is the memory of all devices, if it is known.

    Raises:
        ValueError: if the predicted trajectory is more than twice what is available, or as
            `estimate_memory`.
    """
    needed = estimate_memory(stepper, steps, save_every=save_every).trajectory
    available = _device_memory() if available is None else available
    # Twice: the prediction holds within this factor.
    if available is not None and needed > 2 * available:
        raise ValueError(
            f"{steps} steps record about {_readable(needed)} of states, but there are "
            f"{_readable(available)} of memory; record fewer by a larger save_every "
            f"(now {save_every}), or simulate in pieces, each from the last state of the one before"
        )


def _device_memory() -> int | None:
    """Return the bytes of the memory of all devices, or None if that is not known."""
    stats = [device.memory_stats() for device in jax.local_devices()]
    if all(entry and "bytes_limit" in entry for entry in stats):
        return sum(entry["bytes_limit"] for entry in stats if entry)
    if jax.default_backend() == "cpu" and hasattr(os, "sysconf"):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _bytes(tree: object) -> int:
    """Return the bytes of all arrays of a pytree."""
    return sum(np.size(x) * jnp.result_type(x).itemsize for x in jax.tree.leaves(tree))


def _float_bytes(tree: object) -> int:
    """Return the bytes of the arrays of a pytree that have a derivative."""
    return sum(
        _bytes(x) for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.result_type(x), jnp.floating)
    )


def _readable(n_bytes: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if n_bytes < 1000:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} TB"
