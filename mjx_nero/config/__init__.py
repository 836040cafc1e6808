"""Frozen configs: dotted names, overrides with clear errors, JSON. ``bounds`` says what values are possible, ``values`` reads
them, ``docs`` finds what is written about them.

Flags are made from the configs themselves, and not by a library for command lines: which there are depends on the environment
(its terms, by name), and one set of names, readers and messages serves ``make(**fields)`` and the files of robots too.
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
    """A field of a frozen config that programs have a flag for (``cli.Parser.add_fields``).

    Args:
        about: kept with the field, for ``marked``.
    """
    return dataclasses.field(default=default, metadata={"flag": True, **about})


def marked(cls: type, mark: str = "flag") -> tuple[str, ...]:
    """Names of the fields of a config that bear a mark."""
    return tuple(field.name for field in dataclasses.fields(cls) if field.metadata.get(mark))


def _children(node: Any) -> dict[str, Any] | None:
    if dataclasses.is_dataclass(node) and not isinstance(node, type):
        return {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
    return dict(node) if isinstance(node, Mapping) else None


def freeze(cfg: Any) -> None:
    """Makes the mappings of a frozen config read-only copies, those within them, too; for its ``__post_init__``."""
    for field in dataclasses.fields(cfg):
        if isinstance(value := getattr(cfg, field.name), Mapping):
            object.__setattr__(cfg, field.name, _read_only(value))


def _read_only(value: Any) -> Any:
    return types.MappingProxyType({k: _read_only(v) for k, v in value.items()}) if isinstance(value, Mapping) else value


copyreg.pickle(types.MappingProxyType, lambda value: (_read_only, (dict(value),)))  # else no config could be copied or sent


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
    function = bounds.unwrapped(cfg)
    return f"{function.__module__}.{function.__qualname__}" if callable(cfg) else cfg


def describe(cfg: Any) -> dict[str, str]:
    """Dotted name -> what the field is, of every field that ``flatten`` lists; empty where its class does not say.

    From the lines under ``Attributes:`` in the docstring of a config's class, or the comment behind the field; of a term's
    parameter from the lines under ``Args:`` in its function's docstring, else from that docstring's first line.
    """
    return dict(_described(cfg, "", docs.fields(type(cfg)), ""))


def _described(node: Any, prefix: str, texts: Mapping[str, str], inherited: str) -> Iterator[tuple[str, str]]:
    """
    Args:
        texts: of the entries of ``node``, by name.
        inherited: what the field is that holds ``node``, where ``texts`` lacks an entry.
    """
    for name, value in (_children(node) or {}).items():
        text = texts.get(name, inherited)
        if _children(value) is None:
            if not callable(value):
                yield prefix + name, text
        elif name == "params" and callable(func := getattr(node, "func", None)):
            yield from _described(value, f"{prefix}{name}.", docs.entries(func, "Args"), f"of {docs.summary(func)}")
        elif dataclasses.is_dataclass(value):
            yield from _described(value, f"{prefix}{name}.", docs.fields(type(value)), "")
        else:
            yield from _described(value, f"{prefix}{name}.", {}, text)


def override(cfg: Cfg, changes: Mapping[str, Any]) -> Cfg:
    """A copy of ``cfg`` with fields changed by dotted name, old names included; values are read as ``read`` does.

    Raises:
        UserError: no such field (the message names the nearest ones), or a value of another type.
    """
    for name, value in current(cfg, changes).items():
        cfg = _replace(cfg, type(cfg), name.split("."), value, name)
    return cfg


def current(cfg: Any, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields by the dotted names that they have now: a config whose fields once had others has a method ``current``."""
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
            f"{name} takes {type(old).__name__}, or set its fields one by one ({name}.{next(iter(hints(type(old))))})"
        )
    else:
        new = read(kind, value, name)
    if dataclasses.is_dataclass(node):
        return dataclasses.replace(node, **{head: new})  # type: ignore[type-var]
    return {**children, head: new}


def _kind(node: Any, kind: Any, name: str, old: Any) -> Any:
    """The declared type of an entry of ``node``, itself of ``kind``; of its present value where nothing is declared."""
    found: Any = Any
    if dataclasses.is_dataclass(node):
        found = hints(type(node))[name]
        if name == "params" and callable(func := getattr(node, "func", None)):
            return parameters(func)  # of a term: what its function declares
    elif isinstance(kind, dict):
        found = kind.get(name, Any)
    elif isinstance(origin := typing.get_origin(kind), type) and issubclass(origin, Mapping):
        found = typing.get_args(kind)[1]
    return _kind_of(old) if found in UNTYPED else found


def parameters(func: Callable) -> dict[str, Any]:
    """Name -> declared type of a function's parameters, of those that can be read."""
    try:
        found = typing.get_type_hints(bounds.unwrapped(func), include_extras=True)
    except (TypeError, NameError, SyntaxError, AttributeError):  # no function, or annotations that are none
        return {}
    return {
        name: kind
        for name, kind in found.items()
        if kind in (float, int, bool, str) or typing.get_origin(kind) in (tuple, Annotated)
    }


def _kind_of(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple[tuple(_kind_of(item) for item in value)] if value else tuple[Any, ...]  # type: ignore[misc]
    return type(value) if isinstance(value, float | int | str) or dataclasses.is_dataclass(value) else Any
