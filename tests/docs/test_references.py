"""What comments and pages refer to is there: the repository explains itself."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from places import ROOT

FOLDERS = ("sb3_dreamer_urlb", "tests", "docs", "benchmarks", "scripts", "examples", "zoo_configs")
ENDINGS = {".py", ".md", ".yml", ".toml", ".cfg", ".cpp", ".h", ".sh", ".ipynb", ".cff", ".txt", ".svg"}
FILES = sorted(
    path
    for path in [*ROOT.iterdir(), *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*"))]
    if path.is_file() and (path.suffix in ENDINGS or path.name in ("Makefile", "Dockerfile"))
)
# Folders that a checkout does not have, and machines that its readers do not have.
ELSEWHERE = re.compile(
    r"""(?<![\w/-])(?:spec/|\.\./shared|/work/|shared/(?:spec|golden|cases|tools|paper)|pack-for-gpu|lent\s+machine)"""
)
# docs/algorithm.md, "Skills": a page, and perhaps a section; lines may break anywhere, in comments, too.
CITED = re.compile(r'docs/([\w/-]+\.md)(?:,[\s#:]+"([^"]+)")?')


def headings(page: Path) -> set[str]:
    """The titles of a page's sections."""
    return {re.sub(r"[*`]", "", title.strip()) for title in re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)}


@pytest.mark.parametrize("folder", [".", *FOLDERS])
def test_nothing_refers_to_what_is_not_in_the_repository(folder):
    files = (
        [path for path in FILES if path.parent == ROOT]
        if folder == "."
        else [path for path in FILES if path.is_relative_to(ROOT / folder)]
    )
    assert files
    for path in files:
        if path != Path(__file__).resolve():
            found = ELSEWHERE.search(path.read_text())
            assert found is None, f"{path.relative_to(ROOT)} mentions {found[0]!r}"


def test_pages_and_sections_that_the_code_cites_exist():
    cited = 0
    for path in FILES:
        if path.suffix in (".md", ".ipynb") or path == Path(__file__).resolve():
            continue  # their links are checked by the site
        for page, section in CITED.findall(path.read_text()):
            where = f"{path.relative_to(ROOT)} cites docs/{page}"
            assert (ROOT / "docs" / page).is_file(), where
            if section:
                title = re.sub(r"[\s#:]+", " ", section)
                assert title in {re.sub(r"[\s#:]+", " ", known) for known in headings(ROOT / "docs" / page)}, (
                    f"{where}, {title!r}"
                )
                cited += 1
    assert cited > 20  # the search finds what it looks for


@pytest.mark.parametrize("text", ["see spec/algorithms §6", "in ../shared/tools", "cd /work/x", "(spec/reliability)"])
def test_the_search_finds_what_lies_elsewhere(text):
    assert ELSEWHERE.search(text)


@pytest.mark.parametrize("text", ["runs/walker", "a/b/spec/x", "docs/algorithm.md", "network/works", "tests/golden/x"])
def test_the_search_leaves_the_rest_alone(text):
    assert not ELSEWHERE.search(text)
