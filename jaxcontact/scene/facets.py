"""Contact with another body of the same mesh, named by its facets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import jax
import numpy as np
from jax import Array

from jaxcontact.scene.mesh import Mesh
from jaxcontact.transforms.traced import as_array, is_traced


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Facets:
    """The facets of another body as what a contact set may touch; both bodies may move.

    Of the two surfaces the contact set is the one whose nodes carry the constraints and the
    contact pressure: take the coarser or the more curved one. A node from which no facet is seen
    along the contact direction has no constraint; facets that it has penetrated by more than the
    size of its cells are not seen.
    """

    name: str = field(metadata={"static": True})
    """Name of a facet set of the mesh that shares no node with the contact set."""

    along: Array | np.ndarray | None = None
    """Contact direction from the contact set to these facets, (d,), of any positive length and
    concrete; None is the outward normal of the contact set at each node."""


def check_facets(name: str, facets: Facets, mesh: Mesh) -> None:
    """Check the facets that a contact set may touch.

    Args:
        name: of the contact set, a facet set of the mesh.
        facets: the facets it may touch.
        mesh: the mesh of both.

    Raises:
        ValueError: if the facets are not in the mesh or share nodes with the contact set, or the
            direction is no vector of the dimension, traced, not finite or zero.
    """
    if facets.name not in mesh.facets:
        raise ValueError(
            f"Facets({facets.name!r}) of contact set {name!r} is not in the mesh; it has "
            f"{sorted(mesh.facets)}"
        )
    shared = np.intersect1d(mesh.facets[name], mesh.facets[facets.name])
    if shared.size:
        raise ValueError(
            f"contact set {name!r} and Facets({facets.name!r}) share {shared.size} nodes, first "
            f"{shared[:5].tolist()}; bodies in contact need nodes of their own: put their meshes "
            "together by jc.join"
        )
    if facets.along is None:
        return
    where, along = f"Facets({facets.name!r}).along", as_array(facets.along)
    if along.shape != (mesh.dimension,):
        raise ValueError(f"{where} must have shape ({mesh.dimension},), got {along.shape}")
    if is_traced(along):
        raise ValueError(
            f"{where} must be concrete, since the facets that meet are searched along it; give it "
            "as a NumPy array from outside of jit, grad and vmap"
        )
    if not np.all(np.isfinite(along)) or not np.any(along):
        raise ValueError(f"{where} must be finite and not zero, got {along}")


def check_each_interface_once(contact: Mapping[str, object], mesh: Mesh) -> None:
    """Check that no body constrains, directly or over others, the facets that constrain it.

    With nodes of contact sets that meet no facets of a later one, the contact rows can be ordered
    so that the part of N on these nodes is triangular: they are independent.

    Raises:
        ValueError: if the contact sets and the facets they touch form a cycle.
    """
    pairs = {name: other.name for name, other in contact.items() if isinstance(other, Facets)}
    nodes = {name: np.unique(mesh.facets[name]) for name in (*pairs, *pairs.values())}
    left = dict(pairs)
    # What touches no other contact set, or is touched by none, is in no cycle and drops out.
    while left:
        touches = {
            (first, second)
            for first, other in left.items()
            for second in left
            if np.intersect1d(nodes[other], nodes[second]).size
        }
        kept = {first for first, _ in touches} & {second for _, second in touches}
        if len(kept) == len(left):
            break
        left = {name: left[name] for name in kept}
    if not left:
        return
    arrows = " and ".join(f"{name!r} -> {other!r}" for name, other in sorted(left.items()))
    raise ValueError(
        f"contact {arrows} constrain the same gap twice; keep one of them, best that of the "
        "coarser or more curved surface"
    )
