"""Frozen configs: dotted names, overrides with clear errors, JSON. ``bounds`` limits their values, ``values`` reads them, and
``docs`` finds their descriptions.

Flags are made from the configs themselves, without a command-line library, because the fields depend on the environment (its
terms, by name). The same names, readers and messages also serve ``make(**fields)`` and the files of robots.
"""

import copyreg
import dataclasses
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, TypeVar

from mjx_nero.config import bounds, docs
from mjx_nero.config.values import UNTYPED, hint, hints, read, short
from mjx_nero.errors import UserError

Cfg = TypeVar("Cfg")


def flag(default: Any, **about: Any) -> Any:
    """Declares a field of a frozen config for which programs have a flag (``cli.Parser.add_fields``).

    Args:
        about: marks that are kept with the field, for ``marked``.
    """
    return dataclasses.field(default=default, metadata={"flag": True, **about})


def marked(cls: type, mark: str = "flag") -> tuple[str, ...]:
    """Returns the names of a config's fields that have a mark."""
    return tuple(field.name for field in dataclasses.fields(cls) if field.metadata.get(mark))


def _children(node: Any) -> dict[str, Any] | None:
    if dataclasses.is_dataclass(node) and not isinstance(node, type):
        return {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
    return dict(node) if isinstance(node, Mapping) else None


def freeze(cfg: Any) -> None:
    """Replaces the mappings of a frozen config, nested ones included, by read-only copies; for its ``__post_init__``."""
    for field in dataclasses.fields(cfg):
        if isinstance(value := getattr(cfg, field.name), Mapping):
            object.__setattr__(cfg, field.name, _read_only(value))


def _read_only(value: Any) -> Any:
    return types.MappingProxyType({k: _read_only(v) for k, v in value.items()}) if isinstance(value, Mapping) else value


copyreg.pickle(
    types.MappingProxyType, lambda value: (_read_only, (dict(value),))
)  # otherwise configs could not be copied or sent


def flatten(cfg: Any, prefix: str = "") -> dict[str, Any]:
    """Returns the values of all fields that can be overridden, by dotted name, in order."""
    out: dict[str, Any] = {}
    for name, value in (_children(cfg) or {}).items():
        if _children(value) is not None:
            out.update(flatten(value, f"{prefix}{name}."))
        elif not callable(value):
            out[prefix + name] = value
    return out


def to_dict(cfg: Any) -> Any:
    """Converts a config to plain dicts, lists, numbers and strings (functions by name), ready for JSON."""
    children = _children(cfg)
    if children is not None:
        return {name: to_dict(value) for name, value in children.items()}
    if isinstance(cfg, tuple | list):
        return [to_dict(value) for value in cfg]
    function = bounds.unwrapped(cfg)
    return f"{function.__module__}.{function.__qualname__}" if callable(cfg) else cfg


def describe(cfg: Any) -> dict[str, str]:
    """Returns the descriptions of all fields that ``flatten`` lists, by dotted name; empty if a field has none.

    A field's description comes from ``Attributes:`` in the docstring of its config's class, or from the comment behind the field.
    A term's parameter is described as a field of the term's class, under ``Args:`` in the docstring of its function, or else by
    the first line of that docstring.
    """
    return dict(_described(cfg, "", docs.fields(type(cfg)), ""))


def _described(node: Any, prefix: str, texts: Mapping[str, str], inherited: str) -> Iterator[tuple[str, str]]:
    """Yields (dotted name, description) of the fields in ``node``.

    Args:
        texts: descriptions of the entries of ``node``, by name.
        inherited: description for entries that ``texts`` lacks: that of the field that holds ``node``.
    """
    for name, value in (_children(node) or {}).items():
        text = texts.get(name, inherited)
        if _children(value) is None:
            if not callable(value):
                yield prefix + name, text
        elif name == "params" and callable(func := getattr(node, "func", None)):
            own = docs.fields(func) if isinstance(func, type) else docs.entries(func, "Args")
            yield from _described(value, f"{prefix}{name}.", own, f"parameter of: {docs.summary(func)}")
        elif dataclasses.is_dataclass(value):
            yield from _described(value, f"{prefix}{name}.", docs.fields(type(value)), "")
        else:
            yield from _described(value, f"{prefix}{name}.", {}, text)


def override(cfg: Cfg, changes: Mapping[str, Any]) -> Cfg:
    """Returns a copy of ``cfg`` with fields changed by dotted name (former names work, too); ``read`` reads their values.

    Raises:
        UserError: a field does not exist (the message names the valid ones), or a value has the wrong type.
    """
    for name, value in current(cfg, changes).items():
        cfg = _replace(cfg, type(cfg), name.split("."), value, name)
    return cfg


def current(cfg: Any, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Returns fields by their present dotted names. A config with renamed fields has a method ``current``."""
    return cfg.current(fields) if hasattr(cfg, "current") else dict(fields)


def _replace(node: Any, kind: Any, path: list[str], value: Any, name: str) -> Any:
    head, *rest = path
    children = _children(node)
    if children and ".".join(path) in children:  # an entry of ``training`` is itself a dotted name
        head, rest = ".".join(path), []
    if children is None or head not in children:
        valid = list(children or ())
        raise UserError(
            f"no field {short(name)}: {short(head)} is not one of {', '.join(valid) or 'no fields'}{hint(head, valid)}"
        )
    old, kind = children[head], _kind(node, kind, head, children[head])
    if rest:
        new = _replace(old, kind, rest, value, name)
    elif dataclasses.is_dataclass(old) and not isinstance(value, type(old)):
        raise UserError(
            f"{name} takes {type(old).__name__}: pass one, or set its fields singly ({name}.{next(iter(hints(type(old))))})"
        )
    else:
        new = read(kind, value, name)
    if dataclasses.is_dataclass(node):
        return dataclasses.replace(node, **{head: new})  # type: ignore[type-var]
    return {**children, head: new}


def _kind(node: Any, kind: Any, name: str, old: Any) -> Any:
    """Returns the declared type of an entry of ``node``, which has type ``kind``, or else the type of its present value."""
    found: Any = Any
    if dataclasses.is_dataclass(node):
        found = hints(type(node))[name]
        if name == "params" and callable(func := getattr(node, "func", None)):
            return parameters(func)  # a term's parameters have the types that its function declares
    elif isinstance(kind, dict):
        found = kind.get(name, Any)
    elif isinstance(origin := typing.get_origin(kind), type) and issubclass(origin, Mapping):
        found = typing.get_args(kind)[1]
    return _kind_of(old) if found in UNTYPED else found


def parameters(func: Callable) -> dict[str, Any]:
    """Returns the declared types of a function's parameters by name, for the types that ``read`` can read."""
    return {
        name: kind
        for name, kind in bounds.parameter_hints(func).items()
        if kind in (float, int, bool, str) or typing.get_origin(kind) in (tuple, Annotated)
    }


def _kind_of(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple[tuple(_kind_of(item) for item in value)] if value else tuple[Any, ...]  # type: ignore[misc]
    return type(value) if isinstance(value, float | int | str) or dataclasses.is_dataclass(value) else Any
