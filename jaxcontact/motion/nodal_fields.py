"""Nodal displacement and velocity of a motion, made from its unknowns when they are asked for."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import jax
from jax import Array
from jax.core import Tracer
from jax.interpreters.ad import JVPTracer
from jax.tree_util import GetAttrKey

from jaxcontact.system.lift import Lift


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StoredFields:
    """Nodal fields as a file keeps them."""

    unknowns: Array
    """The unknowns, (..., n)."""

    rates: Array
    """Their velocity, (..., n)."""

    lift: Lift | None
    """What makes nodal fields of them; None if these are there."""

    displacement: Array | None
    """Nodal displacement, (..., N, d) [m]; None where it is made."""

    velocity: Array | None
    """Nodal velocity, (..., N, d) [m/s]; None where it is made."""


NAMES: tuple[str, str] = ("displacement", "velocity")


@jax.tree_util.register_pytree_with_keys_class
class NodalFields:
    """Displacement and velocity of all nodes, and the unknowns that they are made of.

    As a pytree it has all of them as leaves: where a trajectory leaves jit or vmap as a whole, or
    is subtracted from another one, they are there as arrays. Where the nodal fields are the
    unknowns in another shape, without a basis or clamped nodes, there is nothing more to keep.
    """

    def __init__(self, lift: Lift, unknowns: Array, rates: Array):
        """Keep what the fields are made of: the unknowns (..., n) and their velocity."""
        self._lift: Lift | None = lift
        self.unknowns, self.rates = unknowns, rates
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
        assert self._lift is not None
        return self._lift(self.unknowns[level]), self._lift(self.rates[level])

    def shown(self, displacement: Array, velocity: Array) -> NodalFields:
        """Return the same unknowns with other nodal fields (..., N, d)."""
        return self.tree_unflatten(None, (self.unknowns, self.rates, displacement, velocity))

    @property
    def _sources(self) -> dict[str, Array]:
        return dict(zip(NAMES, (self.unknowns, self.rates), strict=True))

    def _field(self, name: str) -> Array:
        if name in self._fields:
            return self._fields[name]
        assert self._lift is not None
        source = self._sources[name]
        if isinstance(source, jax.ShapeDtypeStruct):
            return jax.eval_shape(self._lift, source)
        field = self._lift(source)
        # A tracer belongs to the transformation that asks.
        if not isinstance(field, Tracer):
            self._fields[name] = field
        return field

    def stored(self) -> StoredFields:
        """Return what a file keeps of them, no field made for it."""
        fields = (self.displacement, self.velocity) if self._lift is None else (None, None)
        return StoredFields(self.unknowns, self.rates, self._lift, *fields)

    @classmethod
    def from_stored(cls, stored: StoredFields) -> NodalFields:
        """Return the fields of a file."""
        if stored.lift is not None:
            return cls(stored.lift, stored.unknowns, stored.rates)
        fields = (stored.unknowns, stored.rates, stored.displacement, stored.velocity)
        return cls.tree_unflatten(None, fields)  # type: ignore[arg-type]

    def tree_flatten_with_keys(self) -> tuple[list[tuple[Hashable, Array]], int | None]:
        """Return the leaves, and the space dimension where the unknowns are the fields too."""
        lift = self._lift
        dimension = lift.dimension if lift is not None and lift.is_reshape else None
        names = ("unknowns", "rates", *(NAMES if dimension is None else ()))
        return [(GetAttrKey(name), getattr(self, name)) for name in names], dimension

    @classmethod
    def tree_unflatten(cls, dimension: int | None, children: tuple[Array, ...]) -> NodalFields:
        """Return the fields as they are given."""
        whole = object.__new__(cls)
        whole.unknowns, whole.rates = children[:2]
        whole._lift = None if dimension is None else Lift(None, None, dimension, False)
        whole._fields = dict(zip(NAMES, children[2:], strict=False))
        return whole
