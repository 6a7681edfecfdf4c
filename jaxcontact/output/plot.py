"""Pictures of meshes, controls, contact and energy with matplotlib (`jaxcontact[plot]`).

Every function draws into the axes that it is given, or into a new figure, and returns the axes.
Data stay in SI units; only tick labels carry a prefix such as milli or mega, so curves of several
calls can share one axes. Without matplotlib they raise ImportError and say how to install it.
Bodies in space are for ParaView: see `jaxcontact.output.export`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.control.inner_product import nodal_norms
from jaxcontact.motion.energy import Energy
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.output.animation import animate
from jaxcontact.output.axes import add_grid, import_matplotlib, label_plane, make_axes, scale_axis
from jaxcontact.output.body import plot_body
from jaxcontact.scene.mesh import Mesh
from jaxcontact.system.system import System

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "animate",
    "plot_active_set",
    "plot_body",
    "plot_contact_force",
    "plot_control",
    "plot_distance",
    "plot_energy",
    "plot_history",
    "plot_mesh",
    "plot_state_error",
]


def plot_mesh(mesh: Mesh, displacement: ArrayLike | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the cells of a planar mesh, and its facet sets in colours with a legend.

    Args:
        mesh: the mesh, d = 2.
        displacement: moves the nodes, (N, d) [m]; default the reference configuration.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes, with equal scales.

    Raises:
        ValueError: if the mesh is not planar.
    """
    x = _positions(mesh, displacement)
    ax = make_axes(ax)
    ax.triplot(x[:, 0], x[:, 1], np.asarray(mesh.cells), color="0.65", linewidth=0.6)
    for name, facets in mesh.facets.items():
        # A row of NaN lifts the pen between facets: one line, one entry of the legend per set.
        ends = np.insert(x[facets], 2, np.nan, axis=1).reshape(-1, 2)
        ax.plot(ends[:, 0], ends[:, 1], linewidth=2.5, label=name)
    if mesh.facets:
        ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    return label_plane(ax)


def plot_control(
    mesh: Mesh,
    control: ArrayLike,
    displacement: ArrayLike | None = None,
    *,
    label: str = "magnitude of the control |u|",
    ax: Axes | None = None,
) -> Axes:
    """Draw the magnitude of a control at one time on a planar mesh.

    Args:
        mesh: the mesh, d = 2.
        control: nodal vectors, (N, d).
        displacement: moves the nodes, (N, d) [m]; default the reference configuration.
        label: name and unit beside the colour bar.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes, with equal scales and a colour bar.

    Raises:
        ValueError: if the mesh is not planar or the control is not one vector per node.
    """
    x = _positions(mesh, displacement)
    control = np.asarray(control)
    if control.shape != x.shape:
        raise ValueError(
            f"control must have shape (N, d) = {x.shape}, got {control.shape}; choose one time, "
            "for instance control[step]"
        )
    ax = make_axes(ax)
    magnitude = np.linalg.norm(control, axis=1)
    triangles = import_matplotlib("tri").Triangulation(x[:, 0], x[:, 1], np.asarray(mesh.cells))
    image = ax.tripcolor(triangles, magnitude, shading="gouraud", cmap="viridis", vmin=0.0)
    ax.triplot(triangles, color="white", linewidth=0.3, alpha=0.35)
    ax.figure.colorbar(image, ax=ax, label=label, shrink=0.75)
    return label_plane(ax)


