"""The version stands in one file, and whoever repeats it agrees."""

from __future__ import annotations

import re

from packaging.version import Version
from places import ROOT

from sb3_dreamer_urlb import __version__


def test_the_changelog_begins_with_it_and_the_citation_names_it() -> None:
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert newest is not None and cited is not None
    assert __version__ == newest[1] == cited[1]


def test_old_names_end_with_a_later_version() -> None:
    sources = [path.read_text() for path in (ROOT / "sb3_dreamer_urlb").rglob("*.py")]
    ends = {found for text in sources for found in re.findall(r"old names? ends? with version (\d+)\.(\d+)", text)}
    assert ends and all(Version(f"{major}.{minor}") > Version(__version__) for major, minor in ends)
