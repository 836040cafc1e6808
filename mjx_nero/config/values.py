"""Reads values as the types that fields declare, and formats values for messages.

``read`` is the one reader for command lines, YAML files and Python. The other functions help to say what was wrong.
"""

import collections.abc
import dataclasses
import difflib
import numbers
import re
import reprlib
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from mjx_nero.errors import UserError

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")  # Python's 1_0 and 0x10 are usually typing errors
_FINITE = 1e30  # larger numbers overflow single precision when squared
_WORDS = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a name"}
UNTYPED = (Any, object)
_DEEPEST = 8  # maximum depth of nested lists in a text


def hint(name: str, valid: Iterable[str]) -> str:
    """Suggests the nearest valid name, for the end of a message; empty if none is near."""
    near = difflib.get_close_matches(name[:100], list(valid), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def choices(name: str, valid: Iterable[str], most: int = 30) -> str:
    """Lists the valid names, for the end of a message; if there are more than ``most``, only the nearest."""
    names = list(valid)
    if len(names) <= most:
        return f"choose one of {', '.join(names)}"
    near = difflib.get_close_matches(name[:100], names, n=6, cutoff=0.0)
    return f"choose one of {len(names)}, such as {', '.join(near)}"


def short(value: Any) -> str:
    """Formats a value for a message as one short line, however large the value is."""
    cut = reprlib.Repr()
    cut.maxlevel, cut.maxstring, cut.maxlong, cut.maxother = 2, 60, 40, 60
    try:
        text = cut.repr(value)
    except ValueError:  # Python does not print whole numbers of more than some thousand digits
        return f"{type(value).__name__} too long to show"
    text = " ".join(text.split()) if "\n" in text else text  # of arrays
    return text if len(text) <= 80 else f"{text[:77]}..."


def read(kind: Any, value: Any, name: str) -> Any:
    """Reads ``value`` as the annotation ``kind``.

    Numbers must be finite. If the type is not text, a text is parsed: ``"0.5"``, ``"true"``, ``"none"``, ``"(1, 2)"``.

    Args:
        kind: ``float``, ``int``, ``bool``, ``str``, a number with ``bounds``, a tuple, a mapping, a dataclass, ``X | None``, ...
        name: the field's name, for messages.

    Raises:
        UserError: the value does not fit; the message says which part, and what it takes.
    """
    origin: Any = typing.get_origin(kind) or kind
    args = typing.get_args(kind)
    if origin is Annotated:
        found = read(args[0], value, name)
        for bound in args[1:]:
            if fault := bound.fault(found):
                raise UserError(f"{name} {fault}, got {short(value)}")
        return found
    if origin in (typing.Union, types.UnionType):
        return _read_union(args, value, name)
    if isinstance(origin, type) and dataclasses.is_dataclass(origin):
        return value if isinstance(value, origin) else _read_group(origin, value, name)
    if origin is tuple:
        return _read_tuple(args, value, name)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            _refuse(name, "an entry 'name: value'", value)
        return {key: read((args or (str, Any))[1], item, f"{name}.{short(key)[1:-1]}") for key, item in value.items()}
    if origin is collections.abc.Callable:
        return value if callable(value) else _refuse(name, "a function", value)
    if origin in UNTYPED:
        return _literal(value)
    found = {float: _float, int: _int, bool: _bool}.get(origin, lambda x: x if isinstance(x, origin) else None)(value)
    return _refuse(name, _WORDS.get(origin, f"a {getattr(origin, '__name__', origin)}"), value) if found is None else found


def unknown(kind: str, name: object, valid: Iterable[str]) -> str:
    """Returns the message that there is no such ``kind``, with the nearest and all valid names."""
    valid = list(valid)
    return f"no {kind} {short(str(name))}{hint(str(name), valid)}; valid: {', '.join(valid)}"


def _refuse(name: str, wanted: str, value: Any) -> typing.NoReturn:
    raise UserError(f"{name} takes {wanted}, got {short(value)}")


def _read_union(kinds: tuple[Any, ...], value: Any, name: str) -> Any:
    if types.NoneType in kinds and (value is None or isinstance(value, str) and value.strip().lower() == "none"):
        return None
    *others, last = [kind for kind in kinds if kind is not types.NoneType]
    for kind in others:
        try:
            return read(kind, value, name)
        except UserError:
            continue
    return read(last, value, name)


def _read_tuple(kinds: tuple[Any, ...], value: Any, name: str) -> tuple:
    items = _parts(value) if isinstance(value, str) else value
    size = None if kinds[-1:] == (...,) else len(kinds)
    if not isinstance(items, tuple | list) or size not in (None, len(items)):
        numbers_only = all(
            getattr(kind, "__origin__", kind) in (float, int) for kind in kinds
        )  # __origin__: the type inside Annotated
        _refuse(name, "a list" if size is None else f"a list of {size} {'numbers' if numbers_only else 'entries'}", value)
    wanted = kinds[:1] * len(items) if size is None else kinds
    return tuple(read(kind, item, f"{name}[{i}]") for i, (kind, item) in enumerate(zip(wanted, items, strict=True)))


def _read_group(cls: Any, value: Any, name: str) -> Any:
    where, prefix = name or "the file", f"{name}." if name else ""
    if not isinstance(value, Mapping):
        _refuse(where, "entries 'key: value'", value)
    kinds = hints(cls)
    for key in value:
        if key not in kinds:
            raise UserError(f"{prefix}{short(str(key))[1:-1]}: {unknown('key', key, kinds)}")
    for field in dataclasses.fields(cls):
        if field.default is field.default_factory is dataclasses.MISSING and field.name not in value:
            raise UserError(f"{prefix}{field.name} is missing; {where} takes: {', '.join(kinds)}")
    return cls(**{key: read(kinds[key], item, prefix + key) for key, item in value.items()})


def hints(cls: Any) -> dict[str, Any]:
    """Returns the declared types of a dataclass's fields by name."""
    found = typing.get_type_hints(cls, include_extras=True)
    return {field.name: found[field.name] for field in dataclasses.fields(cls)}


def _float(value: Any) -> float | None:
    if isinstance(value, str):
        value = float(value) if _NUMBER.fullmatch(value.strip()) else None
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return None
    return float(value) if bool(-_FINITE < value < _FINITE) else None  # type: ignore[operator]  # False for NaN


def _int(value: Any) -> int | None:
    if isinstance(value, str):
        text = value.strip()
        value = int(text) if re.fullmatch(r"[-+]?\d{1,18}", text) else _float(text)  # 1e6 is a whole number, too
        value = int(value) if isinstance(value, float) and value.is_integer() else value
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        return None
    return int(value) if abs(int(value)) < 2**63 else None


def _bool(value: Any) -> bool | None:
    if isinstance(value, str):
        return {"true": True, "false": False}.get(value.strip().lower())
    return value if isinstance(value, bool) else None


def _literal(value: Any, depth: int = 0) -> Any:
    """Parses a text whose type is not declared: none, true, false, a number, a list, or the text itself."""
    if not isinstance(value, str) or depth > _DEEPEST:
        return value
    text = value.strip()
    if text.lower() == "none":
        return None
    for reader in (_bool, _int, _float):
        if (found := reader(text)) is not None:
            return found
    parts = _parts(text) if text[:1] in ("(", "[") else None
    return value if parts is None else tuple(_literal(part, depth + 1) for part in parts)


def _parts(text: str) -> list[str] | None:
    """Splits a list: ``"(1, 2), 3"`` -> ``["(1, 2)", "3"]``. Brackets around the whole and quotes around parts are optional.

    Returns:
        the parts; None if brackets do not match.
    """
    text, depth, parts, begin = text.strip(), 0, [], 0
    for at, letter in enumerate(f"{text},"):
        depth += (letter in "([") - (letter in ")]")
        if depth < 0:
            return None
        if letter == "," and depth == 0:
            parts.append(text[begin:at].strip())
            begin = at + 1
    if depth:
        return None
    if len(parts) == 1 and text[:1] in ("(", "["):
        return _parts(f"{text[1:-1].rstrip().removesuffix(',')},") if text[1:-1].strip() else []
    parts = parts[:-1] if parts and not parts[-1] else parts  # a trailing comma is allowed
    return [part[1:-1] if part[:1] in ("'", '"') and part[-1:] == part[:1] else part for part in parts]
