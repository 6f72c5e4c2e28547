"""Griffe extension: what docstrings of this package use and the API pages would not understand.

SB3's docstrings name other objects by Sphinx's roles, such as ``:meth:`save```, and attributes are described by ``#:``
comments.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

# An argument that begins with an underscore: SB3's own, or none of a user's business.
PRIVATE_ARGUMENT = re.compile(r"^[ ]*:param _\w+:.*(?:\n[ ]+(?!:).*)*\n?", re.MULTILINE)
ROLE = re.compile(r":(?:class|meth|func|attr|mod|exc|data):`(~?)([\w.]+)`")


class Docstrings(griffe.Extension):
    """Turns roles into links and ``#:`` comments into docstrings, and hides private arguments."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """A ``#:`` comment above an attribute describes it."""
        if attr.docstring is None and attr.lineno is not None and (text := _comment_above(attr)):
            attr.docstring = griffe.Docstring(text, parent=attr)

    def on_function_instance(self, *, func: griffe.Function, **_: Any) -> None:
        """Private arguments are not for the pages."""
        for name in [parameter.name for parameter in func.parameters if parameter.name.startswith("_")]:
            del func.parameters[name]

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Everything is loaded, so that names can be looked up."""
        _link_roles(pkg)


def _comment_above(attr: griffe.Attribute) -> str:
    lines = attr.lines_collection[attr.filepath]
    comment: list[str] = []
    for line in reversed(lines[: attr.lineno - 1]):
        if not line.strip().startswith("#:"):
            break
        comment.insert(0, line.strip().removeprefix("#:").strip())
    text = " ".join(comment)
    return text[:1].upper() + text[1:]


def _link_roles(obj: griffe.Object) -> None:
    if obj.docstring is not None:
        public = PRIVATE_ARGUMENT.sub("", obj.docstring.value)
        obj.docstring.value = ROLE.sub(lambda match: _link(obj, match[1], match[2]), public)
    for member in obj.members.values():
        if isinstance(member, griffe.Object):
            _link_roles(member)


def _link(obj: griffe.Object, short: str, name: str) -> str:
    """A link where the pages have the object, its name otherwise."""
    shown = name.rsplit(".", 1)[-1] if short else name
    return f'<autoref optional identifier="{_path(obj, name)}"><code>{shown}</code></autoref>'


def _path(obj: griffe.Object, name: str) -> str:
    """Where an object is defined that a docstring calls by a name of its own scope, or by its whole path."""
    scope: Any = obj
    while scope is not None:
        if not scope.is_function and name.split(".")[0] in scope.all_members:
            scope = scope.all_members[name.split(".")[0]]
            for part in name.split(".")[1:]:
                scope = scope.all_members[part]
            return scope.canonical_path
        scope = scope.parent
    return name
