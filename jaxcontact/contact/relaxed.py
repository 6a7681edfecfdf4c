"""Relaxed contact: p_i g_i = kappa instead of p_i g_i = 0, a smooth model of the contact law.

    g = W p + q,    p_i g_i = kappa > 0,    p, g > 0,

are the optimality conditions of the strictly convex barrier problem

    min  1/2 p.W p + q.p - kappa sum_i log p_i.

Newton's method in the unknown x = d p - g with d = diag W, from which p and g follow such that
p g = kappa holds exactly,

    r = sqrt(x^2 + 4 d kappa),    p = (r + x) / (2 d),    g = (r - x) / 2,

is never infeasible, has the matrix W + diag(g / p), and becomes the primal-dual active set method
as kappa tends to zero. The derivative dp = -(W + diag(g / p))^-1 dq replaces the active set of
exact contact by the weight g / p: zero on strong contact, infinite off contact, and in weak
contact the share of the multiplier. Source: MATH.md 5; Forsgren, Gill, Wright, SIAM Review 44
(2002) for the barrier; Chen, Harker, SIAM J. Matrix Anal. Appl. 14 (1993) for the unknown x.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.contact import complementarity
from jaxcontact.contact.complementarity import (
    Guess,
    Solution,
    Status,
    separation,
    solve_compliance,
)
from jaxcontact.transforms.traced import is_traced, poison_unless

#: Halvings of a Newton step before it is taken anyway.
MAX_HALVINGS = 12

#: Newton steps without progress before rounding is taken to have ended the descent.
PATIENCE = 4


class _Descent(NamedTuple):
    """Newton's iteration in the unknown x."""

    x: Array
    """The unknown, (C,)."""

    error: Array
    """Its residual, (C,)."""

    goal: Array
    """Rounding error of the residual, (C,)."""

    best: Array
    """Smallest merit so far, scalar."""

    steps: Array
    """Newton steps so far, int32."""

    patience: Array
    """Steps that may still pass without progress, int32."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RelaxedContact:
    """Smooth contact with the law (multiplier) x (separation velocity) = kappa.

    Every pair feels every obstacle at any distance, so gradients exist everywhere, do not vanish
    before touch, and have derivatives of every order. A pair never touches. `kappa` is a leaf: a
    new value compiles nothing.

    Of a trajectory of the contact-implicit scheme, lam_i gap_i = 2 tau kappa in every step, i.e.
    (mean contact force) x (gap) = 2 kappa.

    `prepare` and `with_contact` refuse a concrete kappa that is not positive and finite; a traced
    one ends the step as not finite.

    Derivative: forward and reverse mode of every order; kappa counts as constant.
    """

    kappa: float | Array
    """Product of multiplier and separation velocity of every pair, scalar, positive [J]."""

    max_steps: int = field(default=100, metadata={"static": True})
    """Newton steps before a time step ends as not converged."""

    is_exact: ClassVar[bool] = False

    @property
    def max_active_sets(self) -> None:
        """None: it works on the condensed compliance."""

    def check(self) -> None:
        """Check what is not traced.

        Raises:
            ValueError: if kappa is not positive and finite, or no Newton step is allowed.
        """
        if not is_traced(self.kappa):
            kappa = np.asarray(self.kappa)
            if not np.all(np.isfinite(kappa) & (kappa > 0.0)):
                raise ValueError(
                    f"RelaxedContact.kappa must be positive and finite, got {self.kappa}; exact "
                    "contact is contact_solver=jc.SemismoothNewton()"
                )
        if self.max_steps < 1:
            raise ValueError(
                f"RelaxedContact.max_steps must be 1 or more, got {self.max_steps}; leave it out "
                "for 100"
            )

    def first_workspace(self, compliance: Array) -> tuple[()]:
        """Return (): nothing is kept between steps."""
        return ()

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Guess) -> Solution:
        """Solve the relaxed problem; see `ContactSolver.solve`.

        Active are the pairs that are nearer to strong contact than to separation, d p > g.
        """
        closed = guess.active
        diagonal = jnp.diagonal(compliance)
        kappa = jax.lax.stop_gradient(jnp.asarray(self.kappa, offset.dtype))
        kappa = poison_unless((kappa > 0.0) & (kappa < jnp.inf), kappa)
        scale = jnp.sqrt(diagonal)

        def residual(x: Array) -> Array:
            p, g, _ = _pair(x, diagonal, kappa)
            return separation(compliance, offset, p) - g

        def noise(x: Array) -> Array:
            p, g, _ = _pair(x, diagonal, kappa)
            size = jnp.abs(compliance) @ p + jnp.abs(offset) + g
            return jnp.finfo(x.dtype).eps * size

        def merit(x: Array, error: Array) -> Array:
            # Rounding of a pair far from contact must not hide the descent of the others.
            return jnp.linalg.norm(jnp.maximum(jnp.abs(error) - noise(x), 0.0) / scale)

        def is_unfinished(descent: _Descent) -> Array:
            is_open = jnp.any(jnp.abs(descent.error) > descent.goal)
            return is_open & (descent.steps < self.max_steps) & (descent.patience > 0)

        def advance(descent: _Descent) -> _Descent:
            x, error = descent.x, descent.error
            p, g, root = _pair(x, diagonal, kappa)
            everywhere = jnp.ones(x.shape, bool)
            direction = solve_compliance(compliance, everywhere, g / p, -error) * (root / p)
            old_size = merit(x, error)

            def is_too_long(trial):
                t, trial_error = trial
                size = merit(x + t * direction, trial_error)
                is_worse = ~(size <= (1.0 - 0.1 * t) * old_size)
                return is_worse & (t > 0.5**MAX_HALVINGS)

            def shorten(trial):
                t = 0.5 * trial[0]
                return t, residual(x + t * direction)

            full = (jnp.ones((), x.dtype), residual(x + direction))
            t, new_error = jax.lax.while_loop(is_too_long, shorten, full)
            x = x + t * direction
            size = merit(x, new_error)
            # Rounding ends the descent: a few steps without progress are enough.
            patience = jnp.where(size < 0.95 * descent.best, PATIENCE, descent.patience - 1)
            best = jnp.minimum(descent.best, size)
            return _Descent(x, new_error, noise(x), best, descent.steps + 1, patience)

        multiplier = solve_compliance(compliance, closed, None, jnp.where(closed, -offset, 0.0))
        x = diagonal * multiplier - separation(compliance, offset, multiplier)
        error = residual(x)
        start = _Descent(x, error, noise(x), merit(x, error), jnp.int32(0), jnp.int32(PATIENCE))
        x, error, goal, _, steps, _ = jax.lax.while_loop(is_unfinished, advance, start)
        multiplier, _, _ = _pair(x, diagonal, kappa)
        goal = 64.0 * goal + complementarity.tolerance(offset, resolution)
        return _finish(multiplier, x, error, goal, steps)

    def softness(self, multiplier: Array, separation: Array) -> Array:
        """Return dg/dp = g / p = kappa / p^2, (C,)."""
        return self.kappa / multiplier**2


def _pair(x: Array, diagonal: Array, kappa: Array) -> tuple[Array, Array, Array]:
    """Return p, g and r of the unknown x, without cancellation; all (C,)."""
    root = jnp.sqrt(x**2 + 4.0 * diagonal * kappa)
    large = 0.5 * (jnp.abs(x) + root)
    small = diagonal * kappa / large
    is_closed = x > 0.0
    return jnp.where(is_closed, large, small) / diagonal, jnp.where(is_closed, small, large), root


def _finish(multiplier: Array, x: Array, error: Array, goal: Array, steps: Array) -> Solution:
    """Return the solution with a status that is earned by the residual."""
    error = jnp.abs(error)
    is_finite = jnp.all(jnp.isfinite(error)) & jnp.all(multiplier > 0.0)
    status = jnp.where(jnp.all(error <= goal), Status.CONVERGED, Status.NOT_CONVERGED)
    status = jnp.where(is_finite, status, Status.NON_FINITE).astype(jnp.int32)
    relative_tolerance = complementarity.RELATIVE_TOLERANCE[str(x.dtype)]
    relative = relative_tolerance * jnp.max(error / jnp.maximum(goal, jnp.finfo(x.dtype).tiny))
    return Solution(multiplier, x > 0.0, steps, status, relative)
