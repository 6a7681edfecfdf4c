"""Systems in files."""

from __future__ import annotations

from pathlib import Path

from jaxcontact.scene.material import KelvinVoigt
from jaxcontact.system.basis import Basis
from jaxcontact.system.pair_set import PairSet
from jaxcontact.system.parts import ClampedSet, Parts
from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix
from jaxcontact.system.system import System
from jaxcontact.transforms.saved import load_dataclass


def load_system(path: str | Path) -> System:
    """Read a full or reduced system that `System.save` wrote.

    Raises:
        OSError: if there is no such file, it is a folder, or it may not be read.
        ValueError: if the file is damaged or holds something else.
        RuntimeError: if the system is in float64 while JAX has it switched off.
    """
    matrices = (ComponentwiseMatrix, ContactNormals, SymmetricMatrix)
    return load_dataclass(path, (System, Basis, PairSet, Parts, ClampedSet, KelvinVoigt, *matrices))
