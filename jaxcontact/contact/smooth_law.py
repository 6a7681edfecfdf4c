"""Newton's method for a contact law that is smooth: g = W p + q with a curve p(x), g(x).

The unknown of a pair is x = d p - g with d = diag W. A law gives p and g of x, both positive, with
the share c = d dp/dx in (0, 1) by which the pair is closed and the share 1 - c = -dg/dx by which it
is open, so that the law holds exactly and only the balance W p + q = g is iterated. With
u = sqrt(c / d) dx its linearisation is symmetric with unit diagonal,

    (K W K + diag(1 - c)) u = -K F,    K = diag sqrt(c / d),    F = W p + q - g,

solved by conjugate gradients; dx = d K u - F - W K u needs no division by a share that may vanish.
Source: Chen, Mangasarian, Comput. Optim. Appl. 5 (1996) 97-138 for smoothing by x.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

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
    solve_unit_diagonal,
)
from jaxcontact.transforms.traced import is_traced

#: Halvings of a Newton step before it is taken anyway.
MAX_HALVINGS = 12

#: Newton steps without progress before rounding is taken to have ended the descent.
PATIENCE = 4

#: Rounding errors of the residual that a solution may have.
ROUNDINGS = 64.0


class PairState(NamedTuple):
    """Where the pairs are on the curve of their law, each (C,)."""

    multiplier: Array
    """p, [N s]."""

    separation: Array
    """g, [m/s]."""

    closed: Array
    """c = d dp/dx, in [0, 1]."""

    open: Array
    """1 - c = -dg/dx, without cancellation."""


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


def check(name: str, parameter: str, value: float | Array, max_steps: int) -> None:
    """Check the numbers of a smooth contact law that are not traced.

    Raises:
        ValueError: if the parameter is not positive and finite, or no Newton step is allowed.
    """
    if not is_traced(value):
        number = np.asarray(value)
        if not np.all(np.isfinite(number) & (number > 0.0)):
            raise ValueError(
                f"{name}.{parameter} must be positive and finite, got {value}; exact contact is "
                "contact_solver=jc.SemismoothNewton()"
            )
    if max_steps < 1:
        raise ValueError(
            f"{name}.max_steps must be 1 or more, got {max_steps}; leave it out for 100"
        )


def solve(
    law: Callable[[Array], PairState],
    compliance: Array,
    offset: Array,
    resolution: Array,
    guess: Guess,
    max_steps: int,
) -> Solution:
    """Solve g = W p + q with the law; see `ContactSolver.solve`.

    Active are the pairs that are nearer to strong contact than to separation, d p > g.
    """
    diagonal = jnp.diagonal(compliance)
    scale = jnp.sqrt(diagonal)
    tolerance = complementarity.tolerance(offset, resolution)

    def residual(x: Array) -> Array:
        pair = law(x)
        return separation(compliance, offset, pair.multiplier) - pair.separation

    def noise(x: Array) -> Array:
        pair = law(x)
        # |W_ij| <= sqrt(W_ii W_jj): a bound of the terms of W p without another product.
        terms = scale * jnp.dot(scale, pair.multiplier)
        return jnp.finfo(x.dtype).eps * (terms + jnp.abs(offset) + pair.separation)

    def merit(x: Array, error: Array) -> Array:
        # Rounding of a pair far from contact must not hide the descent of the others.
        return jnp.linalg.norm(jnp.maximum(jnp.abs(error) - noise(x), 0.0) / scale)

    def is_solution(error: Array, rounding: Array) -> Array:
        return jnp.all(jnp.abs(error) <= ROUNDINGS * rounding + tolerance)

    def is_unfinished(descent: _Descent) -> Array:
        is_open = jnp.any(jnp.abs(descent.error) > descent.goal)
        return is_open & (descent.steps < max_steps) & (descent.patience > 0)

    def newton_direction(x: Array, error: Array) -> Array:
        pair = law(x)
        root = jnp.sqrt(pair.closed / diagonal)

        def product(u: Array) -> Array:
            return root * (compliance @ (root * u)) + pair.open * u

        def factorized() -> Array:
            matrix = root[:, None] * compliance * root[None, :] + jnp.diag(pair.open)
            return solve_unit_diagonal(matrix, rhs)

        rhs = -root * error
        found = _conjugate_gradients(product, rhs)
        # Pairs that lean on each other make the matrix nearly singular.
        missed = jnp.linalg.norm(product(found) - rhs)
        is_solved = missed <= jnp.finfo(rhs.dtype).eps ** 0.75 * jnp.linalg.norm(rhs)
        scaled = root * jax.lax.cond(is_solved, lambda: found, factorized)
        return diagonal * scaled - error - compliance @ scaled

    def advance(descent: _Descent) -> _Descent:
        x, error = descent.x, descent.error
        direction = newton_direction(x, error)
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
        # Rounding ends the descent: a few steps without progress are enough. Far from it a long way
        # of short steps, to the curve of pairs that lean on each other, is progress too.
        is_short = (size <= (1.0 - 0.1 * t) * old_size) & ~is_solution(new_error, noise(x))
        is_progress = (size < 0.95 * descent.best) | is_short
        patience = jnp.where(is_progress, PATIENCE, descent.patience - 1)
        best = jnp.minimum(descent.best, size)
        return _Descent(x, new_error, noise(x), best, descent.steps + 1, patience)

    # The forces of the last step: no linear problem is solved before it is needed.
    multiplier = guess.workspace if len(guess.workspace) else jnp.zeros_like(offset)
    x = diagonal * multiplier - separation(compliance, offset, multiplier)
    error = residual(x)
    start = _Descent(x, error, noise(x), merit(x, error), jnp.int32(0), jnp.int32(PATIENCE))
    x, error, goal, _, steps, _ = jax.lax.while_loop(is_unfinished, advance, start)
    goal = ROUNDINGS * goal + tolerance
    solution = _finish(law(x).multiplier, x, error, goal, steps)
    return solution._replace(workspace=solution.multiplier)


class _Krylov(NamedTuple):
    """The iteration of conjugate gradients."""

    solution: Array
    """x, (C,)."""

    rest: Array
    """Its residual r, (C,)."""

    direction: Array
    """The search direction, (C,)."""

    square: Array
    """r . r, scalar."""

    steps: Array
    """Products so far, int32."""


def _conjugate_gradients(product: Callable[[Array], Array], rhs: Array) -> Array:
    """Return x, (C,), with an SPD product x = rhs.

    Rows of open pairs are those of the identity, so that there are about as many steps as closed
    pairs; a Cholesky factor of all pairs costs more where most of many pairs are open.
    """
    least = jnp.finfo(rhs.dtype).eps ** 2 * jnp.vdot(rhs, rhs)

    def is_unfinished(state: _Krylov) -> Array:
        return (state.square > least) & (state.steps < 2 * rhs.size + 8)

    def advance(state: _Krylov) -> _Krylov:
        image = product(state.direction)
        length = state.square / jnp.vdot(state.direction, image)
        rest = state.rest - length * image
        square = jnp.vdot(rest, rest)
        direction = rest + square / state.square * state.direction
        solution = state.solution + length * state.direction
        return _Krylov(solution, rest, direction, square, state.steps + 1)

    start = _Krylov(jnp.zeros_like(rhs), rhs, rhs, jnp.vdot(rhs, rhs), jnp.int32(0))
    return jax.lax.while_loop(is_unfinished, advance, start).solution


def _finish(multiplier: Array, x: Array, error: Array, goal: Array, steps: Array) -> Solution:
    """Return the solution with a status that is earned by the residual."""
    error = jnp.abs(error)
    is_finite = jnp.all(jnp.isfinite(error)) & jnp.all(multiplier >= 0.0)
    status = jnp.where(jnp.all(error <= goal), Status.CONVERGED, Status.NOT_CONVERGED)
    status = jnp.where(is_finite, status, Status.NON_FINITE).astype(jnp.int32)
    relative_tolerance = complementarity.RELATIVE_TOLERANCE[str(x.dtype)]
    relative = relative_tolerance * jnp.max(error / jnp.maximum(goal, jnp.finfo(x.dtype).tiny))
    return Solution(multiplier, x > 0.0, steps, status, relative)
