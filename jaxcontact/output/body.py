"""Pictures of bodies: deformed, coloured by a field, beside their obstacles.

A planar body is drawn with its cells, a body in space by its skin, obstacles where their signed
distance is negative. `jc.plot` has these functions too.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.output.axes import import_matplotlib, label_plane, make_axes
from jaxcontact.scene.cells import boundary_facets, facet_keys
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.mesh import Mesh
from jaxcontact.scene.scene import Scene, contact_obstacles

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Points of the grid on which an obstacle is looked for, along the longer side of a picture.
OBSTACLE_GRID = 400
#: Room around the body, in units of its size.
MARGIN = 0.05
#: Direction of the light on a body in space.
LIGHT = np.array([0.4, -0.7, 0.6])


def plot_body(
    scene: Scene,
    displacement: ArrayLike | None = None,
    values: ArrayLike | None = None,
    *,
    label: str | None = None,
    scale: float = 1.0,
    limits: tuple[ArrayLike, ArrayLike] | None = None,
    colors: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the bodies of a scene and its obstacles.

    Args:
        scene: the scene, d = 2 or 3; obstacles are drawn in the plane only.
        displacement: moves the nodes, (N, d) [m]; default the reference configuration.
        values: colours the body: (N,) at the nodes or (E,) in the cells, or vectors at the nodes
            (N, d), of which the length counts; default one colour.
        label: name and unit of the values, beside a colour bar; default no colour bar.
        scale: factor of the displacement. An obstacle stays where it is.
        limits: lowest and highest corner of the picture, (d,) [m] each; default the body.
        colors: least and largest value of the colour scale; default those of the values.
        ax: axes to draw into, in space those of `projection="3d"`; default those of a new figure.

    Returns:
        The axes, with equal scales.

    Raises:
        ValueError: if the scene is one-dimensional, or a field does not fit the mesh.
        ImportError: if matplotlib is missing.
    """
    mesh = scene.mesh
    if mesh.dimension == 1:
        raise ValueError(
            "a picture of a body needs d = 2 or 3; plot the displacement of a bar against "
            "mesh.points[:, 0]"
        )
    x = places(mesh, displacement, scale)
    low, high = frame(x) if limits is None else (np.asarray(side) for side in limits)
    if mesh.dimension == 2:
        axes: Any = make_axes(ax)
        _draw_obstacles(scene, axes, low, high)
        patch = _draw_plane(mesh, x, values, colors, axes)
        label_plane(axes)
    else:
        axes = space_axes() if ax is None else ax
        patch = _draw_skin(mesh, x, values, colors, axes)
        axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", zlim=(low[2], high[2]))
        axes.set_box_aspect(high - low)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    if label is not None and patch is not None:
        axes.figure.colorbar(patch, ax=axes, label=label, shrink=0.75)
    return axes


def space_axes() -> Any:
    """Return the axes in space of a new figure."""
    figure = import_matplotlib("pyplot").figure(layout="constrained")
    return figure.add_subplot(projection="3d")


def places(mesh: Mesh, displacement: ArrayLike | None, scale: float) -> np.ndarray:
    """Return the positions of the moved nodes, (N, d)."""
    x = np.asarray(mesh.points)
    if displacement is None:
        return x
    displacement = np.asarray(displacement)
    if displacement.shape != x.shape:
        raise ValueError(
            f"displacement must have shape (N, d) = {x.shape}, got {displacement.shape}; choose "
            "one time, for instance trajectory.displacement[step]"
        )
    return x + scale * displacement


def scalars_of(mesh: Mesh, values: ArrayLike) -> np.ndarray:
    """Return what colours a body: (N,) or (E,)."""
    values = np.asarray(values)
    if values.shape == mesh.points.shape:
        return np.linalg.norm(values, axis=1)
    if values.shape in ((mesh.n_nodes,), (mesh.n_cells,)):
        return values
    raise ValueError(
        f"values have shape {values.shape}; pass ({mesh.n_nodes},) or {mesh.points.shape} at the "
        f"nodes or ({mesh.n_cells},) in the cells"
    )


