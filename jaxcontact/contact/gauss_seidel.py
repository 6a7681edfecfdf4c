"""Projected Gauss-Seidel for the contact problem of one step.

    p_i <- max(0, p_i - (W p + q)_i / W_ii),   i = 1, ..., C,   in turn.

Converges for every SPD compliance; the rate depends on its conditioning. Source: Cottle, Pang,
Stone, The Linear Complementarity Problem (1992), 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import complementarity
from jaxcontact.contact.complementarity import Guess, Solution


def sweep(compliance: Array, offset: Array, multiplier: Array) -> Array:
    """Return the multiplier (C,) after one sweep over the contact pairs."""
    diagonal = jnp.diagonal(compliance)

    def relax(i, p):
        g = jnp.dot(compliance[i], p) + offset[i]
        return p.at[i].set(jnp.maximum(0.0, p[i] - g / diagonal[i]))

    return jax.lax.fori_loop(0, offset.shape[0], relax, multiplier)


def iterate(
    compliance: Array, offset: Array, multiplier: Array, tolerance: Array, max_sweeps: int | Array
) -> tuple[Array, Array]:
    """Sweep until the residual is below the tolerance (C,); return multiplier and sweeps."""

    def is_unfinished(carry):
        p, sweeps = carry
        error = complementarity.residual(compliance, offset, p)
        return jnp.any(error > tolerance) & (sweeps < max_sweeps)

    def advance(carry):
        p, sweeps = carry
        return sweep(compliance, offset, p), sweeps + 1

    return jax.lax.while_loop(is_unfinished, advance, (multiplier, jnp.int32(0)))


@jax.tree_util.register_static
@dataclass(frozen=True)
class ProjectedGaussSeidel:
    """Projected Gauss-Seidel, to the same residual as `SemismoothNewton`."""

    max_sweeps: int = 20_000
    """A step that needs more sweeps ends as not converged."""

    is_exact: ClassVar[bool] = True
    uses_compliance: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check the option, which is never traced.

        Raises:
            ValueError: if no sweep is allowed.
        """
        if self.max_sweeps < 1:
            raise ValueError(
                f"ProjectedGaussSeidel.max_sweeps must be 1 or more, got {self.max_sweeps}; leave "
                "it out for 20000"
            )

    @property
    def max_active_sets(self) -> None:
        """None: it works on the condensed compliance."""

    def check(self) -> None:
        """Do nothing: what holds no array is checked when it is made."""

    def first_workspace(self, compliance: Array) -> tuple[()]:
        """Return (): nothing is kept between steps."""
        return ()

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Guess) -> Solution:
        """Solve the complementarity problem; see `ContactSolver.solve`."""
        # The guess is an active set, which sweeps cannot use: they start from the free motion.
        start = jnp.zeros_like(offset)
        # Well below the tolerance of a solved step, so that both solvers agree.
        goal = 0.01 * complementarity.tolerance(offset, resolution) + 0.1 * resolution
        multiplier, sweeps = iterate(compliance, offset, start, goal, self.max_sweeps)
        return complementarity.finish(
            compliance, offset, resolution, multiplier, sweeps, jnp.bool_(False)
        )

    def softness(self, compliance: Array | None, multiplier: Array) -> Array:
        """Return zero: contact is rigid."""
        return jnp.zeros_like(multiplier)
