"""Reads descriptions of fields and parameters from docstrings and comments, for help texts."""

import functools
import inspect
import re
from collections.abc import Callable
from typing import Any

_COMMENT = re.compile(r"    (\w+): [^#]*?  # (.+)")


def summary(thing: Any) -> str:
    """Returns the first line of a docstring, without its full stop."""
    return (inspect.getdoc(thing) or "").partition("\n")[0].removesuffix(".")


def fields(cls: Any) -> dict[str, str]:
    """Returns the descriptions of a dataclass's fields by name: from its docstring's ``Attributes:``, or the field's comment."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if "__dataclass_fields__" in vars(base):
            found |= _comments(base) | entries(base, "Attributes")
    return found


def entries(thing: type | Callable, title: str) -> dict[str, str]:
    """Returns the texts under ``title:`` in a docstring by name; ``a, b: text`` describes both names."""
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
    except (OSError, TypeError):  # not made from a file
        return {}
    return dict(match.groups() for line in source.splitlines() if (match := _COMMENT.match(line)))  # type: ignore[misc]
