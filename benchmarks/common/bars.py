"""Bars with an exact solution: scene, initial state and errors of a run, averaged over phases.

P1 is the clamped bar that snaps against a wall, P2 the free bar that flies against it, P3 the bar
that falls on a floor. The phase is the place of the first touch inside a time step; a single phase
can look lucky, so every figure is a mean over several.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc

WALL = {"left": jc.HalfSpace(point=np.array([0.0]), normal=np.array([1.0]))}


class Bar(NamedTuple):
    """A bar problem: what is fixed before mesh and step are chosen."""

    exact: Any
    """Exact solution of `jaxcontact.reference`; its gap is that of phase zero."""

    clamped: tuple[str, ...]
    """Clamped facet sets."""

    velocity: float
    """Initial velocity, [m/s]."""

    duration: float
    """Time to simulate, [s]."""

    gravity: float = 0.0
    """Gravity, [m/s^2], towards the wall."""

    @property
    def has_gap(self) -> bool:
        """True if the bar starts at a distance from the wall; else it starts with u(x, 0)."""
        return hasattr(self.exact, "gap")


def clamped_bar(periods: float = 1.0) -> Bar:
    """P1: u(L) = 0, released from the strain of a = L/2."""
    exact = jc.reference.ClampedBar()
    return Bar(exact, ("right",), 0.0, 3.0 * periods)


def free_bar() -> Bar:
    """P2: E = 900, L = 10, gap 5, thrown with 10 m/s; 0.5 s after the rebound."""
    exact = jc.reference.FreeBar()
    return Bar(exact, (), -exact.impact_speed, 0.5 + 2.0 / 3.0 + 0.5)


def falling_bar() -> Bar:
    """P3: the same bar, falling from 5 m with g = 10; one bounce, before the next impact."""
    exact = jc.reference.FallingBar()
    return Bar(exact, (), 0.0, 1.0 + 2.0 / 3.0 + 1.5, gravity=exact.gravity)


PROBLEMS = {"P1": clamped_bar, "P2": free_bar, "P3": falling_bar}


def discretize(bar: Bar, n: int, *, viscosity: float = 0.0, dtype: Any = jnp.float64) -> jc.System:
    """Return the system of n equal cells; viscosity is that of the bar, [Pa s]."""
    exact = bar.exact
    load = {"body_force": np.array([-exact.density * bar.gravity])} if bar.gravity else {}
    scene = jc.Scene(
        mesh=jc.meshes.interval(exact.length, h=exact.length / n),
        material=jc.KelvinVoigt(
            young=exact.young, poisson=0.0, density=exact.density, bulk_viscosity=viscosity
        ),
        clamped=bar.clamped,
        contact=WALL,
        **load,
    )
    return jc.discretize(scene, dtype=dtype)


def time_step(bar: Bar, n: int, courant: float) -> float:
    """Return the time step of a Courant number c tau / h, [s]."""
    return courant * bar.exact.length / n / float(bar.exact.wave_speed())


def phases(bar: Bar, dt: float, count: int) -> np.ndarray:
    """Return the parameter of each phase, (count,): the gap [m], or for P1 a shift of the step."""
    fractions = (np.arange(count) + 0.5) / count
    if not bar.has_gap:
        return fractions
    speed = abs(bar.velocity) or float(bar.exact.rebound_velocity())
    return bar.exact.gap + speed * dt * fractions


class Errors(NamedTuple):
    """Errors of one run; each a scalar."""

    displacement: jax.Array
    """l2 error of the distance from the wall over nodes and time levels, relative."""

    force: jax.Array
    """Sum of |f - exact mean of the step| tau over the exact impulse of the run."""

    end_force: jax.Array
    """The same with the force at the end of a step (equal to it but for Trapezoidal)."""

    oscillation: jax.Array
    """Standard deviation of f minus exact in the middle 60 % of the first contact, over p."""

    end_oscillation: jax.Array
    """The same with the force at the end of a step."""

    final_energy: jax.Array
    """Energy at the end over that at the start."""

    largest_energy: jax.Array
    """Largest energy over that at the start."""

    ledger: jax.Array
    """Largest residual of the energy ledger over the energy at the start."""


def place(bar: Bar, stepper: jc.Stepper, phase: jax.Array) -> tuple[Any, jc.Stepper, jc.State]:
    """Return exact solution, stepper and initial state of one phase."""
    system, exact = stepper.system, bar.exact
    x = system.points
    if bar.has_gap:
        exact = dataclasses.replace(exact, gap=phase)
        system = dataclasses.replace(system, gap=jnp.reshape(phase, (1,)).astype(system.dtype))
        displacement = jnp.zeros_like(x)
    else:
        displacement = exact.displacement(x, 0.0).astype(system.dtype)
    initial = jc.State(displacement, jnp.full_like(x, bar.velocity))
    return exact, dataclasses.replace(stepper, system=system), initial


def n_steps(bar: Bar, dt: float) -> int:
    """Return the number of steps of a run."""
    return math.ceil((bar.duration + dt) / dt)


@partial(jax.jit, static_argnums=(0, 4))
def errors(bar: Bar, stepper: jc.Stepper, phase: jax.Array, count: jax.Array, steps: int) -> Errors:
    """Run one phase of a bar and compare it with the exact solution.

    Args:
        bar: the problem.
        stepper: from `discretize` and `prepare`.
        phase: one of `phases`.
        count: the number of steps that are compared, at most `steps`.
        steps: the number of steps that are made; one program serves every count below it.
    """
    exact, stepper, initial = place(bar, stepper, phase)
    trajectory = jc.simulate(stepper, steps=steps, initial=initial)
    ledger = jc.energy(stepper, trajectory)
    x, dt = stepper.system.points[:, 0], stepper.dt
    start, end = trajectory.time[:-1], trajectory.time[1:]
    is_step = jnp.arange(steps) < count
    is_level = jnp.arange(steps + 1) <= count
    offset = exact.gap if bar.has_gap else 0.0
    distance = offset + exact.displacement(x[None, :], trajectory.time[:, None])
    error = offset + trajectory.displacement[:, :, 0] - distance

    mean = trajectory.contact_impulse[:, 0] / dt
    last = mean
    if isinstance(stepper.scheme, jc.Trapezoidal):
        # Its impulse is tau times the mean of old and new force.
        _, last = jax.lax.scan(lambda c, f: (2 * f - c,) * 2, jnp.zeros((), mean.dtype), mean)
    exact_mean = exact.contact_force_mean(start, end)
    impulse = jnp.sum(exact_mean, where=is_step) * dt
    touch, leave = exact.contact_interval()
    middle = (start + end) / 2 - touch
    inside = (middle > 0.2 * (leave - touch)) & (middle < 0.8 * (leave - touch))
    level = jnp.sum(exact_mean * inside) / jnp.sum(inside)
    total = ledger.total + _potential(stepper, trajectory)

    def force_error(force: jax.Array) -> jax.Array:
        return jnp.sum(jnp.abs(force - exact_mean), where=is_step) * dt / impulse

    def oscillation(force: jax.Array) -> jax.Array:
        return jnp.std(force - exact_mean, where=inside) / level

    def squares(field: jax.Array) -> jax.Array:
        return jnp.sum(jnp.sum(field**2, axis=1), where=is_level)

    return Errors(
        displacement=jnp.sqrt(squares(error) / squares(distance)),
        force=force_error(mean),
        end_force=force_error(last),
        oscillation=oscillation(mean),
        end_oscillation=oscillation(last),
        final_energy=total[count] / total[0],
        largest_energy=jnp.max(total, where=is_level, initial=0.0) / total[0],
        ledger=jnp.max(jnp.abs(ledger.residual), where=is_step, initial=0.0) / total[0],
    )


def _potential(stepper: jc.Stepper, trajectory: jc.Trajectory) -> jax.Array:
    """Return the energy of the load, zero if the body stands on the wall, (T+1,)."""
    system = stepper.system
    weight = jnp.sum(system.load)
    displacement = jax.vmap(lambda u: jnp.dot(system.load, system.restrict(u)))
    height = system.gap[0]
    return -displacement(trajectory.displacement) - weight * height


def run(
    bar: Bar,
    scheme: Any,
    n: int,
    courant: float,
    *,
    count: int = 8,
    viscosity: float = 0.0,
    dtype: Any = jnp.float64,
    compiled_steps: int = 0,
) -> Errors:
    """Return the errors of every phase, each (count,) NumPy.

    Args:
        bar: the problem.
        scheme: the time-stepping scheme.
        n: number of cells.
        courant: Courant number.
        count: number of phases.
        viscosity: viscosity of the bar, [Pa s].
        dtype: floating point type.
        compiled_steps: make at least so many steps, so that runs of several Courant numbers share
            one compiled program.
    """
    dt = time_step(bar, n, courant)
    system = discretize(bar, n, viscosity=viscosity, dtype=dtype)
    fractions = phases(bar, dt, count)
    steppers = {}
    rows = []
    for phase in fractions:
        # P1 touches at L/c: there the step, not the gap, is moved by a fraction of a step.
        length = 1.0 if bar.has_gap else 1.0 / (1.0 + phase * courant / n)
        if length not in steppers:
            steppers[length] = jc.prepare(system, dt * length, scheme=scheme)
        compared = n_steps(bar, dt)
        steps = max(compared, compiled_steps)
        rows.append(errors(bar, steppers[length], jnp.asarray(phase, dtype), compared, steps))
    return Errors(*(np.array(values, float) for values in zip(*rows, strict=True)))
