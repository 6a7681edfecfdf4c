"""The adjoint of a step of bodies that turn: its sweeps as a `jax.custom_vjp`.

At the fixed point w = T(w, data), p = P(w, data) of the sweeps the adjoint is the fixed point of

    a = w* + T_w^T a + P_w^T p*,    data* = T_data^T a + P_data^T p*,

by sweeps of the same contraction, each with one solve by the factor of the step. Nothing of the
sweeps is kept. Source: MATH.md 12.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import custom_vjp_primal_tree_values

from jaxcontact.contact.complementarity import Guess, Solution
from jaxcontact.contact.sweeps import (
    MAX_SWEEPS,
    TOLERANCE,
    Equation,
    Fixed,
    Unknowns,
    make_sweep,
    middle_frame,
    run_sweeps,
    start_of,
)
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.tangents import instantiate

#: A gradient that is less exact than so many tolerances of the sweeps is none.
LOST_DIGITS = 1e4


class Residuals(NamedTuple):
    """What a step keeps for its backward pass; what is the same in every step is stored once."""

    equation: Equation
    """The data of the step."""

    fixed: Fixed
    """Factor and patterns."""

    unknowns: Unknowns
    """The solution."""

    active: Array
    """Its active set, (C,) bool."""

    asked: tuple[Array, ...]
    """Of each leaf of the equation one entry if it is differentiated, else none. Not None and not
    a flag: JAX unflattens the residuals of one compiled program by the tree of another trace."""


@jax.custom_vjp
def solve_by_sweeps(equation: Equation, fixed: Fixed) -> tuple[Unknowns, Solution]:
    """Solve (4): return w and W, not yet poisoned, and the solution on the pairs."""
    return run_sweeps(equation, fixed)


def _solve_fwd(equation, fixed):
    asked = tuple(
        jnp.zeros(int(x.perturbed)) for x in jax.tree.leaves(equation, is_leaf=_is_primal)
    )
    equation, fixed = custom_vjp_primal_tree_values((equation, fixed))
    unknowns, solution = solve_by_sweeps(equation, fixed)
    nothing = fixed._replace(velocity=jnp.zeros(0), guess=Guess(jnp.zeros(0, bool)))
    return (unknowns, solution), Residuals(equation, nothing, unknowns, solution.active, asked)


def _is_primal(x: object) -> bool:
    return hasattr(x, "perturbed")


@in_full_precision
def _solve_bwd(residuals, cotangents):
    equation, fixed, unknowns, active, asked = residuals
    unknowns_bar, solution_bar = cotangents
    unknowns_bar = Unknowns(*(instantiate(x) for x in unknowns_bar))
    multiplier_bar = instantiate(solution_bar.multiplier)
    frame, form = middle_frame(equation, fixed, unknowns.increment)
    guess = Guess(active)
    leaves, tree = jax.tree.flatten(equation)
    is_asked = [x.size > 0 for x in asked]
    chosen = [x for x, yes in zip(leaves, is_asked, strict=True) if yes]

    def sweep(unknowns: Unknowns, chosen: list[Array]) -> tuple[Unknowns, Array]:
        values = iter(chosen)
        parts = [next(values) if yes else x for x, yes in zip(leaves, is_asked, strict=True)]
        equation = jax.tree.unflatten(tree, parts)
        after, solution, _ = make_sweep(
            equation, start_of(equation), fixed, form, frame, unknowns, guess
        )
        return after, solution.multiplier

    _, back = jax.vjp(sweep, unknowns, chosen)
    adjoint = _adjoint_sweeps(
        lambda a: jax.tree.map(jnp.add, unknowns_bar, back((a, multiplier_bar))[0]), unknowns_bar
    )
    _, chosen_bar = back((adjoint, multiplier_bar))
    values = iter(chosen_bar)
    leaves_bar = [next(values) if yes else None for yes in is_asked]
    return jax.tree.unflatten(tree, leaves_bar), None


def _adjoint_sweeps(sweep: Callable[[Unknowns], Unknowns], start: Unknowns) -> Unknowns:
    """Return the fixed point of the adjoint sweep; NaN if it is not found."""
    dtype = start.velocity.dtype
    tolerance = TOLERANCE[str(dtype)]

    def is_unfinished(search: tuple) -> Array:
        _, _, error, steps = search
        return (error > tolerance) & (steps < MAX_SWEEPS)

    def advance(search: tuple) -> tuple:
        old, before, _, steps = search
        new = sweep(old)
        # Of w* alone, which W* follows: the torque of a pure force is nothing but rounding.
        size = jnp.max(jnp.abs(new.velocity))
        change = jnp.max(jnp.abs(new.velocity - old.velocity)) / jnp.where(size > 0.0, size, 1.0)
        rate = jnp.where(steps > 1, jnp.minimum(change / before, 0.5), 0.5)
        return new, change, change * rate / (1.0 - rate), steps + 1

    infinite = jnp.full((), jnp.inf, dtype)
    found, _, error, _ = jax.lax.while_loop(
        is_unfinished, advance, (start, infinite, infinite, jnp.int32(0))
    )
    # Rounding may hold the last digits: the sweeps have then made all that they can.
    poison = jnp.where(error <= LOST_DIGITS * tolerance, 1.0, jnp.nan).astype(dtype)
    return Unknowns(*(x * poison for x in found))


solve_by_sweeps.defvjp(_solve_fwd, _solve_bwd, symbolic_zeros=True)
