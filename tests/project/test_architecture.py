"""The layers of the package, read from its imports."""

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2] / "jaxcontact"

# Bottom first. A file imports from layers below its own, or from its own folder.
LAYERS = (
    {"transforms"},
    {"scene", "reference"},
    {"system"},
    {"linear"},
    {"contact"},
    {"schemes"},
    {"motion"},
    {"control"},
    {"derivative"},
    {"optimize"},
    {"output"},
    {"accuracy"},
    {"api"},
    {"cli"},
)
RANK = {module: rank for rank, layer in enumerate(LAYERS) for module in layer}
RUNTIME = {"jax", "jaxlib", "numpy", "scipy", "meshio", "optax"}
OPTIONAL = {"gmsh", "matplotlib", "netCDF4", "pyvista", "tqdm"}
MOST_LINES = 300

FILES = sorted(ROOT.rglob("*.py"))


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


def upward_imports(path):
    """Imports of a file that do not go down the layers; the application uses the public names."""
    module = module_of(path)
    assert module in RANK, f"give {module} a place in LAYERS of {Path(__file__).name}"
    if module in ("api", "cli"):
        return set()
    others = own_modules(parse(path)) - {module}
    return {name for name in others if RANK.get(name, len(LAYERS)) >= RANK[module]}


def test_files_import_only_from_layers_below():
    found = {path: upward_imports(path) for path in FILES if path != ROOT / "__init__.py"}
    assert not {str(path): names for path, names in found.items() if names}


def test_files_are_short():
    n_lines = {str(path): len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
    assert not {path: n for path, n in n_lines.items() if n > MOST_LINES}


def test_files_import_only_declared_packages():
    allowed = RUNTIME | OPTIONAL | {"jaxcontact"} | set(sys.stdlib_module_names)
    for path in FILES:
        packages = {name.split(".")[0] for name in imports(parse(path))}
        assert packages <= allowed, (path, packages - allowed)


def test_files_import_optional_packages_only_in_functions():
    for path in FILES:
        packages = {name.split(".")[0] for name in imports(parse(path), inside_functions=False)}
        assert not packages & OPTIONAL, path


def test_contributing_tells_the_layers_in_their_order():
    text = (ROOT.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| `(\w+)(?:/|\.py)` \|", text, flags=re.MULTILINE)
    assert set(table) == set(RANK)
    assert [RANK[name] for name in table] == sorted(RANK[name] for name in table)


def test_layers_name_each_module_once():
    assert sum(map(len, LAYERS)) == len(RANK)


def test_imports_are_found_where_they_hide():
    tree = ast.parse(
        "import a\n"
        "from jaxcontact import output\n"
        "if TYPE_CHECKING:\n    import never\n"
        "if x:\n    import b.c\n"
        "def f():\n    try:\n        from d import e\n    except ImportError: pass\n"
    )
    assert list(imports(tree)) == ["a", "jaxcontact.output", "b.c", "d.e"]
    assert list(imports(tree, inside_functions=False)) == ["a", "jaxcontact.output", "b.c"]
    assert own_modules(tree) == {"output"}
