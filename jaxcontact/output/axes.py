"""What the axes of all pictures share: a new figure, units with prefixes, a grid."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}


def import_matplotlib(module: str) -> Any:
    """Return a module of matplotlib.

    Raises:
        ImportError: if matplotlib is missing; the message says how to install it.
    """
    try:
        return importlib.import_module(f"matplotlib.{module}")
    except ImportError as error:
        raise ImportError(
            "pictures need matplotlib; install it with: pip install 'jaxcontact[plot]'"
        ) from error


def make_axes(ax: Axes | None) -> Axes:
    """Return the axes, or those of a new figure if there are none.

    Raises:
        ImportError: if matplotlib is missing.
    """
    if ax is not None:
        return ax
    return import_matplotlib("pyplot").subplots(layout="constrained")[1]


def _prefix(values: ArrayLike) -> tuple[float, str]:
    """Return the factor and the prefix that fit values in SI units."""
    largest = float(np.max(np.abs(np.asarray(values)), initial=0.0))
    exponent = 0 if largest == 0.0 else 3 * int(np.floor(np.log10(largest) / 3))
    exponent = min(max(exponent, min(_PREFIXES)), max(_PREFIXES))
    return 10.0**exponent, _PREFIXES[exponent]


def moment_of(time: float, times: ArrayLike) -> str:
    """Return a time [s] in words, with the prefix that an axis of all times has."""
    factor, prefix = _prefix(times)
    return f"t = {time / factor:.4g} {prefix}s"


def scale_axis(axis: Any, quantity: str, unit: str, values: ArrayLike) -> None:
    """Name an axis whose data are in SI units and put the fitting prefix on its ticks."""
    factor, prefix = _prefix(values)
    axis.set_major_formatter(lambda x, _: f"{x / factor:.6g}")
    axis.set_label_text(f"{quantity} [{prefix}{unit}]")


def scale_bar(ax: Axes, image: Any, quantity: str, unit: str, values: ArrayLike) -> None:
    """Put a colour bar beside a picture, with a prefix as `scale_axis` chooses it."""
    bar = ax.figure.colorbar(image, ax=ax)
    scale_axis(bar.ax.yaxis, quantity, unit, values)


def label_plane(ax: Axes) -> Axes:
    """Give the axes of a picture of the body equal scales and their names."""
    ax.set_aspect("equal")
    ax.set_xlabel("horizontal position [m]")
    ax.set_ylabel("vertical position [m]")
    return ax


def check_planar(dimension: int) -> None:
    """Raise a ValueError if a picture in the plane is asked for something else."""
    if dimension != 2:
        raise ValueError(
            f"this picture is for d = 2, got d = {dimension}; write the motion with "
            "jaxcontact.output.export.write_time_series and open it in ParaView"
        )


def add_grid(ax: Axes) -> Axes:
    """Put a light grid behind the curves."""
    ax.grid(color="0.9")
    ax.set_axisbelow(True)
    return ax
