"""Pictures of contact: forces, pressures and gaps in time and over the contact surface.

In the plane the place of a contact node is its arc length along the contact sets, in space its
position in the plane that they lie nearest to. `jc.plot` has these functions too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxcontact.motion.chatter import warn_of_chatter
from jaxcontact.motion.pressure import contact_pressure
from jaxcontact.motion.stepper import Stepper
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.output.axes import (
    add_grid,
    check_planar,
    import_matplotlib,
    make_axes,
    moment_of,
    scale_axis,
    scale_bar,
)
from jaxcontact.system.system import System

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: What a force is, by dimension: a planar body is one metre thick.
FORCES = {1: "contact force", 2: "contact force per metre of thickness", 3: "contact force"}
PRESSURE_UNITS = {1: "N", 2: "N/m", 3: "Pa"}


def plot_force(trajectory: Trajectory, *, label: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the total contact force of every step over time.

    Args:
        trajectory: the motion, T steps.
        label: name in the legend.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes.
    """
    warn_of_chatter(trajectory)
    total = np.asarray(trajectory.contact_force).sum(axis=1)
    time = np.asarray(trajectory.dt) * (np.arange(len(total)) + 0.5)
    ax = make_axes(ax)
    ax.plot(time, total, label=label)
    scale_axis(ax.xaxis, "time", "s", trajectory.time)
    scale_axis(ax.yaxis, f"total {FORCES[_dimension(trajectory)]}", "N", total)
    return add_grid(ax)


