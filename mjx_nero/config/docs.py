"""Reads descriptions of fields and parameters from docstrings and comments, for help texts."""

import functools
import inspect
import re
from collections.abc import Callable
from typing import Any

_COMMENT = re.compile(r"    (\w+): [^#]*?  # (.+)")


def summary(thing: Any) -> str:
    """The first line of a docstring, without its full stop."""
    return (inspect.getdoc(thing) or "").partition("\n")[0].removesuffix(".")


def fields(cls: Any) -> dict[str, str]:
    """Name -> text of a dataclass's fields: from its docstring's ``Attributes:``, or the comment behind the field."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if "__dataclass_fields__" in vars(base):
            found |= _comments(base) | entries(base, "Attributes")
    return found


def entries(thing: type | Callable, title: str) -> dict[str, str]:
    """Name -> text of the lines under ``title:`` in a docstring; ``a, b: text`` is about both."""
    found: dict[str, str] = {}
    lines = iter((thing.__doc__ and inspect.cleandoc(thing.__doc__) or "").splitlines())
    names: list[str] = []
    for line in lines:
        if line == f"{title}:":
            break
    for line in lines:
        if not line.startswith("    "):
            break
        if line[4] != " ":
            head, _, line = line.partition(": ")
            names = head.replace(",", " ").split()
        found |= {name: f"{found.get(name, '')} {line.strip()}".strip() for name in names}
    return {name: text.removesuffix(".") for name, text in found.items()}


@functools.cache
def _comments(cls: Any) -> dict[str, str]:
    try:
        source = inspect.getsource(cls)
    except (OSError, TypeError):  # made without a file
        return {}
    return dict(match.groups() for line in source.splitlines() if (match := _COMMENT.match(line)))  # type: ignore[misc]
