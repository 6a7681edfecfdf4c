"""Exact contact with chosen pairs open in the derivative, and with extra impulses.

In weak contact, gap and impulse of a pair are both zero, and the pair has two neighbours: an open
one, where the gap is free, and a closed one, where the impulse is free. To judge a motion from
both sides, its derivative is taken with the weak pairs open while an impulse z stands for the
multiplier that they could have,

    D w + N^T (p + z) = r,    N w <= b,    p . (b - N w) = 0,    z = 0.

Both the set of open pairs and z belong to the pairs of a step, so the time loop asks for `at_step`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact.complementarity import ContactSolver, Guess, Solution
from jaxcontact.contact.vi import ContactProblem


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OpenInDerivative:
    """A contact solver with some pairs open in the derivative, whatever their state."""

    contact_solver: ContactSolver
    """Solves the step."""

    is_open: Array
    """(C,) bool."""

    def first_memory(self, compliance: Array) -> Any:
        """Return what the solver keeps between steps; see `ContactSolver.first_memory`."""
        return self.contact_solver.first_memory(compliance)

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Guess) -> Solution:
        """Solve the complementarity problem; see `ContactSolver.solve`."""
        return self.contact_solver.solve(compliance, offset, resolution, guess)

    def softness(self, solution_multiplier: Array, separation: Array) -> Array:
        """Return zero for closed pairs and infinity for open ones, (C,)."""
        is_closed = (solution_multiplier > 0.0) & ~self.is_open
        return jnp.where(is_closed, 0.0, jnp.inf)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ProbedProblem:
    """A contact problem with open pairs and an extra impulse for every step."""

    problem: ContactProblem
    """The contact problem of a step."""

    is_open: Array
    """Pairs that are open in the derivative, (T, C) bool."""

    push: Array
    """z, (T, C) [N s]; positive pushes the body away from the obstacle. Zero is the motion."""

    def at_step(self, step: Array) -> ProbedProblem:
        """Return the problem of one step."""
        return replace(self, is_open=self.is_open[step], push=self.push[step])

    def first_guess(self) -> Guess:
        """Return where the first step starts."""
        return self.problem.first_guess()

    def solve(
        self, rhs: Array, bound: Array, resolution: Array, guess: Guess
    ) -> tuple[Array, Solution]:
        """Solve the VI of one step; see `ContactProblem.solve`."""
        solver = OpenInDerivative(self.problem.contact_solver, self.is_open)
        rhs = rhs - self.problem.normals.transposed_product(self.push, rhs.shape[0])
        problem = replace(self.problem, contact_solver=solver)
        w, solution = problem.solve(rhs, bound, resolution, guess)
        return w, solution._replace(multiplier=solution.multiplier + self.push)


def with_probe(tree: Any, is_open: Array, push: Array) -> Any:
    """Return a pytree whose contact problem has open pairs (T, C) and a push (T, C)."""

    def is_problem(node: Any) -> bool:
        return isinstance(node, ContactProblem)

    def probe(node: Any) -> Any:
        return ProbedProblem(node, is_open, push) if is_problem(node) else node

    return jax.tree.map(probe, tree, is_leaf=is_problem)


def at_step(operators: Any, step: Array) -> Any:
    """Return the operators of one step: the same ones, unless they are probed."""

    def is_probed(node: Any) -> bool:
        return isinstance(node, ProbedProblem)

    return jax.tree.map(
        lambda node: node.at_step(step) if is_probed(node) else node,
        operators,
        is_leaf=is_probed,
    )
