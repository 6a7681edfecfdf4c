"""The mesh that Gmsh holds at the moment."""

from __future__ import annotations

import tempfile
from pathlib import Path

from jaxcontact.scene.io import mesh_of, read_source
from jaxcontact.scene.mesh import Mesh

#: How the model is handed over, whatever the user has set: format 4.1 keeps the dimension of the
#: model, binary every digit, and cells in groups only if there are groups.
_OPTIONS = {
    "Mesh.MshFileVersion": 4.1,
    "Mesh.Binary": 1,
    "Mesh.SaveParametric": 0,
    "Mesh.SaveAll": 0,
}


def current_model(dimension: int | None) -> Mesh:
    """Return the mesh of the current model of Gmsh; see `Mesh.from_gmsh`."""
    try:
        import gmsh
    except ImportError as error:
        raise ImportError("this needs the package gmsh: pip install gmsh") from error
    if not gmsh.isInitialized():
        raise ValueError("Gmsh holds no model; call this between gmsh.initialize and gmsh.finalize")
    if not len(gmsh.model.mesh.getNodes()[0]):
        raise ValueError(
            "the current model of Gmsh has no mesh; call gmsh.model.mesh.generate(dimension) first"
        )
    before = {name: gmsh.option.getNumber(name) for name in _OPTIONS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.msh"
        try:
            for name, value in _OPTIONS.items():
                gmsh.option.setNumber(name, value)
            gmsh.write(str(path))
        finally:
            for name, value in before.items():
                gmsh.option.setNumber(name, value)
        source, model_dimension = read_source(path)
    return mesh_of(source, Path("the model of Gmsh"), dimension, model_dimension)
