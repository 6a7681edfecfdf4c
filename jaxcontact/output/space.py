"""Bodies in space by PyVista (extra `space`), which hides what is hidden; `jc.plot` has it too."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.output.body import MARGIN, places, scalars_of
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.scene import Scene, contact_obstacles

#: Points along each axis of the grid on which obstacles are looked for.
OBSTACLE_GRID = 40


def space_body(
    scene: Scene,
    displacement: ArrayLike | None = None,
    values: ArrayLike | None = None,
    *,
    label: str = "",
    scale: float = 1.0,
    path: str | Path | None = None,
) -> Any:
    """Draw the bodies of a scene in space with their obstacles.

    Args:
        scene: the scene, d = 3.
        displacement: moves the nodes, (N, d) [m]; default the reference configuration.
        values: colours the body, as of `plot_body`.
        label: name and unit of the values, below the colour bar.
        scale: factor of the displacement.
        path: `.png` to write; no window is opened then.

    Returns:
        The `pyvista.Plotter`; its method `show` opens a window, or a view in a notebook.

    Raises:
        ValueError: if the scene is not in space, or a field does not fit the mesh.
        ImportError: if PyVista is missing.
    """
    mesh = scene.mesh
    if mesh.dimension != 3:
        raise ValueError(f"this picture is for d = 3, got d = {mesh.dimension}; use plot_body")
    try:
        pyvista = importlib.import_module("pyvista")
    except ImportError as error:
        raise ImportError("this needs PyVista: pip install 'jaxcontact[space]'") from error
    x = places(mesh, displacement, scale)
    cells = np.column_stack([np.full(mesh.n_cells, 4), np.asarray(mesh.cells)])
    kinds = np.full(mesh.n_cells, pyvista.CellType.TETRA)
    body = pyvista.UnstructuredGrid(cells.ravel(), kinds, x)
    plotter = pyvista.Plotter(off_screen=path is not None)
    colours = {"color": "lightsteelblue"}
    if values is not None:
        colours = {"scalars": scalars_of(mesh, values), "cmap": "viridis"}
        colours["scalar_bar_args"] = {"title": label, "vertical": False}
    plotter.add_mesh(body, show_edges=True, edge_opacity=0.3, **colours)
    for name, surface in _obstacles(scene, x, pyvista):
        plotter.add_mesh(surface, color="lightgray", opacity=0.5, label=name)
    plotter.add_axes()
    if path is not None:
        plotter.screenshot(str(path))
    return plotter


def _obstacles(scene: Scene, x: np.ndarray, pyvista: Any) -> list[tuple[str, Any]]:
    """Return the surfaces of the rigid obstacles in a box around the body, as far as they are."""
    low, high = x.min(axis=0), x.max(axis=0)
    room = 2.0 * MARGIN * np.max(high - low)
    axes = [np.linspace(a - room, b + room, OBSTACLE_GRID) for a, b in zip(low, high, strict=True)]
    grid = pyvista.RectilinearGrid(*axes)
    found = []
    for name, obstacle in contact_obstacles(scene):
        if isinstance(obstacle, Facets):
            continue
        phi = np.asarray(jax.vmap(obstacle.signed_distance)(jnp.asarray(grid.points)))
        if phi.min() < 0.0 < phi.max():
            found.append((name, grid.contour([0.0], scalars=phi)))
    return found
