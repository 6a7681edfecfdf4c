"""A release: one version everywhere, and a wheel and an sdist that install and run."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import jaxcontact

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
#: What the tests, the notebooks and the benchmarks read.
SHIPPED = ("jaxcontact", "tests", "benchmarks", "notebooks", ".ci")

SIMULATION = """
import jax
import jaxcontact as jc

jax.config.update("jax_enable_x64", True)
wall = jc.HalfSpace(point=[-0.1], normal=[1.0])
bar = jc.Scene(
    jc.meshes.interval(1.0, h=0.25),
    jc.KelvinVoigt(young=1.0, poisson=0.0),
    contact={"left": wall},
    body_force=[-1.0],
)
motion = jc.simulate(jc.prepare(jc.discretize(bar), 0.1), steps=20)
assert motion.active.any()
print(jc.__file__)
"""

#: One use of everything that older versions of JAX break.
DERIVATIVES = """
import jax
import jax.numpy as jnp
import numpy as np
import jaxcontact as jc

jax.config.update("jax_enable_x64", True)
mesh = jc.meshes.interval(1.0, h=0.25)
wall = jc.HalfSpace(np.array([-0.02]), np.array([1.0]))
start = jc.State(jnp.zeros((5, 1)), jnp.full((5, 1), -1.0))

def prepare(x):
    material = jc.KelvinVoigt(young=x[0], poisson=0.0, density=x[1])
    return jc.prepare(jc.discretize(jc.Scene(mesh, material, contact={"left": wall})), 0.02)

def end(stepper):
    return jnp.sum(jc.simulate(stepper, steps=8, initial=start).final.displacement ** 2)

def of(x):
    return end(prepare(x))

at, step = jnp.array([10.0, 1.2]), 1e-4
assert jnp.allclose(jax.jit(of)(at), of(at), rtol=1e-12)
batch = jax.vmap(of)(jnp.stack([at, 2.0 * at]))
assert jnp.allclose(batch[0], of(at), rtol=1e-12)
slope = jax.grad(of)
hessian = jax.jit(jax.jacfwd(slope))(at)
for f, derivative in ((of, slope(at)), (slope, hessian)):
    steps = step * jnp.eye(2)
    differences = jnp.stack([(f(at + e) - f(at - e)) / (2.0 * step) for e in steps])
    assert jnp.allclose(differences, derivative, rtol=1e-5, atol=1e-9)
assert "scan" in str(jax.make_jaxpr(jax.grad(end, allow_int=True))(prepare(at)))
print(jax.__version__)
"""


def run(*command, **options):
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_release_has_one_version_and_date():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    version, date = re.findall(r"^## \[(\d.*)\] - (\S+)$", changelog, re.MULTILINE)[0]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    cited = dict(re.findall(r'^([a-z-]+): "?([^"\n]+)"?$', citation, re.MULTILINE))
    assert version == cited["version"] == PROJECT["version"] == jaxcontact.__version__
    assert date == cited["date-released"]
    assert cited["license"] == PROJECT["license"]


def test_public_workflow_tests_three_systems_and_both_ends_of_the_versions():
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
    for word in ("ubuntu", "macos", "windows", "lowest-direct", "highest", "python -m pytest"):
        assert word in workflow
    lowest = PROJECT["requires-python"].removeprefix(">=")
    assert f'"{lowest}"' in workflow


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """The folder with wheel and sdist; the wheel is made from the sdist."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT))
    return folder


@pytest.mark.slow
def test_wheel_holds_the_package_and_says_that_it_is_typed(distributions):
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert "jaxcontact/py.typed" in names
    assert {name.split("/")[0] for name in names} == {
        "jaxcontact",
        f"jaxcontact-{PROJECT['version']}.dist-info",
    }


@pytest.mark.slow
def test_sdist_holds_all_that_tests_notebooks_and_benchmarks_read(distributions):
    (sdist,) = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    tree = {
        path.relative_to(ROOT).as_posix()
        for folder in SHIPPED
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert not tree - inside
    pages = {path.name for pattern in ("*.md", "*.cff") for path in ROOT.glob(pattern)}
    top = {name.split("/")[0] for name in inside if name}
    assert top == {*SHIPPED, *pages, "pyproject.toml", "LICENSE", ".gitignore", "PKG-INFO"}


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["*.whl", "*.tar.gz"])
def test_distribution_installs_and_simulates(distributions, pattern, tmp_path):
    (distribution,) = distributions.glob(pattern)
    target = tmp_path / "installed"
    options = ("--no-deps", "--no-index", "--no-build-isolation", "--target", str(target))
    run(sys.executable, "-m", "pip", "install", *options, str(distribution))
    path = os.pathsep.join([str(target), os.environ.get("PYTHONPATH", "")])
    printed = run(
        sys.executable, "-c", SIMULATION, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}
    )
    assert Path(printed.strip()).is_relative_to(target)


@pytest.mark.slow
def test_lowest_version_of_jax_differentiates_a_motion(tmp_path):
    dependencies = dict(line.split(">=") for line in PROJECT["dependencies"])
    lowest = dependencies["jax"]
    assert dependencies["jaxlib"] == lowest
    folder = tmp_path / "lowest"
    venv.create(folder, with_pip=True)
    (python,) = (*folder.glob("bin/python"), *folder.glob("Scripts/python.exe"))
    others = [line for line in PROJECT["dependencies"] if not line.startswith("jax")]
    pinned = [f"jax=={lowest}", f"jaxlib=={lowest}", *others]
    run(str(python), "-m", "pip", "install", "--quiet", *pinned)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    assert run(str(python), "-c", DERIVATIVES, env=environment).strip() == lowest
