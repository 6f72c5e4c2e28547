"""MkDocs hook: the pages of the site that lie outside of docs/, so that nothing stands twice.

README.md is the start page, changelog, security notes and the notebook are pages, and a Python file that a page links to
becomes a page with its code. Links are rewritten to fit; whatever leads nowhere is left to MkDocs, which refuses it.

Pages are also finished here: formulas become MathML, tables lose empty headers, long signatures are folded, short code
and numbers stay in one line.
"""

from __future__ import annotations

import html
import json
import os
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
#: file of the repository → its page
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "CONTRIBUTING.md": "contributing.md",
    "examples/quickstart.ipynb": "quickstart.md",
}
# The target of a Markdown link or image that is neither a URL nor an anchor of the same page.
LINK = re.compile(r"(?<=\]\()(?!https?:|#)([^)#\s]+)")
FORMULA = re.compile(r'<div class="arithmatex">\\\[(.*?)\\\]</div>', re.DOTALL)
EMPTY_HEADER = re.compile(r"<thead>\s*<tr>(?:\s*<th[^>]*>\s*</th>)+\s*</tr>\s*</thead>")
SIGNATURE = re.compile(r'<div class="doc-signature highlight">.*?</div>', re.DOTALL)
PREFORMATTED = re.compile(r"(<pre.*?</pre>)", re.DOTALL)
# Code in the text, of one line and no more letters than a phone has room for.
SHORT_CODE = re.compile(r"<code>(?=[^<\n]{1,24}</code>)")
# 1 050 000; between tags, as pictures have numbers in their attributes.
TEXT = re.compile(r"(?<=>)[^<]+")
THOUSANDS = re.compile(r"(?<=\d) (?=\d{3}(?!\d))")
#: what becomes a page with its text, by its ending: the language to colour it by
CODE = {".py": "python", ".cff": "yaml", "": "docker"}
#: lines of a signature that are shown without a click
SHOWN_LINES = 10


def page_of(path: Path) -> str | None:
    """Where a file of the repository is found on the site; None if it is not there.

    :param path: absolute
    """
    if not path.is_relative_to(ROOT) or not path.is_file():
        return None
    name = path.relative_to(ROOT).as_posix()
    if name.startswith("docs/"):
        return name.removeprefix("docs/")
    return PAGES.get(name) or (f"source/{name}.md" if path.suffix in CODE else None)


def file_of(page: str) -> Path:
    """The file of the repository that is a page's text.

    :param page: as MkDocs names it
    """
    names = {made: name for name, made in PAGES.items()}
    return ROOT / names[page] if page in names else ROOT / "docs" / page


def text_of(path: Path) -> str:
    """A file as Markdown: a notebook's cells and what they put out, Python as code, Markdown as it is."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        return "\n\n".join(part for cell in json.loads(text)["cells"] for part in cell_as_markdown(cell))
    if path.suffix not in CODE:
        return text
    # Code needs the width.
    hidden = "---\nhide:\n  - toc\n---\n\n"
    return f"{hidden}# {path.name}\n\n`````{CODE[path.suffix]}\n{text}`````\n"


def cell_as_markdown(cell: dict[str, Any]) -> list[str]:
    """A notebook's cell, then its outputs: text, and pictures inside the page."""
    source = "".join(cell["source"])
    if cell["cell_type"] != "code":
        return [source]
    parts = [f"```python\n{source}\n```"]
    for output in cell["outputs"]:
        data = output.get("data", {"text/plain": output.get("text", [])})
        pictures = [kind for kind in data if kind.startswith("image/")]
        for kind in pictures:
            parts.append(f'<img alt="what the cell shows" src="data:{kind};base64,{"".join(data[kind].split())}">')
        if not pictures:
            parts.append(f"```text\n{''.join(data['text/plain']).rstrip()}\n```")
    return parts


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the pages from outside."""
    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=text_of(ROOT / name)))
    for page in [file.src_uri for file in files.documentation_pages()]:
        here = file_of(page)
        for target in LINK.findall(text_of(here)):
            path = (here.parent / target).resolve()
            source = page_of(path)
            if source is not None and source.startswith("source/") and source not in files.src_uris:
                files.append(File.generated(config, source, content=text_of(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Rewrite the links of a page for its place on the site."""
    if page.file.src_uri.startswith("source/"):
        return markdown
    here = file_of(page.file.src_uri).parent
    folder = os.path.dirname(page.file.src_uri) or "."

    def moved(match: re.Match[str]) -> str:
        target = page_of((here / match[0]).resolve())
        return match[0] if target is None else os.path.relpath(target, folder)

    return LINK.sub(moved, markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Finish a page, once Markdown and docstrings have become HTML."""
    content = FORMULA.sub(lambda match: convert(html.unescape(match[1]).strip(), display="block"), content)
    content = EMPTY_HEADER.sub("", content)
    content = SIGNATURE.sub(lambda match: _folded(match[0]), content)
    return "".join(part if PREFORMATTED.match(part) else _unbroken(part) for part in PREFORMATTED.split(content))


def _unbroken(content: str) -> str:
    """Let no line end within short code, or between the digits of a number."""
    content = TEXT.sub(lambda match: THOUSANDS.sub("\u00a0", match[0]), content)
    return SHORT_CODE.sub('<code class="short">', content)


def _folded(signature: str) -> str:
    lines = signature.count("\n") - 1
    if lines <= SHOWN_LINES:
        return signature
    return f'<details class="signature"><summary>Signature, {lines} arguments</summary>{signature}</details>'
