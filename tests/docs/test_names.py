"""Whoever copies a page's Python from top to bottom has every name that it uses."""

from __future__ import annotations

import ast
import builtins

import pytest
from places import ROOT
from test_docs import PAGES, code_blocks


def undefined(code: str) -> set[str]:
    """Names that code reads, and nothing in it or before it binds."""
    bound, read = set(dir(builtins)), set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Name):
            (read if isinstance(node.ctx, ast.Load) else bound).add(node.id)
        elif isinstance(node, ast.alias):
            bound.add((node.asname or node.name).split(".")[0])
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            bound.add(node.name)
        elif isinstance(node, ast.arg):
            bound.add(node.arg)
        elif isinstance(node, ast.ExceptHandler) and node.name:
            bound.add(node.name)
    return read - bound


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.suffix == ".md"], ids=lambda page: str(page.relative_to(ROOT))
)
def test_a_page_imports_what_it_uses(page):
    missing = {}
    blocks = code_blocks(page)
    for i, block in enumerate(blocks):
        if names := undefined("\n".join(blocks[: i + 1])) - set().union(*missing.values()):
            missing[block.split("\n")[0]] = names
    assert not missing
