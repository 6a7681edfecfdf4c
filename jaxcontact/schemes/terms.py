"""Terms that the schemes share: trapezoidal matrix, admissible velocity, losses of a step."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import Bound
from jaxcontact.schemes.interface import StepState
from jaxcontact.system.pair_set import Pairs
from jaxcontact.system.sparse import ComponentwiseMatrix, SymmetricMatrix
from jaxcontact.system.system import System


def trapezoidal_matrix(system: System, dt: Array) -> SymmetricMatrix:
    """Return D = M + tau/2 B + tau^2/4 A, (n, n)."""
    values = _trapezoidal_values(system.mass, system.stiffness, system.viscosity, dt)
    return SymmetricMatrix(values, system.stiffness.columns)


# The values alone: the pattern must stay concrete where the caller is under jit.
@jax.jit
def _trapezoidal_values(
    mass: ComponentwiseMatrix | SymmetricMatrix,
    stiffness: SymmetricMatrix,
    viscosity: SymmetricMatrix | None,
    dt: Array,
) -> Array:
    matrix = mass + 0.25 * dt**2 * stiffness
    return (matrix if viscosity is None else matrix + 0.5 * dt * viscosity).values


def velocity_bound(system: System, dt: Array, y: Array, v: Array) -> Bound:
    """Return (psi - N y)/tau, the largest admissible normal velocity, with its rounding error.

    Args:
        system: the system.
        dt: tau, scalar [s].
        y: displacement at the start of the step, (n,) [m].
        v: velocity at the start of the step, (n,) [m/s]; it bounds the rounding of the free motion.
    """
    # Of the contact nodes only: a reduction over all unknowns in every step shows in its time.
    touched = system.normals.touched
    largest = jnp.max(jnp.maximum(jnp.abs(touched(y)), dt * jnp.abs(touched(v))), initial=0.0)
    resolution = _gap_resolution(system, y, largest) / dt
    return Bound((system.gap - system.normals @ y) / dt, resolution)


def gap_resolution(pairs: Pairs, y: Array) -> Array:
    """Return the rounding error of the gap psi - N y and of what follows from y, (C,) [m].

    A smaller gap is closed. The geometry has the error of its positions, and the free motion that
    of A y, whose terms cancel: tau N D^-1 (tau A y) is at most some max |y|, for every tau. The
    largest y of the contact nodes stands for it; inside, a body at rest may move more.
    """
    largest = jnp.max(jnp.abs(pairs.normals.touched(y)), initial=0.0)
    return _gap_resolution(pairs, y, largest)


def _gap_resolution(pairs: Pairs, y: Array, largest: Array) -> Array:
    """Return the resolution for terms of the free motion as large as a displacement, (C,)."""
    size = pairs.normals.absolute() @ (jnp.abs(y) + largest)
    rounding = pairs.gap_rounding + 4.0 * jnp.finfo(y.dtype).eps * size
    return jax.lax.stop_gradient(rounding)


def elastic_force(system: System, state: StepState) -> Array | float:
    """Return A y, (n,) [N]; zero with frames, whose contact problem holds the force, MATH.md 12."""
    return system.stiffness @ state.displacement if state.frames is None else 0.0


def viscous_loss(system: System, dt: Array, increment: Array) -> Array:
    """Return tau w.Bw, the energy [J] that the viscosity takes from the increment tau w (n,)."""
    if system.viscosity is None:
        return jnp.zeros((), increment.dtype)
    return jnp.dot(increment, system.viscosity @ increment) / dt


def impact_loss(system: System, dt: Array, old: StepState, new: StepState) -> Array:
    """Return lam.N(y' - y)/tau [J], the work of the impulse against the contact.

    With exact contact the new gap of a pressed pair is zero, so that it is lam.(psi - N y)/tau.
    """
    increment = new.displacement - old.displacement
    return jnp.dot(new.impulse, system.normals @ increment) / dt