def plot_pressure(
    stepper: Stepper, trajectory: Trajectory, *, step: int | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the contact pressure, see `contact_pressure`.

    Args:
        stepper: the stepper that made the trajectory.
        trajectory: the motion, T steps.
        step: 1, ..., T; draws the pressure of this step over the contact surface. Default in one
            and two dimensions all steps, in space the one of the largest total force.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes: curves over time in 1D, an image over time and arc length in 2D, a map in 3D.

    Raises:
        ValueError: if there is no such step.
    """
    pressure = np.asarray(contact_pressure(stepper, trajectory))
    unit = PRESSURE_UNITS[stepper.system.dimension]
    return _draw(stepper.system, trajectory, pressure, step, "contact pressure", unit, ax)


def plot_gap(
    system: System, trajectory: Trajectory, *, step: int | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the gap at the end of every step, as `plot_pressure` draws the pressure.

    Raises:
        ValueError: if there is no such step, or the trajectory does not hold every state.
    """
    gap = np.asarray(trajectory.gap)[1:]
    if len(gap) != len(trajectory.contact_impulse):
        raise ValueError("plot_gap needs the gap of every step; simulate with save_every=1")
    return _draw(system, trajectory, gap, step, "gap", "m", ax)


def plot_contact_force(
    system: System,
    trajectory: Trajectory,
    step: int,
    *,
    label: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the contact force on each node in one step over its horizontal position.

    Args:
        system: the system of the motion, d = 2.
        trajectory: the motion, T steps.
        step: step 1, ..., T; the force is the impulse of the step over its length.
        label: name in the legend.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes, positions in the reference configuration.

    Raises:
        ValueError: if the system is not planar or there is no such step.
    """
    check_planar(system.dimension)
    warn_of_chatter(trajectory)
    steps = len(trajectory.contact_impulse)
    if not 1 <= step <= steps:
        raise ValueError(f"step must be one of 1, ..., {steps}, got {step}")
    position, order = _contact_positions(system)
    force = np.asarray(trajectory.contact_force)
    ax = make_axes(ax)
    ax.plot(position, force[step - 1, order], marker="o", markersize=4, label=label)
    scale_axis(ax.xaxis, "horizontal position", "m", 1.0)
    scale_axis(ax.yaxis, "contact force", "N", force)
    return add_grid(ax)


def plot_active_set(system: System, trajectory: Trajectory, *, ax: Axes | None = None) -> Axes:
    """Draw when and where the gap is closed, coloured by the contact force on each node.

    Args:
        system: the system of the motion; in 2D the nodes stand at their horizontal position,
            otherwise in the order of `system.contact_nodes`.
        trajectory: the motion, T steps.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes, with time to the right, white where the gap is open, and a colour bar.
    """
    warn_of_chatter(trajectory)
    if system.dimension == 2:
        position, order = _contact_positions(system)
    else:
        position = order = np.arange(len(system.contact_nodes))
    force = np.ma.masked_array(trajectory.contact_force, ~np.asarray(trajectory.active))
    time = np.asarray(trajectory.dt) * np.arange(len(force) + 1)
    ax = make_axes(ax)
    image = ax.pcolormesh(time, _cell_edges(position), force[:, order].T, cmap="plasma_r")
    scale_bar(ax, image, "contact force on a node", "N", force.filled(0.0))
    scale_axis(ax.xaxis, "time", "s", trajectory.time)
    ax.set_ylabel("horizontal position [m]" if system.dimension == 2 else "contact node")
    return ax


class _Surface(NamedTuple):
    """The nodes of the contact pairs, and how they lie beside each other."""

    nodes: np.ndarray
    """The K different contact nodes, in the plane in order along the boundary, (K,)."""

    number: np.ndarray
    """Which of them each contact pair belongs to, (C,)."""

    facets: np.ndarray
    """Facets of the mesh between contact nodes, as numbers of these, (F, d)."""


def _draw(
    system: System,
    trajectory: Trajectory,
    values: np.ndarray,
    step: int | None,
    quantity: str,
    unit: str,
    ax: Axes | None,
) -> Axes:
    """Draw values (T, C) of the contact pairs; of two pairs at a node the larger value."""
    steps = len(values)
    if step is not None and not 1 <= step <= steps:
        raise ValueError(f"step must be one of 1, ..., {steps}, got {step}")
    surface = _surface(system)
    at_nodes = np.full((steps, len(surface.nodes)), -np.inf)
    np.maximum.at(at_nodes.T, surface.number, values.T)
    if system.dimension == 3:
        if step is None:
            step = 1 + int(np.argmax(np.asarray(trajectory.contact_force).sum(axis=1)))
        return _draw_face(system, trajectory, surface, at_nodes[step - 1], step, quantity, unit, ax)
    ax = make_axes(ax)
    time = np.asarray(trajectory.dt) * np.arange(steps + 1)
    arc = _arc_length(system, surface)
    if step is not None:
        ax.plot(arc, at_nodes[step - 1], marker="o", markersize=3)
        ax.set_title(moment_of(step * float(trajectory.dt), trajectory.time))
        scale_axis(ax.xaxis, "arc length along the contact set", "m", arc)
        scale_axis(ax.yaxis, quantity, unit, at_nodes[step - 1])
        return add_grid(ax)
    scale_axis(ax.xaxis, "time", "s", time)
    if system.dimension == 1:
        for column in at_nodes.T:
            ax.plot(0.5 * (time[1:] + time[:-1]), column)
        scale_axis(ax.yaxis, quantity, unit, at_nodes)
        return add_grid(ax)
    image = ax.pcolormesh(time, _cell_edges(arc), at_nodes.T, cmap="viridis")
    scale_bar(ax, image, quantity, unit, at_nodes)
    scale_axis(ax.yaxis, "arc length along the contact set", "m", arc)
    return ax


def _draw_face(
    system: System,
    trajectory: Trajectory,
    surface: _Surface,
    values: np.ndarray,
    step: int,
    quantity: str,
    unit: str,
    ax: Axes | None,
) -> Axes:
    """Draw values (K,) on the contact nodes in the plane that they lie nearest to."""
    points = np.asarray(system.points)[surface.nodes]
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    # Along the coordinate axes, as far as the face is: the picture is easier to read then.
    first = np.eye(3)[np.argmin(np.abs(axes[2]))]
    first = first - axes[2] * (axes[2] @ first)
    first /= np.linalg.norm(first)
    second = np.cross(axes[2] * np.sign(axes[2] @ np.ones(3)), first)
    x, y = points @ first, points @ second
    ax = make_axes(ax)
    triangles = import_matplotlib("tri").Triangulation(x, y, surface.facets)
    image = ax.tripcolor(triangles, values, shading="gouraud", cmap="viridis")
    ax.triplot(triangles, color="white", linewidth=0.3, alpha=0.5)
    scale_bar(ax, image, quantity, unit, values)
    ax.set_aspect("equal")
    ax.set_title(moment_of(step * float(trajectory.dt), trajectory.time))
    scale_axis(ax.xaxis, "position on the face", "m", x)
    scale_axis(ax.yaxis, "across", "m", y)
    return ax


def _surface(system: System) -> _Surface:
    """Return the contact nodes with the facets between them."""
    nodes, number = np.unique(system.contact_nodes, return_inverse=True)
    sets = [np.asarray(facets) for facets in system.parts.facets.values()]
    facets = np.unique(np.concatenate(sets), axis=0) if sets else np.zeros((0, 1), int)
    place = np.full(system.n_nodes, -1)
    place[nodes] = np.arange(len(nodes))
    between = place[facets]
    between = between[np.all(between >= 0, axis=1)]
    if system.dimension != 2:
        return _Surface(nodes, number, between)
    order = _along_boundary(between, len(nodes))
    position = np.argsort(order)
    return _Surface(nodes[order], position[number], position[between])


def _along_boundary(edges: np.ndarray, n: int) -> np.ndarray:
    """Return the nodes of chains of edges (F, 2), each chain from its start on, (n,)."""
    after = dict(edges.tolist())
    starts = [node for node in range(n) if node not in set(after.values())]
    order: dict[int, None] = {}
    for start in (*starts, *range(n)):  # the second part for closed curves
        node: int | None = start
        while node is not None and node not in order:
            order[node] = None
            node = after.get(node)
    return np.array(list(order))


def _arc_length(system: System, surface: _Surface) -> np.ndarray:
    """Return the arc length at the contact nodes, (K,) [m]; straight from chain to chain."""
    points = np.asarray(system.points)[surface.nodes]
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _dimension(trajectory: Trajectory) -> int:
    return trajectory.final.displacement.shape[-1]  # type: ignore[union-attr]


def _contact_positions(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Return the sorted horizontal positions of the contact pairs and their order, (C,) each."""
    horizontal = np.asarray(system.points)[system.contact_nodes, 0]
    order = np.argsort(horizontal)
    return horizontal[order], order


def _cell_edges(position: np.ndarray) -> np.ndarray:
    """Return the C+1 ends of cells around C sorted positions."""
    if len(position) == 1:
        return position[0] + np.array([-0.5, 0.5])
    middle = 0.5 * (position[1:] + position[:-1])
    first, last = 2 * position[0] - middle[0], 2 * position[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])