def frame(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box around positions (N, d), with a margin."""
    low, high = x.min(axis=0), x.max(axis=0)
    margin = MARGIN * np.max(high - low)
    return low - margin, high + margin


def _draw_plane(
    mesh: Mesh, x: np.ndarray, values: ArrayLike | None, colors: tuple | None, ax: Axes
) -> Any:
    """Draw cells and boundary of a planar body; return what a colour bar is made of, or None."""
    triangles = import_matplotlib("tri").Triangulation(x[:, 0], x[:, 1], np.asarray(mesh.cells))
    low, high = colors or (None, None)
    patch = None
    if values is None:
        ax.tripcolor(triangles, np.zeros(mesh.n_nodes), cmap="Blues", vmin=-0.6, vmax=1.0)
    elif len(scalars := scalars_of(mesh, values)) == mesh.n_nodes:
        patch = ax.tripcolor(
            triangles, scalars, shading="gouraud", cmap="viridis", vmin=low, vmax=high
        )
    else:
        patch = ax.tripcolor(triangles, facecolors=scalars, cmap="viridis", vmin=low, vmax=high)
    ax.triplot(triangles, color="0.25", linewidth=0.25, alpha=0.4)
    edges = x[boundary_facets(np.asarray(mesh.cells))]
    lines = import_matplotlib("collections").LineCollection(edges, colors="0.25", linewidths=0.8)
    ax.add_collection(lines, autolim=False)
    return patch


def _draw_skin(
    mesh: Mesh, x: np.ndarray, values: ArrayLike | None, colors: tuple | None, ax: Any
) -> Any:
    """Draw the boundary of a body in space; return what a colour bar is made of, or None."""
    cells = np.asarray(mesh.cells)
    skin = boundary_facets(cells)
    corners = x[skin]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    shade = 0.65 + 0.35 * (normals @ LIGHT / np.linalg.norm(LIGHT))
    matplotlib, patch = import_matplotlib("cm"), None
    if values is None:
        tints = np.tile([0.55, 0.7, 0.85, 1.0], (len(skin), 1))
    else:
        scalars = scalars_of(mesh, values)
        if len(scalars) == mesh.n_nodes:
            scalars = scalars[skin].mean(axis=1)
        else:
            scalars = scalars[_owners(cells, skin)]
        low, high = colors or (float(scalars.min()), float(scalars.max()))
        norm = import_matplotlib("colors").Normalize(low, high)
        patch = matplotlib.ScalarMappable(norm, "viridis")
        tints = patch.to_rgba(scalars)
    tints[:, :3] *= shade[:, None]
    solid = importlib.import_module("mpl_toolkits.mplot3d.art3d").Poly3DCollection(
        corners,
        facecolors=np.clip(tints, 0.0, 1.0),
        edgecolors=(0.2, 0.2, 0.2, 0.3),
        linewidths=0.2,
    )
    ax.add_collection3d(solid)
    return patch


def _owners(cells: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """Return the cell of every boundary facet, (B,)."""
    d, n_nodes = skin.shape[1], int(cells.max()) + 1
    sides = np.stack([np.delete(cells, a, axis=1) for a in range(d + 1)], axis=1).reshape(-1, d)
    keys, wanted = facet_keys(sides, n_nodes), facet_keys(skin, n_nodes)
    order = np.argsort(keys)
    return order[np.searchsorted(keys[order], wanted)] // (d + 1)


def _draw_obstacles(scene: Scene, ax: Axes, low: np.ndarray, high: np.ndarray) -> None:
    """Fill where the signed distance of an obstacle is negative, with its contact set's name."""
    step = np.max(high - low) / OBSTACLE_GRID
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1)  # (V,H,d)
    for name, obstacle in contact_obstacles(scene):
        if isinstance(obstacle, Facets):
            continue
        phi = np.asarray(jax.vmap(jax.vmap(obstacle.signed_distance))(jnp.asarray(grid)))
        inside = np.argwhere(phi < 0.0)
        if not len(inside):
            continue
        ax.contourf(*axes, phi, levels=[phi.min() - 1.0, 0.0], colors="0.8")
        ax.contour(*axes, phi, levels=[0.0], colors="0.3", linewidths=1.2)
        # Where the most of the obstacle is seen.
        row, column = inside[np.argmin(np.sum((inside - inside.mean(axis=0)) ** 2, axis=1))]
        place = tuple(grid[row, column])
        ax.annotate(name, place, ha="center", va="center", fontsize=8, color="0.3")
