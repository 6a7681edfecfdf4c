"""`jaxcontact info`: what is in a mesh file, and how fast a wave passes its smallest cell."""

from __future__ import annotations

import argparse
import math

import numpy as np

import jaxcontact as jc
from jaxcontact.scene.cells import cell_volumes
from jaxcontact.system.courant import courant_number


def run(options: argparse.Namespace) -> int:
    """Print what a mesh file holds.

    Raises:
        ValueError: if the file holds no mesh, or only one of --young and --dt is given.
        OSError: if the file cannot be read.
    """
    if (options.young is None) != (options.dt is None):
        raise ValueError("the Courant number needs both --young and --dt")
    mesh = jc.read_mesh(options.mesh, dimension=options.dimension)
    x, d = np.asarray(mesh.points), mesh.dimension
    unit = {1: "m", 2: "m^2", 3: "m^3"}[d]
    low, high = x.min(axis=0).tolist(), x.max(axis=0).tolist()
    print(f"{options.mesh}: dimension {d}, {mesh.n_nodes} nodes, {mesh.n_cells} cells")
    print(f"  from {_rounded(low)} to {_rounded(high)} m")
    print(f"  volume {cell_volumes(x, mesh.cells).sum():.6g} {unit}")
    print(f"  bodies {mesh.components().max() + 1}")
    for name, facets in mesh.facets.items():
        print(f"  facet set {name!r}: {len(facets)} facets, {np.unique(facets).size} nodes")
    for name, cells in mesh.regions.items():
        print(f"  region {name!r}: {len(cells)} cells")
    print("  " + str(mesh.quality()).replace("\n", "\n  "))
    if options.young is not None:
        material = jc.KelvinVoigt(
            young=options.young, poisson=options.poisson, density=options.density
        )
        number = float(courant_number(jc.discretize(jc.Scene(mesh, material)), options.dt))
        print(
            f"  Courant number c dt / h {number:.3g}; 1 at dt = {options.dt / number:.3g} s"
            + ("" if math.isfinite(number) else ", is the mesh flat?")
        )
    return 0


def _rounded(values: list[float]) -> list[float]:
    return [float(f"{value:.6g}") for value in values]
