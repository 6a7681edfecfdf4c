"""Every source and every file that the texts name can be looked up."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = sorted((ROOT / "jaxcontact").rglob("*.py"))
PAGES = {path.name: path for folder in (ROOT, ROOT / "notebooks") for path in folder.glob("*.md")}

TREE = [
    path.relative_to(ROOT).as_posix()
    for folder in ("jaxcontact", "tests", "notebooks", "benchmarks")
    for path in (ROOT / folder).rglob("*.*")
]

PAPER = re.compile(r"\bpaper\b|\([2-4]\.\d+[a-e]?\)")
PUBLICATION = re.compile(r"\((1[5-9]|20)\d\d\)")
PAGE = re.compile(r"\b(\w+\.md)\b(?: (\d+))?")


def documentation(path):
    """Docstrings, those under fields included, and comments that stand for one."""
    text = path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield str(node.value.value)
    yield "\n\n".join(re.findall(r"#: (.*)", text))


def sources(text):
    """What stands after each `Source:`, to the end of the paragraph, one by one."""
    for paragraph in re.split(r"\n\s*\n", text):
        _, *named = re.sub(r"\s+", " ", paragraph).split("Source: ")
        for source in named:
            yield from (part.strip() for part in source.split(";"))


def is_page(name, section):
    """Whether the tree has the page, and the page the section."""
    if name not in PAGES:
        return False
    headings = re.findall(r"^## (\d+)\. ", PAGES[name].read_text(encoding="utf-8"), re.MULTILINE)
    return not section or section in headings


def is_found(source):
    """Whether a source is a page of the tree, the paper or a publication."""
    pages = PAGE.findall(source)
    if pages:
        return all(is_page(*page) for page in pages)
    return bool(PAPER.search(source) or PUBLICATION.search(source))


def test_every_source_names_a_page_the_paper_or_a_publication():
    named = {
        (str(path.relative_to(ROOT)), source)
        for path in PACKAGE
        for text in documentation(path)
        for source in sources(text)
    }
    assert len(named) > 30
    offenders = [f"{path}: {source}" for path, source in sorted(named) if not is_found(source)]
    assert not offenders, "\n".join(offenders)


def test_every_page_that_the_package_mentions_exists():
    mentioned = {page for path in PACKAGE for page in PAGE.findall(path.read_text("utf-8"))}
    assert ("MATH.md", "2") in mentioned
    assert not {page for page in mentioned if not is_page(*page)}


def test_every_file_that_a_text_names_exists():
    missing = [
        f"{text.relative_to(ROOT)}: {name}"
        for text in [*PACKAGE, *PAGES.values(), ROOT / "benchmarks" / "README.md"]
        for name in re.findall(r"`((?:\w+/)*\w+\.(?:py|ipynb))`", text.read_text("utf-8"))
        if not any(f"/{file}".endswith(f"/{name}") for file in TREE)
    ]
    assert not missing, "\n".join(missing)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("MATH.md 2.", True),
        ("MATH.md 99.", False),
        ("THEORY.md", False),
        ("paper, Theorem 4.20.", True),
        ("(4.40)-(4.41).", True),
        ("Kane, Repetto, Ortiz, Marsden, CMAME 180 (1999).", True),
        ("Chen, Harker, Kanzow, Smale for the change of unknowns.", False),
        ("elementary", False),
    ],
)
def test_source_is_found_only_where_a_reader_finds_it(source, expected):
    assert is_found(source) is expected
