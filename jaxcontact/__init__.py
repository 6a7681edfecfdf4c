"""Dynamic contact of viscoelastic bodies in JAX, with exact gradients through the impact.

Shape comments use one letter per axis: N nodes, E or e cells, a b local nodes of a cell, d the
space dimension, i j components, n unknowns, C contact pairs, T time steps. In a `Source:` the paper
is Müller and Schiela (2017) and MATH.md lies in the folder notebooks/ of the repository.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxcontact.api import *  # noqa: F403
    from jaxcontact.output import export as export
    from jaxcontact.output import plot as plot

__version__ = "0.1.0"

#: Loaded when they are asked for: a simulation needs no pictures and no files.
_LAZY = {"plot": "jaxcontact.output.plot", "export": "jaxcontact.output.export"}


def __getattr__(name: str) -> Any:
    """Load the public names with the first of them, `plot` and `export` each with its own.

    So the command line shows its help without JAX.
    """
    if name in _LAZY:
        return importlib.import_module(_LAZY[name])
    if name == "__all__":
        return [*importlib.import_module("jaxcontact.api").__all__, *_LAZY]
    if not name.startswith("__"):
        api = importlib.import_module("jaxcontact.api")
        globals().update({public: getattr(api, public) for public in api.__all__})
        if name in globals():
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*__getattr__("__all__"), "__version__"])
