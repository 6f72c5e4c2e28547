"""Griffe extension: what docstrings of this package use and the API pages would not understand.

SB3's docstrings name other objects by Sphinx's roles, such as ``:meth:`save```, attributes are described by ``#:``
comments, and defaults are constants of modules: a reader is shown ``"auto"``, not ``AUTO``.
"""

from __future__ import annotations

import ast
import functools
import json
import re
from pathlib import Path
from typing import Any

import griffe

# An argument that begins with an underscore: SB3's own, or none of a user's business.
PRIVATE_ARGUMENT = re.compile(r"^[ ]*:param _\w+:.*(?:\n[ ]+(?!:).*)*\n?", re.MULTILINE)
ROLE = re.compile(r":(?:class|meth|func|attr|mod|exc|data):`(~?)([\w.]+)`")


class Docstrings(griffe.Extension):
    """Turns roles into links, ``#:`` comments into docstrings and names of defaults into values; hides private arguments."""

    def on_module_instance(self, *, mod: griffe.Module, **_: Any) -> None:
        """What a folder's ``__init__`` says is for those who work on it, and its members' pages are for those who use them."""
        if mod.is_init_module:
            mod.docstring = None

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
        _show_values(pkg)


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


def _show_values(obj: griffe.Object) -> None:
    if isinstance(obj, griffe.Function):
        for parameter in obj.parameters:
            if (
                isinstance(parameter.default, griffe.Expr)
                and (value := _value(obj.module, str(parameter.default))) is not None
            ):
                parameter.default = value
    for member in obj.members.values():
        if isinstance(member, griffe.Object):
            _show_values(member)


def _value(module: Any, name: str) -> str | None:
    """The literal that a module's constant stands for, as Python writes it; None for anything else.

    :param module: that the name is used in
    :param name: ``AUTO``, or ``arguments.UNIFORM`` of an imported module
    """
    first, _, rest = name.partition(".")
    member = module.members.get(first)
    if not isinstance(member, griffe.Alias):
        return None if rest else _constants(module.filepath).get(first)
    where, _, constant = (f"{member.target_path}.{rest}" if rest else member.target_path).rpartition(".")
    try:
        return _value(module.modules_collection[where], constant)
    except KeyError:  # another package's
        return None


@functools.cache
def _constants(path: Path) -> dict[str, str]:
    """What the assignments of a module, ``A = 1`` or ``A, B = BOTH = (1, 2)``, give names to."""
    found: dict[str, Any] = {}
    for node in ast.parse(path.read_text()).body:
        if not isinstance(node, ast.Assign):
            continue
        try:
            value = ast.literal_eval(node.value)
        except ValueError:
            continue
        for target in node.targets:
            pairs = zip(target.elts, value, strict=True) if isinstance(target, ast.Tuple) else [(target, value)]
            found |= {name.id: one for name, one in pairs if isinstance(name, ast.Name)}
    return {name: json.dumps(one) if isinstance(one, str) else repr(one) for name, one in found.items()}
