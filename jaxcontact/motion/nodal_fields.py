"""Nodal displacement and velocity of a motion, made from its unknowns when they are asked for."""

from __future__ import annotations

from dataclasses import dataclass

import jax
from jax import Array
from jax.core import Tracer
from jax.interpreters.ad import JVPTracer

from jaxcontact.system.lift import Lift


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StoredFields:
    """Nodal fields as a file keeps them: what they are made of, or themselves."""

    lift: Lift | None
    """What makes them of unknowns and rates; None if they are there."""

    displacement: Array | None
    """Nodal displacement, (..., N, d) [m]; None where it is made."""

    velocity: Array | None
    """Nodal velocity, (..., N, d) [m/s]; None where it is made."""


NAMES: tuple[str, str] = ("displacement", "velocity")


@jax.tree_util.register_pytree_node_class
class NodalFields:
    """Displacement and velocity of all nodes.

    As a pytree it has these two as leaves: where a trajectory leaves jit or vmap as a whole, or is
    subtracted from another one, they are there as arrays.
    """

    def __init__(self, lift: Lift, unknowns: Array, rates: Array):
        """Keep what the fields are made of: the unknowns (..., n) and their velocity."""
        self._lift: Lift | None = lift
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
        if self._lift is None or all(name in self._fields for name in NAMES):
            return self.displacement[level], self.velocity[level]
        unknowns, rates = self._sources.values()
        return self._lift(unknowns[level]), self._lift(rates[level])

    def _field(self, name: str) -> Array:
        if name in self._fields or self._lift is None:
            return self._fields[name]
        field = self._lift(self._sources[name])
        # A tracer belongs to the transformation that asks.
        if not isinstance(field, Tracer):
            self._fields[name] = field
        return field

    def stored(self) -> StoredFields:
        """Return what a file keeps of them, no field made for it."""
        if self._lift is None:
            return StoredFields(None, self.displacement, self.velocity)
        return StoredFields(self._lift, None, None)

    @classmethod
    def from_stored(cls, stored: StoredFields, unknowns: Array, rates: Array) -> NodalFields:
        """Return the fields of a file, beside the unknowns (..., n) and their velocity in it."""
        if stored.lift is not None:
            return cls(stored.lift, unknowns, rates)
        assert stored.displacement is not None
        assert stored.velocity is not None
        return cls.tree_unflatten(None, (stored.displacement, stored.velocity))

    def tree_flatten(self) -> tuple[tuple[Array, Array], None]:
        """Return both fields."""
        return (self.displacement, self.velocity), None

    @classmethod
    def tree_unflatten(cls, _: None, fields: tuple[Array, Array]) -> NodalFields:
        """Return the fields as they are given."""
        whole = object.__new__(cls)
        whole._lift = None
        whole._fields = {NAMES[0]: fields[0], NAMES[1]: fields[1]}
        return whole
