"""Damaged files: every reader must end with a result or with an error that it documents."""

import signal
import warnings
from collections import Counter
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO

import meshio
import numpy as np

import jaxcontact as jc
from jaxcontact.optimize.result import load_result

#: How a reader may end, beside a result.
DOCUMENTED = (ValueError, OSError)
#: A reader of a few hundred bytes that takes longer does not end.
SECONDS = 20.0


class Endless(BaseException):
    """A reader did not end"""


_POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
_CELLS = [("line", np.array([[0, 1], [1, 2]])), ("triangle", np.array([[0, 1, 2], [0, 2, 3]]))]
_TAGS = [np.array([1, 2]), np.array([3, 3])]
_GROUPS = {"bottom": np.array([1, 1]), "side": np.array([2, 1]), "body": np.array([3, 2])}

GMSH41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
2
1 7 "bottom"
2 7 "body"
$EndPhysicalNames
$Entities
0 1 1 0
1 0 0 0 1 0 0 1 7 0
1 0 0 0 1 1 0 1 7 1 1
$EndEntities
$Nodes
1 4 1 4
2 1 0 4
1
2
3
4
0 0 0
1 0 0
1 1 0
0 1 0
$EndNodes
$Elements
2 3 1 3
1 1 1 1
1 1 2
2 1 2 2
2 1 2 3
3 1 3 4
$EndElements
"""
ABAQUS = """*NODE, NSET=ALL
1, 0.0, 0.0
2, 1.0, 0.0
3, 1.0, 1.0
4, 0.0, 1.0
*ELEMENT, TYPE=T3D2, ELSET=SIDE
1, 1, 2
*ELEMENT, TYPE=CPS3, ELSET=BODY
2, 1, 2, 3
3, 1, 3, 4
*NSET, NSET=LOW, GENERATE
1, 2, 1
*SURFACE, NAME=BOTTOM, TYPE=ELEMENT
BODY, S1
"""
SU2 = """NDIME= 2
NELEM= 2
5 0 1 2 0
5 0 2 3 1
NPOIN= 4
0 0 0
1 0 1
1 1 2
0 1 3
NMARK= 1
MARKER_TAG= 1
MARKER_ELEMS= 2
3 0 1
3 1 2
"""


def whole_files(folder):
    """Write one file of each kind; return its name and its bytes"""
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):  # meshio has advice
        _write_files(folder)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def _write_files(folder):
    mesh = meshio.Mesh(
        _POINTS,
        _CELLS,
        cell_data={"gmsh:physical": _TAGS, "gmsh:geometrical": _TAGS},
        field_data=_GROUPS,
    )
    plain = meshio.Mesh(_POINTS, _CELLS, cell_data={"mat_id": _TAGS})
    flat = meshio.Mesh(_POINTS[:, :2], _CELLS, cell_data={"medit:ref": _TAGS})
    (folder / "gmsh41.msh").write_text(GMSH41)
    (folder / "deck.inp").write_text(ABAQUS)
    mesh.write(folder / "gmsh22.msh", file_format="gmsh22", binary=False)
    mesh.write(folder / "gmsh22b.msh", file_format="gmsh22", binary=True)
    plain.write(folder / "old.vtk", file_format="vtk42", binary=False)
    plain.write(folder / "binary.vtk", file_format="vtk")
    plain.write(folder / "ascii.vtu", binary=False)
    plain.write(folder / "binary.vtu", binary=True)
    flat.write(folder / "plane.mesh")
    (folder / "plane.su2").write_text(SU2)
    box = jc.meshes.box((1.0, 1.0, 1.0), h=1.0)
    solid = meshio.Mesh(box.points, [("tetra", box.cells)])
    solid.write(folder / "solid.nas")
    solid.write(folder / "solid.bdf", file_format="nastran")
    solid.write(folder / "solid.avs")
    solid.write(folder / "solid.mdpa")
    solid.write(folder / "solid.tec")
    surface = meshio.Mesh(_POINTS, _CELLS[1:])
    surface.write(folder / "surface.off")
    surface.write(folder / "surface.ply", binary=False)
    jc.optimize(
        lambda u: (u**2).sum(), np.ones((1, 2, 1)), method=jc.SteepestDescent(),
        iterations=1, **_line(),
    ).save(folder / "result.npz")  # fmt: skip


def _line():
    mesh = jc.meshes.interval(1.0, h=1.0)
    scene = jc.Scene(mesh, jc.KelvinVoigt(young=1.0, poisson=0.0), clamped=("left",))
    return {"system": jc.discretize(scene), "dt": 0.1}


def damaged(content, seed):
    """The bytes of a file after one kind of accident"""
    rng = np.random.default_rng([3, seed])
    data = bytearray(content)
    place = int(rng.integers(len(data)))
    stretch = slice(place, place + int(rng.integers(1, 64)))
    match int(rng.integers(6)):
        case 0:
            return bytes(data[:place])
        case 1:
            for k in rng.integers(len(data), size=int(rng.integers(1, 9))):
                data[k] = int(rng.integers(256))
        case 2:
            data[place] ^= 1 << int(rng.integers(8))
        case 3:
            del data[stretch]
        case 4:
            data[place:place] = data[stretch]
        case 5:
            # Another digit somewhere: a number that parses, but does not fit.
            digits = [k for k, byte in enumerate(data) if 48 <= byte < 58]
            data[digits[int(rng.integers(len(digits)))]] = int(rng.integers(45, 58))
    return bytes(data)


def fuzz_files(folder, seeds):
    """Damage files and read them; return how often each ending came, and the endings not allowed"""
    whole = whole_files(folder)
    endings, leaks = Counter(), []
    names = sorted(whole)
    for seed in seeds:
        name = names[seed % len(names)]
        path = folder / f"damaged-{name}"
        path.write_bytes(damaged(whole[name], seed))
        ending = read(path)
        endings[f"{name}: {ending if isinstance(ending, str) else type(ending).__name__}"] += 1
        if isinstance(ending, BaseException) and not isinstance(ending, DOCUMENTED):
            leaks.append({"file": name, "seed": seed, "error": repr(ending)[:200]})
    return endings, leaks


def read(path):
    """How reading a file ends: "read" or the exception"""
    reader = load_result if path.suffix == ".npz" else jc.read_mesh
    with warnings.catch_warnings():
        # Names that are left out are said in a warning.
        warnings.simplefilter("ignore", UserWarning)
        try:
            with _time_limit(SECONDS):
                reader(path)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            return error
    return "read"


@contextmanager
def _time_limit(seconds):
    """Raise `Endless` in what takes longer; where there is no alarm it goes on"""
    if not hasattr(signal, "setitimer"):
        yield
        return
    before = signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _stop(*_):
    raise Endless
