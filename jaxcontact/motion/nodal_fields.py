"""Nodal displacement and velocity of a motion, made from its unknowns when they are asked for."""

from __future__ import annotations

import jax
from jax import Array
from jax.core import Tracer
from jax.interpreters.ad import JVPTracer

from jaxcontact.system.lift import Lift

NAMES: tuple[str, str] = ("displacement", "velocity")


@jax.tree_util.register_pytree_node_class
class NodalFields:
    """Displacement and velocity of all nodes.

    As a pytree it has these two as leaves: where a trajectory leaves jit or vmap as a whole, or is
    subtracted from another one, they are there as arrays.
    """

    def __init__(self, lift: Lift, unknowns: Array, rates: Array):
        """Keep what the fields are made of: the unknowns (..., n) and their velocity."""
        self._lift = lift
        self._sources: dict[str, Array] = dict(zip(NAMES, (unknowns, rates), strict=True))
        self._fields: dict[str, Array] = {}
        # jax.jvp takes apart what a function returns when nothing can be traced any more.
        if isinstance(unknowns, JVPTracer) or isinstance(rates, JVPTracer):
            self._fields |= {name: lift(source) for name, source in self._sources.items()}

    @property
    def displacement(self) -> Array:
        """Nodal displacement, (..., N, d) [m]."""
        return self._field("displacement")

    @property
    def velocity(self) -> Array:
        """Nodal velocity, (..., N, d) [m/s]."""
        return self._field("velocity")

    def at(self, level: int) -> tuple[Array, Array]:
        """Return displacement and velocity (..., N, d) at one of the first axis, no others made."""
        if all(name in self._fields for name in NAMES):
            return self.displacement[level], self.velocity[level]
        unknowns, rates = self._sources.values()
        return self._lift(unknowns[level]), self._lift(rates[level])

    def _field(self, name: str) -> Array:
        if name in self._fields:
            return self._fields[name]
        field = self._lift(self._sources[name])
        # A tracer belongs to the transformation that asks.
        if not isinstance(field, Tracer):
            self._fields[name] = field
        return field

    def tree_flatten(self) -> tuple[tuple[Array, Array], None]:
        """Return both fields."""
        return (self.displacement, self.velocity), None

    @classmethod
    def tree_unflatten(cls, _: None, fields: tuple[Array, Array]) -> NodalFields:
        """Return the fields as they are given."""
        whole = object.__new__(cls)
        whole._fields = {NAMES[0]: fields[0], NAMES[1]: fields[1]}
        return whole
