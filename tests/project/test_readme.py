import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)


def test_readme_example_runs_as_printed_and_prints_what_the_text_says(tmp_path):
    (example,) = blocks("python")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", example],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert f"`{done.stdout.strip()}`" in README


def test_readme_is_short():
    assert len(README.split()) < 500


def test_pictures_of_the_readme_are_there():
    assert all((ROOT / name).is_file() for name in re.findall(r"!\[.*?\]\((.*?)\)", README))


def test_readme_commands_install_extras_that_exist():
    commands = blocks("sh")
    extras = set(re.findall(r"\.\[(\w+)\]", " ".join(commands)))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert extras == {"all", "dev"}
    assert extras <= set(project["optional-dependencies"])


def test_readme_and_continuous_integration_share_the_test_command():
    pattern = re.search(r"grep -E '(.*)' README.md", (ROOT / ".ci" / "run").read_text()).group(1)
    assert len(re.findall(pattern, README, flags=re.MULTILINE)) == 1
