"""Several bodies as one mesh, each with nodes of its own."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from jaxcontact.scene.mesh import Mesh


def join(meshes: Mapping[str, Mesh]) -> Mesh:
    """Return one mesh of several bodies that share no nodes.

    Args:
        meshes: the bodies by name, each in its place (see `Mesh.moved`).

    Returns:
        A mesh with nodes and cells in the order of the bodies. Facet set "contact" and region
        "core" of the body "ball" are "ball/contact" and "ball/core", the region "ball" is all of
        its cells.

    Raises:
        ValueError: if there is no body, a name is no string, the dimensions differ, or two sets or
            regions get one name.

    Derivative: by the points of every body.

    Example:
        >>> bar = jc.meshes.interval(1.0, h=0.5)
        >>> sorted(jc.join({"a": bar, "b": bar.moved(translation=[1.1])}).facets)
        ['a/left', 'a/right', 'b/left', 'b/right']
    """
    if not meshes or not all(isinstance(name, str) for name in meshes):
        raise ValueError(f"join needs bodies by name, got the names {list(meshes)}")
    dimensions = {name: mesh.dimension for name, mesh in meshes.items()}
    if len(set(dimensions.values())) > 1:
        raise ValueError(f"the meshes have different dimensions: {dimensions}")
    cells, facets, regions = [], [], []
    first_node = first_cell = 0
    for body, mesh in meshes.items():
        cells.append(mesh.cells + np.int32(first_node))
        facets += [(f"{body}/{name}", x + np.int32(first_node)) for name, x in mesh.facets.items()]
        whole = np.arange(mesh.n_cells, dtype=np.int32)
        named = [(body, whole), *((f"{body}/{name}", x) for name, x in mesh.regions.items())]
        regions += [(name, x + np.int32(first_cell)) for name, x in named]
        first_node, first_cell = first_node + mesh.n_nodes, first_cell + mesh.n_cells
    for what, parts in (("facet sets", facets), ("regions", regions)):
        names = [name for name, _ in parts]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"{what} {twice} would be there twice; rename a body")
    points = [mesh.points for mesh in meshes.values()]
    layouts = [mesh.layout for mesh in meshes.values()]
    xp = jnp if any(isinstance(x, jax.Array) for x in points) else np
    known = [x for x in layouts if x is not None]
    layout = np.concatenate(known) if len(known) == len(layouts) else None
    return Mesh(xp.concatenate(points), np.concatenate(cells), dict(facets), dict(regions), layout)
