"""The figures of a solved control problem, after figures 5 to 9 of the paper.

Control at a time in contact (5), value of the functional (6) and distance to the reference control
(7) over the iterations, difference to the desired state over time (8), contact force over the
horizontal position (9); besides the energy ledger and the active set over time.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.control.scenes import ControlProblem
from jaxcontact.motion.chatter import ChatterWarning
from jaxcontact.motion.energy import Energy
from jaxcontact.motion.stress import stress
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.optimize import Result
from jaxcontact.output import plot
from jaxcontact.output.axes import import_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: Value of a certified minimiser of the default problem; see `Homotopy`.
BEST_VALUE = 0.009900802324


def best_known_value(problem: ControlProblem) -> float | None:
    """Return the best value that is known of the problem of `half_disc_control()`; None of others.

    Its mesh size, steps, gap and weights tell it.
    """
    told = (problem.system.n_nodes, problem.steps, problem.dt, problem.control_scale)
    weights = (problem.control_weight, problem.final_weight)
    is_default = told == (247, 150, 5e-5, 1e6) and weights == (1e-2, 7.5e-4)
    return BEST_VALUE if is_default and abs(np.min(problem.system.gap) - 0.8) < 1e-9 else None


def draw_figures(
    problem: ControlProblem,
    result: Result,
    distance: ArrayLike,
    trajectory: Trajectory,
    ledger: Energy,
) -> dict[str, Figure]:
    """Draw all figures of a solved problem; no window opens and no display is needed.

    Args:
        problem: the control problem.
        result: its solution.
        distance: relative L2 distance of every iterate to the reference control, (iterations+1,).
        trajectory: the motion under the resulting control.
        ledger: its energies and flows.

    Returns:
        The figures by name: control, functional, distance, state-error, contact-force, energy,
        active-set, stress. The time of the first, the fifth and the last is the first one with most
        closed pairs.

    Raises:
        ImportError: if matplotlib is missing.
    """
    Figure = import_matplotlib("figure").Figure
    system, mesh = problem.system, problem.scene.mesh
    step = 1 + int(np.argmax(np.count_nonzero(np.asarray(trajectory.active), axis=1)))
    moment = f"t = {step * problem.dt * 1e3:.4g} ms"
    tensor = stress(problem.scene, trajectory.displacement[step], trajectory.velocity[step])
    free = problem.simulate(jnp.zeros_like(problem.reference))

    def draw_control(ax: Axes) -> None:
        scale = f"10$^{{{math.log10(problem.control_scale):g}}}$ N/m²"
        plot.plot_control(
            mesh,
            result.control[step - 1],
            trajectory.displacement[step],
            label=f"control [{scale}]",
            ax=ax,
        )
        plane = float(np.min(mesh.points[:, 1])) - float(np.min(system.gap))
        ax.axhline(plane, color="0.3", linewidth=1.5)
        ax.set_title(moment)

    def draw_force(ax: Axes) -> None:
        plot.plot_contact_force(system, trajectory, step, ax=ax)
        ax.set_title(moment)

    def draw_stress(ax: Axes) -> None:
        plot.plot_body(
            problem.scene,
            trajectory.displacement[step],
            tensor.von_mises / 1e6,
            label="von Mises stress [MN/m]",
            ax=ax,
        )
        ax.set_title(moment)

    def draw_error(ax: Axes) -> None:
        for motion, label in ((free, "without control"), (trajectory, "with the control found")):
            plot.plot_state_error(system, motion, problem.target, label=label, ax=ax)
        ax.legend(frameon=False)

    pictures: dict[str, Callable[[Axes], object]] = {
        "control": draw_control,
        "functional": lambda ax: plot.plot_history(
            result.history.value, best=best_known_value(problem), ax=ax
        ),
        "distance": lambda ax: plot.plot_distance(distance, ax=ax),
        "state-error": draw_error,
        "contact-force": draw_force,
        "energy": lambda ax: plot.plot_energy(trajectory, ledger, ax=ax),
        "active-set": lambda ax: plot.plot_active_set(system, trajectory, ax=ax),
        "stress": draw_stress,
    }
    figures = {}
    with warnings.catch_warnings():
        # The page of the pictures says it.
        warnings.simplefilter("ignore", ChatterWarning)
        for name, draw in pictures.items():
            figures[name] = Figure(figsize=(6.4, 4.2), layout="constrained")
            draw(figures[name].subplots())
    return figures
