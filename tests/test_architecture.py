"""The layers of the package, read from its imports."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "jaxcontact"

# Bottom first. A file imports from layers below its own, or from its own folder.
LAYERS = (
    {"precision", "symmetric_product"},
    {"sparse"},
    {"mesh", "material", "obstacle", "reference"},
    {"meshes", "io", "scene"},
    {"assembly"},
    {"system"},
    {"reduction"},
    {"linear"},
    {"contact"},
    {"schemes"},
    {"stepper"},
    {"trajectory"},
    {"time_loop"},
    {"simulate"},
    {"energy", "inner_product", "memory", "pressure", "static"},
    {"cost"},
    {"scenes", "optimize", "derivative"},
    {"axes"},
    {"plot", "export"},
    {"figures"},
    {"cli"},
)
RANK = {module: rank for rank, layer in enumerate(LAYERS) for module in layer}
RUNTIME = {"jax", "jaxlib", "numpy", "scipy", "meshio", "optax"}
OPTIONAL = {"matplotlib", "tqdm"}
MOST_LINES = 300

FILES = sorted(ROOT.rglob("*.py"))
by_name = pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))


def module_of(path):
    """The layer's name: the file or the folder directly in the package."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def is_type_checking(node):
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def imports(tree, *, inside_functions=True):
    """Dotted names of all imports that run, with those in functions or without."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"write out the relative import in line {node.lineno}"
            # `from jaxcontact import plot` names the module in its second half.
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif is_type_checking(node):
            continue
        elif inside_functions or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from imports(node, inside_functions=inside_functions)


def own_modules(tree):
    """Modules of this package that a file imports."""
    parts = [name.split(".") for name in imports(tree)]
    return {names[1] if len(names) > 1 else "" for names in parts if names[0] == "jaxcontact"}


def parse(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@by_name
def test_file_imports_only_from_layers_below(path):
    if path == ROOT / "__init__.py":
        return
    module = module_of(path)
    assert module in RANK, f"give {module} a place in LAYERS of {Path(__file__).name}"
    if module == "cli":
        return  # the application uses the public names
    upward = {
        name
        for name in own_modules(parse(path)) - {module}
        if RANK.get(name, len(LAYERS)) >= RANK[module]
    }
    assert not upward, f"{module} may not import {upward}"


@by_name
def test_file_is_short(path):
    n_lines = len(path.read_text(encoding="utf-8").splitlines())
    assert n_lines <= MOST_LINES, f"{n_lines} lines; split it"


@by_name
def test_file_imports_only_declared_packages(path):
    packages = {name.split(".")[0] for name in imports(parse(path))}
    allowed = RUNTIME | OPTIONAL | {"jaxcontact"} | set(sys.stdlib_module_names)
    assert packages <= allowed, packages - allowed


@by_name
def test_file_imports_optional_packages_only_in_functions(path):
    packages = {name.split(".")[0] for name in imports(parse(path), inside_functions=False)}
    assert not packages & OPTIONAL


def test_layers_name_each_module_once():
    assert sum(map(len, LAYERS)) == len(RANK)


def test_imports_are_found_where_they_hide():
    tree = ast.parse(
        "import a\n"
        "from jaxcontact import plot\n"
        "if TYPE_CHECKING:\n    import never\n"
        "if x:\n    import b.c\n"
        "def f():\n    try:\n        from d import e\n    except ImportError: pass\n"
    )
    assert list(imports(tree)) == ["a", "jaxcontact.plot", "b.c", "d.e"]
    assert list(imports(tree, inside_functions=False)) == ["a", "jaxcontact.plot", "b.c"]
    assert own_modules(tree) == {"plot"}
