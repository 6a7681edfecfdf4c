"""Clamped sets that are moved, each as a whole: the forces they exert and the work they do.

The columns of the translations of the moved sets in the matrices of all nodes are A_fc, B_fc, M_fc
for the unknowns and A_cc, B_cc, M_cc for the sets themselves. A step in which the sets go from g to
g' = g + tau w_d, with velocities v_d and v_d', has for the unknowns the load

    - [A_fc (g + g')/2 + B_fc w_d + M_fc (v_d' - v_d)/tau],

with A_fc g' in a scheme that takes elastic forces at the end of a step (`force_of_step`). v_d is
the central difference of g, at the first and last level the slope of a parabola. The ledger is that
of all nodes, with the work of the supports

    (g' - g) . [A_cf (y + y')/2 + A_cc (g + g')/2 + B_cf w + B_cc w_d]
        + (v_d + v_d')/2 . [M_cf (v' - v) + M_cc (v_d' - v_d)].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxcontact.schemes import Scheme, StepState
from jaxcontact.schemes.interface import force_of_step
from jaxcontact.system.assembly import hat_gradients, mass_blocks, stiffness_blocks
from jaxcontact.system.parts import ClampedSet
from jaxcontact.system.system import System


class Coupling(NamedTuple):
    """Forces of one kind that follow from k moves of supports: d of each set."""

    outside: Array
    """On the unknowns, (k, n)."""

    inside: Array
    """On the supports themselves, (k, k)."""


class SupportShapes(NamedTuple):
    """The forces that moves of supports exert."""

    stiffness: Coupling
    """Per displacement [N/m]."""

    viscosity: Coupling | None
    """Per velocity [N s/m]; None without viscosity."""

    inertia: Coupling
    """Per acceleration [kg]."""


class Moves(NamedTuple):
    """How supports move; leading axes of time."""

    displacement: Array
    """g, (..., k) [m]."""

    velocity: Array
    """v_d, (..., k) [m/s]."""


class StepMoves(NamedTuple):
    """How supports move in one step."""

    old: Moves
    new: Moves


class Flow(NamedTuple):
    """Terms of the ledger of one step, each scalar [J]; see `Energy`."""

    change: Array
    work: Array
    viscous: Array
    impact: Array
    numerical: Array


def moves_of(displacement: Array, dt: Array) -> Moves:
    """Return displacements at all levels, (T+1, k) [m], with their velocities."""
    if len(displacement) == 2:
        slopes = jnp.tile(displacement[1:] - displacement[:1], (2, 1))
    else:
        g = displacement
        first = -1.5 * g[:1] + 2.0 * g[1:2] - 0.5 * g[2:3]
        last = 1.5 * g[-1:] - 2.0 * g[-2:-1] + 0.5 * g[-3:-2]
        slopes = jnp.concatenate([first, 0.5 * (g[2:] - g[:-2]), last])
    return Moves(displacement, slopes / dt)


def support_shapes(system: System, sets: list[ClampedSet]) -> SupportShapes:
    """Return the forces that the moves of clamped sets exert."""
    forces = [_set_forces(system, moved) for moved in sets]
    stiffness, viscosity, inertia = zip(*forces, strict=True)
    has_viscosity = system.viscosity is not None
    return SupportShapes(
        _coupling(system, sets, stiffness),
        _coupling(system, sets, viscosity) if has_viscosity else None,
        _coupling(system, sets, inertia),
    )


def _set_forces(system: System, moved: ClampedSet) -> tuple[Array, Array, Array]:
    """Return the forces (d, N, d) per displacement, velocity and acceleration of a set.

    Entry k is the force on all nodes when it moves along axis k: the matrices of the cells that
    touch the set, assembled over the columns of its nodes.
    """
    d, n_nodes, dtype = system.dimension, system.n_nodes, system.dtype
    cells, material = jnp.asarray(moved.cells), moved.material
    gradients, volumes = hat_gradients(system.points, cells)
    in_set = jnp.zeros(n_nodes, dtype).at[moved.nodes].set(1.0)[cells]

    def assembled(blocks: Array) -> Array:
        forces = jnp.einsum("eabij,eb->eaij", blocks, in_set)
        return jnp.zeros((n_nodes, d, d), dtype).at[cells].add(forces).transpose(2, 0, 1)

    elastic, viscous = material.elastic_lame(), material.viscous_lame()
    density = jnp.broadcast_to(jnp.asarray(material.density, dtype), volumes.shape)
    mass = density[:, None, None, None, None] * mass_blocks(volumes, d)
    return (
        assembled(stiffness_blocks(gradients, volumes, elastic)),
        assembled(stiffness_blocks(gradients, volumes, viscous)),
        assembled(mass * jnp.eye(d, dtype=dtype)[None, None, None]),
    )


def _coupling(system: System, sets: list[ClampedSet], forces: Sequence[Array]) -> Coupling:
    """Return the coupling by the forces (d, N, d) of each set."""
    moves = jnp.concatenate(forces)
    inside = [jnp.sum(moves[:, moved.nodes], axis=1) for moved in sets]
    return Coupling(system.nodal_load(moves), jnp.concatenate(inside, axis=1))


def support_load(
    scheme: Scheme, system: System, dt: Array, shapes: SupportShapes, step: StepMoves
) -> Array:
    """Return the load (n,) [N] that moved supports are in one step."""
    load = -_inviscid_pull(scheme, system, dt, shapes, step)
    if shapes.viscosity is None:
        return load
    increment = step.new.displacement - step.old.displacement
    return load - (increment / dt) @ shapes.viscosity.outside


def _inviscid_pull(
    scheme: Scheme, system: System, dt: Array, shapes: SupportShapes, step: StepMoves
) -> Array:
    """Return the elastic and inertia force (n,) [N] that hold the unknowns back in one step."""
    old, new = (moves.displacement @ shapes.stiffness.outside for moves in step)
    acceleration = (step.new.velocity - step.old.velocity) / dt
    return force_of_step(scheme, system, old, new, acceleration @ shapes.inertia.outside)


def support_energy(shapes: SupportShapes, state: StepState, moves: Moves) -> tuple[Array, Array]:
    """Return the kinetic and elastic energy [J] beyond those of the unknowns."""

    def beyond(coupling: Coupling, x: Array, s: Array) -> Array:
        return jnp.dot(s, coupling.outside @ x + 0.5 * coupling.inside @ s)

    kinetic = beyond(shapes.inertia, state.velocity, moves.velocity)
    return kinetic, beyond(shapes.stiffness, state.displacement, moves.displacement)


def support_flow(
    scheme: Scheme,
    system: System,
    dt: Array,
    shapes: SupportShapes,
    step: StepMoves,
    old: StepState,
    new: StepState,
) -> Flow:
    """Return what moved supports add to the ledger of one step; see the module docstring."""

    def change_and_mean(first: Array, second: Array) -> tuple[Array, Array]:
        return second - first, 0.5 * (first + second)

    dy, y = change_and_mean(old.displacement, new.displacement)
    dv, v = change_and_mean(old.velocity, new.velocity)
    dg, g = change_and_mean(step.old.displacement, step.new.displacement)
    dv_d, v_d = change_and_mean(step.old.velocity, step.new.velocity)
    A, B, M = shapes.stiffness, shapes.viscosity, shapes.inertia

    static = jnp.dot(dg, A.outside @ y + A.inside @ g)
    dynamic = jnp.dot(v_d, M.outside @ dv + M.inside @ dv_d)
    middle, inert = g @ A.outside, jnp.dot(v, dv_d @ M.outside)
    change = jnp.dot(dy, middle) + inert + static + dynamic
    # What the forces that the scheme takes differ in from those of the middle.
    pull = _inviscid_pull(scheme, system, dt, shapes, step)
    numerical = jnp.dot(dy, pull - middle) - inert
    drag = friction = jnp.zeros_like(static)
    if B is not None:
        drag = jnp.dot(dg, B.outside @ dy + B.inside @ dg) / dt
        friction = drag + jnp.dot(dg, B.outside @ dy) / dt
    return Flow(change, static + dynamic + drag, friction, jnp.zeros_like(static), numerical)
