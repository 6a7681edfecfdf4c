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


def scale_axis(axis: Any, quantity: str, unit: str, values: ArrayLike) -> None:
    """Name an axis whose data are in SI units and put the fitting prefix on its ticks."""
    largest = float(np.max(np.abs(np.asarray(values)), initial=0.0))
    exponent = 0 if largest == 0.0 else 3 * int(np.floor(np.log10(largest) / 3))
    exponent = min(max(exponent, min(_PREFIXES)), max(_PREFIXES))
    factor = 10.0**exponent
    axis.set_major_formatter(lambda x, _: f"{x / factor:.6g}")
    axis.set_label_text(f"{quantity} [{_PREFIXES[exponent]}{unit}]")


def label_plane(ax: Axes) -> Axes:
    """Give the axes of a picture of the body equal scales and their names."""
    ax.set_aspect("equal")
    ax.set_xlabel("horizontal position [m]")
    ax.set_ylabel("vertical position [m]")
    return ax


def add_grid(ax: Axes) -> Axes:
    """Put a light grid behind the curves."""
    ax.grid(color="0.9")
    ax.set_axisbelow(True)
    return ax