def plot_history(value: ArrayLike, *, label: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the values of an objective over the iterations, minus the least one, on a log scale.

    Args:
        value: objective at every iterate, (iterations+1,).
        label: name in the legend.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes; the iterate with the least value has no point.
    """
    value = np.asarray(value)
    excess = value - np.min(value)
    ax = make_axes(ax)
    ax.semilogy(np.where(excess > 0.0, excess, np.nan), label=label)
    ax.set_xlabel("iteration")
    ax.set_ylabel("value of the functional minus least value")
    return add_grid(ax)


def plot_distance(distance: ArrayLike, *, label: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the relative L2 distance of the iterates to a reference control.

    Args:
        distance: |u_k - u_ref| / |u_ref| at every iterate, (iterations+1,).
        label: name in the legend.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes.
    """
    ax = make_axes(ax)
    ax.plot(np.asarray(distance), label=label)
    ax.set_xlabel("iteration")
    ax.set_ylabel("relative L² distance to the reference control")
    return add_grid(ax)


def plot_state_error(
    system: System,
    trajectory: Trajectory,
    target: ArrayLike,
    *,
    label: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the L2 norm of the difference to a desired state over time.

    Args:
        system: the system whose nodal mass defines the norm.
        trajectory: the motion, T steps.
        target: desired displacement, (T+1, N, d) [m].
        label: name in the legend.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes.
    """
    difference = trajectory.displacement - jnp.asarray(target)
    error = np.sqrt(nodal_norms(system.nodal_mass, difference))
    ax = make_axes(ax)
    ax.plot(np.asarray(trajectory.time), error, label=label)
    scale_axis(ax.xaxis, "time", "s", trajectory.time)
    ax.set_ylabel(f"L² difference to the desired state [m$^{{{1 + system.dimension / 2:g}}}$]")
    return add_grid(ax)


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
    _check_planar(system.dimension)
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
    if system.dimension == 2:
        position, order = _contact_positions(system)
    else:
        position = order = np.arange(len(system.contact_nodes))
    force = np.ma.masked_array(trajectory.contact_force, ~np.asarray(trajectory.active))
    time = np.asarray(trajectory.dt) * np.arange(len(force) + 1)
    ax = make_axes(ax)
    image = ax.pcolormesh(time, _cell_edges(position), force[:, order].T, cmap="plasma_r")
    bar = ax.figure.colorbar(image, ax=ax)
    scale_axis(bar.ax.yaxis, "contact force on a node", "N", force.filled(0.0))
    scale_axis(ax.xaxis, "time", "s", trajectory.time)
    ax.set_ylabel("horizontal position [m]" if system.dimension == 2 else "contact node")
    return ax


def plot_energy(trajectory: Trajectory, ledger: Energy, *, ax: Axes | None = None) -> Axes:
    """Draw the energy ledger over time: the energies, and what went in and out until then.

    Args:
        trajectory: the motion, T steps.
        ledger: its energies and flows, from `energy`.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes; total = work - viscous loss - impact loss + the total at the start.
    """
    ax = make_axes(ax)
    time = np.asarray(trajectory.time)
    for name, energies in (("kinetic", ledger.kinetic), ("elastic", ledger.elastic)):
        ax.plot(time, np.asarray(energies), label=name)
    ax.plot(time, np.asarray(ledger.total), color="black", label="total")
    highest = 0.0
    for name, flow in (
        ("work until then", ledger.work),
        ("viscous loss until then", ledger.viscous_loss),
        ("impact loss until then", ledger.impact_loss),
    ):
        amount = np.concatenate([[0.0], np.cumsum(flow)])
        highest = max(highest, np.max(np.abs(amount)))
        ax.plot(time, amount, linestyle="--", label=name)
    scale_axis(ax.xaxis, "time", "s", time)
    scale_axis(ax.yaxis, "energy", "J", max(highest, np.max(np.abs(ledger.total))))
    ax.legend(frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return add_grid(ax)


def _check_planar(dimension: int) -> None:
    if dimension != 2:
        raise ValueError(
            f"this picture is for d = 2, got d = {dimension}; write the motion with "
            "jaxcontact.output.export.write_time_series and open it in ParaView"
        )


def _positions(mesh: Mesh, displacement: ArrayLike | None) -> np.ndarray:
    _check_planar(mesh.dimension)
    x = np.asarray(mesh.points)
    return x if displacement is None else x + np.asarray(displacement)


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
