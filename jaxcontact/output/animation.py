"""Animations of motions, written as GIF or MP4; `jc.plot` has `animate` too."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.output.axes import import_matplotlib, moment_of
from jaxcontact.output.body import frame, places, plot_body, scalars_of
from jaxcontact.scene.scene import Scene

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation

#: Writers of animations by the ending of the file.
WRITERS = {".gif": "pillow", ".mp4": "ffmpeg"}


def animate(
    scene: Scene,
    trajectory: Trajectory,
    path: str | Path | None = None,
    *,
    values: Callable[[int], ArrayLike] | ArrayLike | None = None,
    label: str | None = None,
    scale: float = 1.0,
    frames: int = 60,
    seconds: float = 4.0,
) -> FuncAnimation:
    """Animate a motion, and write it to a file.

    Args:
        scene: the scene, d = 2 or 3.
        trajectory: the motion of this scene.
        path: `.gif`, or `.mp4` where ffmpeg is installed; default no file: in a notebook show
            `IPython.display.HTML(animation.to_jshtml())`.
        values: colours the body: of every recorded state (T+1, N), (T+1, E) or (T+1, N, d), or a
            function of the number of a state; default one colour.
        label: name and unit of the values, beside a colour bar.
        scale: factor of the displacement.
        frames: number of pictures, equally spaced over the motion, at most one per state.
        seconds: how long the animation lasts.

    Returns:
        The animation of matplotlib.

    Raises:
        ValueError: as `plot_body`, or if the ending of the path is none of the above.
        ImportError: if matplotlib, or ffmpeg for `.mp4`, is missing.
    """
    if frames < 1 or not seconds > 0.0:
        raise ValueError(f"frames={frames} and seconds={seconds} must be positive")
    writer = None if path is None else _writer(Path(path))
    motion = np.asarray(trajectory.displacement)
    states = np.unique(np.linspace(0, len(motion) - 1, frames).round().astype(int))
    if values is not None and not callable(values):
        values = np.asarray(values).__getitem__
    fields = None if values is None else [np.asarray(values(int(k))) for k in states]
    moved = [places(scene.mesh, motion[k], scale) for k in states]
    corners = [frame(x) for x in moved]
    limits = np.min([low for low, _ in corners], 0), np.max([high for _, high in corners], 0)
    colors = None
    if fields is not None:
        sizes = [scalars_of(scene.mesh, field) for field in fields]
        colors = float(np.min(sizes)), float(np.max(sizes))
    pyplot = import_matplotlib("pyplot")
    projection = "3d" if scene.mesh.dimension == 3 else None
    figure = pyplot.figure(figsize=(5.0, 4.0), dpi=80, layout="constrained")
    axes = figure.add_subplot(projection=projection)
    time = np.asarray(trajectory.time)

    def draw(number: int) -> tuple:
        axes.clear()
        field = None if fields is None else fields[number]
        plot_body(
            scene, motion[states[number]], field, scale=scale, limits=limits, colors=colors,
            label=label if len(figure.axes) == 1 else None, ax=axes,
        )  # fmt: skip
        axes.set_title(moment_of(float(time[states[number]]), time))
        return ()

    animation = import_matplotlib("animation").FuncAnimation(
        figure, draw, frames=len(states), interval=1000.0 * seconds / len(states)
    )
    pyplot.close(figure)  # so that a notebook does not show it a second time
    if path is not None:
        animation.save(path, writer=writer, fps=len(states) / seconds)
    return animation


def _writer(path: Path) -> str:
    """Return the writer for a file, checked before anything is drawn."""
    name = WRITERS.get(path.suffix.lower())
    if name is None:
        raise ValueError(f"an animation is written to {' or '.join(WRITERS)}, got {path.name!r}")
    if not import_matplotlib("animation").writers.is_available(name):
        raise ImportError(f"{path.suffix} needs {name}, which is not installed; write a .gif")
    return name
