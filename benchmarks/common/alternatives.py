"""Two ways to differentiate through contact without theory: both are simple, and both are compared.

The time step is that of the contact-implicit scheme (MATH.md 2) with the same factor of D, so that
only the treatment of contact differs. Derivative: plain autodiff of what is written here; a solve
with the constant matrix D is its own transpose.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

import jaxcontact as jc


def penalty(stepper: jc.Stepper, initial: jc.State, control: Array) -> Array:
    """Return displacements (T+1, N, d) where a spring acts on every pair that penetrates.

    The springs push explicitly with the largest stiffness that is stable: half of the effective
    inertia (N D^-1 N^T)^-1 of a pair over the square of the time step.
    """
    dt, normals = stepper.dt, stepper.system.normals
    problem = stepper.operators.problem
    stiffness = 0.5 / (dt**2 * jnp.diagonal(problem.form.factor.compliance))

    def step(state: tuple[Array, Array], force: Array):
        y, v = state
        rhs = _free_rhs(stepper, y, v, force)
        depth = jnp.maximum(normals @ y - stepper.system.gap, 0.0)
        rhs = rhs - 0.5 * dt * normals.transposed_product(stiffness * depth, y.shape[0])
        w = jax.lax.custom_linear_solve(
            lambda x: problem.matrix @ x,
            rhs,
            lambda _, r: problem.form.factor.solve(r),
            symmetric=True,
        )
        return (y + dt * w, 2.0 * w - v), y + dt * w

    return _scan(stepper, initial, control, step)


def unrolled_gauss_seidel(
    stepper: jc.Stepper, initial: jc.State, control: Array, sweeps: int
) -> Array:
    """Return displacements (T+1, N, d) where autodiff runs through every relaxation of a pair."""
    dt, normals = stepper.dt, stepper.system.normals
    problem = stepper.operators.problem
    compliance = problem.form.factor.compliance
    diagonal = jnp.diagonal(compliance)
    order = jnp.tile(jnp.arange(diagonal.shape[0]), sweeps)

    def solve(rhs: Array) -> Array:
        return jax.lax.custom_linear_solve(
            lambda x: problem.matrix @ x,
            rhs,
            lambda _, r: problem.form.factor.solve(r),
            symmetric=True,
        )

    def step(state: tuple[Array, Array], force: Array):
        y, v = state
        rhs = _free_rhs(stepper, y, v, force)
        offset = (stepper.system.gap - normals @ y) / dt - normals @ solve(rhs)

        def relax(p: Array, i: Array):
            g = jnp.dot(compliance[i], p) + offset[i]
            return p.at[i].set(jnp.maximum(0.0, p[i] - g / diagonal[i])), None

        p, _ = jax.lax.scan(relax, jnp.zeros_like(offset), order)
        w = solve(rhs - normals.transposed_product(p, y.shape[0]))
        return (y + dt * w, 2.0 * w - v), y + dt * w

    return _scan(stepper, initial, control, step)


def _free_rhs(stepper: jc.Stepper, y: Array, v: Array, force: Array) -> Array:
    """Return M v - dt/2 (A y - f), (n,)."""
    system = stepper.system
    load = system.load + system.control_load(force)
    return system.mass @ v - 0.5 * stepper.dt * (system.stiffness @ y - load)


def _scan(stepper: jc.Stepper, initial: jc.State, control: Array, step) -> Array:
    system = stepper.system
    start = system.restrict(initial.displacement), system.restrict(initial.velocity)
    _, states = jax.lax.scan(step, start, control)
    return system.lift(jnp.concatenate([start[0][None], states]))
