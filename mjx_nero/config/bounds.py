"""Bounds of values, declared with a config's field or a term's parameter (``dt: Positive``), and one check for all of them."""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping
from typing import Annotated, Any

from mjx_nero.errors import UserError

Number = int | float


@dataclasses.dataclass(frozen=True)
class Bounds:
    """A range from ``low`` to ``high``; ``above`` excludes ``low`` itself."""

    low: Number = -math.inf
    high: Number = math.inf
    above: bool = False

    def fault(self, value: Number) -> str:
        """Describes what is wrong with a value; empty if nothing is."""
        if self.low < value <= self.high or value == self.low and not self.above:
            return ""
        low = f"above {_text(self.low)}" if self.above else f"at least {_text(self.low)}"
        return f"must be {low}" + (f" and at most {_text(self.high)}" if self.high < math.inf else "")


def _text(bound: Number) -> str:
    """Formats a bound for a message, with whole numbers in full."""
    return f"{bound}" if isinstance(bound, int) else f"{bound:g}"


@dataclasses.dataclass(frozen=True)
class Ascending:
    """Two numbers, the lower first."""

    def fault(self, value: tuple[Number, Number]) -> str:
        """See ``Bounds.fault``."""
        return "" if value[0] <= value[1] else "is a range and must run from low to high"


@dataclasses.dataclass(frozen=True, init=False)
class OneOf:
    """One of some names or numbers."""

    names: tuple[str | int, ...]

    def __init__(self, *names: str | int):
        object.__setattr__(self, "names", names)

    def fault(self, value: str | int) -> str:
        """See ``Bounds.fault``."""
        return "" if value in self.names else f"must be one of {', '.join(map(str, self.names))}"


Positive = Annotated[float, Bounds(0.0, above=True)]
NonNegative = Annotated[float, Bounds(0.0)]
Share = Annotated[float, Bounds(0.0, 1.0)]
Count = Annotated[int, Bounds(1)]
Whole = Annotated[int, Bounds(0)]
Range = Annotated[tuple[float, float], Ascending()]
# What an arm on a table can have to do with. Beyond it, a value is a slip of the hand or of the unit.
Place = Annotated[float, Bounds(-20.0, 20.0)]  # a coordinate [m]
Places = Annotated[tuple[Place, Place], Ascending()]
Point = tuple[Place, Place, Place]
Length = Annotated[float, Bounds(0.0, 20.0, above=True)]  # of what stands in a scene [m]
Gap = Annotated[float, Bounds(0.0, 20.0)]  # a length that may be zero [m]
Edge = Annotated[float, Bounds(0.0, 2.0, above=True)]  # of an object that a robot moves [m]
Mass = Annotated[float, Bounds(0.0, 1000.0, above=True)]  # [kg]
Density = Annotated[float, Bounds(0.0, 25_000.0)]  # [kg/m3]: that of osmium is 22,600
NonNegativeRange = Annotated[tuple[NonNegative, NonNegative], Ascending()]
PositiveRange = Annotated[tuple[Positive, Positive], Ascending()]
Counts = Annotated[tuple[Count, Count], Ascending()]  # a range of whole numbers from 1
LATEST = 256  # maximum control steps of a delay or history, because every environment has a buffer of that length
Step = Annotated[int, Bounds(0, LATEST)]
Steps = Annotated[tuple[Step, Step], Ascending()]  # a range of whole steps
Past = Annotated[int, Bounds(1, LATEST)]  # number of last values
Worlds = Annotated[int, Bounds(1, 2**24)]  # environments stepped together
Seed = Annotated[int, Bounds(0, 2**32 - 1)]  # the range of JAX's generators: larger seeds would repeat


_PLAIN, _BY_KEY = (int, float, str, type(None)), (dict, types.MappingProxyType)


def check(value: Any, hint: Any = Any, name: str = "") -> None:
    """Checks that every number in a config is finite and within the bounds that its field declares.

    Args:
        value: a config, or a field's value.
        hint: the field's type; for a mapping it may be types by key.
        name: the field's dotted name.

    Raises:
        UserError: a value is not; the message has its dotted name.
    """
    # A loop: a task has 700 values, and all are checked whenever one of them is replaced.
    waiting: list[tuple[Any, Any, str]] = [(value, hint, name)]
    while waiting:
        value, hint, name = waiting.pop()
        if isinstance(hint, tuple):  # the bounds of what has been checked inside
            for bound in hint:
                if isinstance(bound, Bounds) and bound.low < value < bound.high:
                    continue  # as nearly all are
                if fault := bound.fault(value):
                    raise UserError(f"{name} {fault}, got {value!r}")
            continue
        if isinstance(value, float) and not math.isfinite(value):
            raise UserError(f"{name} must be a finite number, got {value!r}")
        by_key = isinstance(hint, _BY_KEY)
        optional, bounds, inner = (False, (), ()) if by_key else _parts(hint)
        if bounds and not (optional and value is None):
            waiting.append((value, bounds, name))
        if isinstance(value, _PLAIN):
            continue
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            hints = {**_hints(type(value)), **getattr(value, "hints", dict)()}
            start = f"{name}." if name else ""
            parts = [(getattr(value, f), hints.get(f, Any), start + f) for f in _names(type(value))]
        elif isinstance(value, Mapping):
            named = hint if by_key else dict.fromkeys(value, (*inner, Any, Any)[1])
            parts = [(item, named.get(key, Any), f"{name}.{key}") for key, item in value.items()]
        elif isinstance(value, tuple):
            each = inner[:1] * len(value) if inner[1:] == (...,) else inner if len(inner) == len(value) else (Any,) * len(value)
            parts = [(item, one, name) for item, one in zip(value, each, strict=True)]
        else:
            continue
        waiting += reversed(parts)


@functools.cache
def _names(kind: type) -> tuple[str, ...]:
    """Names of a config's fields."""
    return tuple(field.name for field in dataclasses.fields(kind))


@functools.cache
def _parts(hint: Any) -> tuple[bool, tuple, tuple]:
    """Whether a type may be None as well, its bounds, and the types within it."""
    optional = isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
    if optional:
        hint = next((h for h in typing.get_args(hint) if h is not type(None)), Any)
    bounds: tuple = ()
    if typing.get_origin(hint) is Annotated:
        bounds, hint = hint.__metadata__, typing.get_args(hint)[0]
    return optional, bounds, typing.get_args(hint)


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    """Returns the annotations of a config or of a function's parameters; empty if they cannot be resolved."""
    try:
        return typing.get_type_hints(kind, include_extras=True)
    except (TypeError, NameError, SyntaxError, AttributeError):  # not a function, or invalid annotations
        return {}


def unwrapped(function: Any) -> Any:
    """Returns the function inside a ``functools.partial``; returns other functions unchanged."""
    while isinstance(function, functools.partial):
        function = function.func
    return function


def parameter_hints(function: Any) -> dict[str, Any]:
    """Returns the annotations of a function's parameters, or of a class's fields."""
    return _hints(unwrapped(function))
