"""The programs of the documentation run, and its site is built without a warning."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
TASKS = (NOTEBOOKS / "tasks.md").read_text(encoding="utf-8")
HEAD, *BLOCKS = re.findall(r"^```python\n(.*?)^```$", TASKS, re.MULTILINE | re.DOTALL)
TITLES = re.findall(r"^## (.*)$", TASKS, re.MULTILINE)


def run_block(block, folder):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", HEAD + block],
        capture_output=True,
        text=True,
        cwd=folder,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_task_has_one_short_program():
    assert len(TITLES) == len(BLOCKS) >= 10
    lines = [sum(bool(line.strip()) for line in block.splitlines()) for block in BLOCKS]
    assert max(lines) <= 25


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS, ids=TITLES)
def test_program_of_a_task_runs_without_a_warning(block, tmp_path):
    if "import gmsh" in block:
        pytest.importorskip("gmsh")
    run_block(block, tmp_path)


@pytest.mark.slow
def test_program_of_the_first_page_makes_its_picture(tmp_path):
    text = (NOTEBOOKS / "start.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert "converged: 500" in run_block(block, tmp_path)
    assert (tmp_path / "bounce.gif").read_bytes()[:3] == b"GIF"


@pytest.mark.slow
def test_documentation_is_built_without_a_warning(tmp_path):
    pytest.importorskip("myst_nb")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", NOTEBOOKS, tmp_path / "site"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for page in NOTEBOOKS.glob("*.md"):
        assert (tmp_path / "site" / f"{page.stem}.html").is_file()
