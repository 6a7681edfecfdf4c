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
from jaxcontact.output.axes import (
    add_grid,
    check_planar,
    import_matplotlib,
    label_plane,
    make_axes,
    scale_axis,
)
from jaxcontact.output.body import plot_body
from jaxcontact.output.contact_plots import (
    plot_active_set,
    plot_contact_force,
    plot_force,
    plot_gap,
    plot_pressure,
)
from jaxcontact.output.space import space_body
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
    "plot_force",
    "plot_gap",
    "plot_history",
    "plot_mesh",
    "plot_pressure",
    "plot_state_error",
    "space_body",
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


def plot_history(
    value: ArrayLike,
    *,
    best: float | None = None,
    label: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the values of an objective over the iterations, minus the best one, on a log scale.

    Args:
        value: objective at every iterate, (iterations+1,).
        best: best known value; default the least of these.
        label: name in the legend.
        ax: axes to draw into; default those of a new figure.

    Returns:
        The axes; an iterate with the best value, or a better one, has no point.
    """
    value = np.asarray(value)
    excess = value - (np.min(value) if best is None else best)
    ax = make_axes(ax)
    ax.semilogy(np.where(excess > 0.0, excess, np.nan), label=label)
    ax.set_xlabel("iteration")
    ax.set_ylabel(f"functional minus {'its least' if best is None else 'the best known'} value")
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


def _positions(mesh: Mesh, displacement: ArrayLike | None) -> np.ndarray:
    check_planar(mesh.dimension)
    x = np.asarray(mesh.points)
    return x if displacement is None else x + np.asarray(displacement)
