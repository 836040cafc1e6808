"""Frozen configs: dotted names, overrides with clear errors, JSON."""

import ast
import dataclasses
import difflib
import typing
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from mjx_nero.types import UserError

Cfg = TypeVar("Cfg")


def _children(node: Any) -> dict[str, Any] | None:
    if dataclasses.is_dataclass(node):
        return {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
    return dict(node) if isinstance(node, Mapping) else None


def flatten(cfg: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted name -> value of every field that can be overridden, in order."""
    out: dict[str, Any] = {}
    for name, value in (_children(cfg) or {}).items():
        if _children(value) is not None:
            out.update(flatten(value, f"{prefix}{name}."))
        elif not callable(value):
            out[prefix + name] = value
    return out


def to_dict(cfg: Any) -> Any:
    """Plain dicts, lists, numbers and strings (functions by name), ready for JSON."""
    children = _children(cfg)
    if children is not None:
        return {name: to_dict(value) for name, value in children.items()}
    if isinstance(cfg, tuple | list):
        return [to_dict(value) for value in cfg]
    return f"{cfg.__module__}.{cfg.__qualname__}" if callable(cfg) else cfg


def override(cfg: Cfg, changes: Mapping[str, Any]) -> Cfg:
    """A copy of ``cfg`` with fields changed by dotted name; strings are read as Python literals.

    Raises:
        UserError: no such field (the message names the nearest ones), or a value of another type.
    """
    for name, value in changes.items():
        cfg = _replace(cfg, name.split("."), value, name)
    return cfg


def hint(name: str, valid: Iterable[str]) -> str:
    """The nearest valid name, for the end of a message; empty if none is near."""
    near = difflib.get_close_matches(name, list(valid), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _replace(node: Any, path: list[str], value: Any, name: str) -> Any:
    head, *rest = path
    children = _children(node)
    if children is None or head not in children:
        valid = list(children or ())
        raise UserError(f"no field {name!r}: {head!r} is not one of {', '.join(valid) or 'no fields'}{hint(head, valid)}")
    old = children[head]
    if rest:
        new = _replace(old, rest, value, name)
    else:
        new = _coerce(old, value, name, any_length=head in _any_length(node))
    if dataclasses.is_dataclass(node):
        return dataclasses.replace(node, **{head: new})  # type: ignore[type-var]
    return {**children, head: new}


def _any_length(node: Any) -> set[str]:
    """Fields declared ``tuple[x, ...]``."""
    if not dataclasses.is_dataclass(node):
        return set()
    return {f.name for f in dataclasses.fields(node) if typing.get_args(f.type)[-1:] == (...,)}


def _coerce(old: Any, value: Any, name: str, any_length: bool = False) -> Any:
    """``value`` as the type of ``old``, the field's present value."""
    if _children(old) is not None and not isinstance(value, str):
        if type(value) is not type(old):
            raise UserError(f"{name} takes a {type(old).__name__}, got {value!r}")
        return value
    if isinstance(value, str) and not isinstance(old, str):
        try:
            value = ast.literal_eval(value.strip().capitalize() if value.strip().lower() in ("true", "false", "none") else value)
        except (ValueError, SyntaxError):
            raise UserError(f"{name} takes a value like {old!r}, got {value!r}") from None
    if isinstance(value, list):
        value = tuple(value)
    if isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if isinstance(old, tuple) and isinstance(value, tuple) and old and value and (any_length or len(value) == len(old)):
        like = old[:1] * len(value) if any_length else old
        return tuple(_coerce(o, v, name) for o, v in zip(like, value, strict=True))
    if old is not None and value is not None and (type(value) is not type(old) or isinstance(old, tuple)):
        raise UserError(f"{name} takes a value like {old!r}, got {value!r}")
    return value
