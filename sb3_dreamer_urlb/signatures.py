"""The arguments that a class takes, also through constructors that hand ``*args`` and ``**kwargs`` on."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from sb3_dreamer_urlb.unknown_names import check_keys, unexpected_arguments

if TYPE_CHECKING:
    from typing_extensions import ParamSpec, Self

    Given = ParamSpec("Given")

Returned = TypeVar("Returned")

NAMELESS = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


def named_parameters(kind: type) -> dict[str, inspect.Parameter]:
    """Of a constructor, by name and without ``self``; ``**kwargs`` stand for what the next constructor up takes.

    :param kind: the class
    """
    found: dict[str, inspect.Parameter] = {}
    for base in kind.__mro__:
        if "__init__" not in vars(base) or base is object:
            continue
        _, *parameters = inspect.signature(base.__init__).parameters.values()  # type: ignore[misc]
        for parameter in parameters:
            if parameter.kind not in NAMELESS:
                found.setdefault(parameter.name, parameter)
        if not any(parameter.kind == inspect.Parameter.VAR_KEYWORD for parameter in parameters):
            break
    return found


def named_arguments(kind: type, args: Sequence[Any], kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a call by their names, as far as they have any.

    :param kind: the class that is called
    :param args: without names
    :param kwargs: by name
    """
    names = [name for name, parameter in named_parameters(kind).items() if parameter.kind in POSITIONAL]
    return {**dict(zip(names, args, strict=False)), **kwargs}


def check_keywords(kind: type, given: Iterable[str], filled_in: Iterable[str] = ()) -> None:
    """Whether a constructor takes these keywords. One that takes any is asked itself, unless it is of this package: ours
    hand theirs on as they are, others may take some out.

    :param kind: the class
    :param given: keywords of a call
    :param filled_in: arguments that somebody else gives
    :raises UnknownNameError: naming the unknown and the known ones, and which are near
    """
    maker = next(base for base in kind.__mro__ if "__init__" in vars(base))
    parameters = inspect.signature(maker.__init__).parameters.values()  # type: ignore[misc]
    takes_any = any(parameter.kind == inspect.Parameter.VAR_KEYWORD for parameter in parameters)
    if not takes_any or maker.__module__.partition(".")[0] == __name__.partition(".")[0]:
        check_keys("arguments", given, named_parameters(kind).keys() - {*filled_in}, kind.__name__)


def answering_unknown_keywords(method: Callable[Given, Returned]) -> Callable[Given, Returned]:
    """Let a method answer a keyword that there is not with near ones.

    :param method: that takes no ``**kwargs``
    """
    known = [*inspect.signature(method).parameters][1:]

    @functools.wraps(method)
    def wrapped(*args: Given.args, **kwargs: Given.kwargs) -> Returned:
        if unknown := [name for name in kwargs if name not in known]:
            caller = f"{type(args[0]).__name__}.{method.__name__}"
            raise unexpected_arguments(caller, unknown, known, f"help({caller})")
        return method(*args, **kwargs)

    return wrapped


class WithKnownKeywords:
    """Classes whose constructor answers a keyword that there is not with those that there are."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        check_keywords(cls, kwargs)
        return super().__new__(cls)


def constructed(kind: Any, first: Mapping[str, Any], **others: Any) -> Any:
    """Call a constructor as Stable-Baselines3 does, with some arguments in front, or by name where it wants them so.

    :param kind: the class
    :param first: the arguments in front, in their order
    :param others: by name
    """
    if _by_position(kind, list(first)):
        return kind(*first.values(), **others)
    return kind(**first, **others)


def _by_position(kind: type, first: list[str]) -> bool:
    """Whether a constructor can only take its first arguments without their names: it hides them, or calls them otherwise."""
    _, *parameters = inspect.signature(kind.__init__).parameters.values()  # type: ignore[misc]
    named = [parameter.name for parameter in parameters if parameter.kind in POSITIONAL]
    if any(parameter.kind == inspect.Parameter.POSITIONAL_ONLY for parameter in parameters):
        return True
    if any(parameter.kind == inspect.Parameter.VAR_POSITIONAL for parameter in parameters):
        return named == first[: len(named)]
    return len(named) >= len(first) > 0 and not set(named) & set(first)
