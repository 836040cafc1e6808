"""Operators, functions and methods of expressions. Results that may grow are checked before they do.

Arguments are always plain values (``budget.Value``), so no function ever receives another function or an object.
"""

import ast
import dataclasses
import math
import operator
import re
from collections.abc import Callable
from typing import Any

from mjx_nero.urdf.xacro.budget import MAX_BITS, MAX_SIZE, Fault, size

_MOST_DIGITS = 400  # digits that round() accepts, more than floats have
_MOST_KEY_BITS = 60  # longer numbers could be chosen with equal hashes, which makes a dictionary slow
_CONVERSION = re.compile(r"%(?:\(\w+\))?[-+ 0#]{0,5}\d{0,3}(?:\.\d{0,2})?[diouxXeEfFgGrs%]")  # excludes * as a width


@dataclasses.dataclass(frozen=True)
class Function:
    """A callable that a name can refer to."""

    call: Callable[..., Any]


def _bounded(length: int) -> None:
    if length > MAX_SIZE:
        raise Fault(f"a value of more than {MAX_SIZE:,} characters or items: make it smaller")


def _bits(count: int) -> None:
    if count > MAX_BITS:
        raise Fault(f"a number of more than {MAX_BITS} bits: correct it")


def _multiplied(left: Any, right: Any) -> Any:
    for items, count in ((left, right), (right, left)):
        if isinstance(items, str | list | tuple) and isinstance(count, int):
            _bounded(len(items) * max(count, 0))
    return left * right


def _power(base: Any, exponent: Any) -> Any:
    if isinstance(base, int) and isinstance(exponent, int) and abs(base) > 1:
        _bits(base.bit_length() * max(exponent, 0))
    return base**exponent


def _shifted(left: Any, right: Any) -> Any:
    if isinstance(left, int) and isinstance(right, int):
        _bits(left.bit_length() + right)
    return left << right


def _remainder(left: Any, right: Any) -> Any:
    if not isinstance(left, str):
        return left % right
    if "%" in _CONVERSION.sub("", left):
        raise Fault(f"the format {left[:60]!r} is not supported: widths up to 999 and the letters d i o u x e f g r s are")
    _bounded(len(left) + left.count("%") * (4 * size(right) + 1_000))
    return left % right


def _is(left: Any, right: Any) -> bool:
    return type(left) is type(right) and left == right  # Python's result for None, small numbers and words


OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: _multiplied,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: _remainder,
    ast.Pow: _power,
    ast.LShift: _shifted,
    ast.RShift: operator.rshift,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
    ast.BitXor: operator.xor,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Not: operator.not_,
    ast.Invert: operator.invert,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda item, items: item in items,
    ast.NotIn: lambda item, items: item not in items,
    ast.Is: _is,
    ast.IsNot: lambda left, right: not _is(left, right),
}


def dictionary(*pairs: Any, **named: Any) -> dict[Any, Any]:
    """Makes a ``dict`` whose keys cannot make it slow."""
    made = dict(*pairs, **named)
    for key in made:
        if not isinstance(key, str | float | None) and not (isinstance(key, int) and key.bit_length() <= _MOST_KEY_BITS):
            raise Fault(f"{str(key)[:60]} is no key: strings and numbers are")
    return made


def _range(*bounds: Any) -> list[int]:
    numbers = range(*bounds)
    _bounded(len(numbers))
    return list(numbers)


def _rounded(number: Any, ndigits: Any = None) -> Any:
    if ndigits is not None and abs(ndigits) > _MOST_DIGITS:
        raise Fault(f"round() to {str(ndigits)[:20]} digits: at most {_MOST_DIGITS}")
    return round(number, ndigits)


def _sum(items: Any, start: Any = 0) -> Any:
    if not all(isinstance(i, int | float) for i in (*items, start)):
        raise Fault("sum() takes numbers")
    return sum(items, start)


def tokens(text: Any, sep: Any = ",; ", skip_empty: Any = True) -> list[str]:
    """Splits ``text`` at any of the characters in ``sep``."""
    parts = text.translate(dict.fromkeys(map(ord, sep), sep[:1])).split(sep[:1])
    return [part for part in parts if part or not skip_empty]


def _message(*_: Any, **__: Any) -> str:
    return ""  # xacro prints these, but they are no notes about the import


def _fatal(*words: Any) -> str:
    raise Fault(f"the file says: {' '.join(map(str, words))}")


def _wrapped(functions: dict[str, Callable[..., Any]]) -> dict[str, Function]:
    return {name: Function(call) for name, call in functions.items()}


_MATH = (
    "acos acosh asin asinh atan atan2 atanh ceil copysign cos cosh degrees erf exp expm1 fabs floor fmod gcd hypot isclose "
    "isfinite isinf isnan log log10 log1p log2 pow radians sin sinh sqrt tan tanh trunc"
)
MATH = _wrapped({name: getattr(math, name) for name in _MATH.split()}) | {
    n: getattr(math, n) for n in ("pi", "e", "tau", "inf", "nan")
}
PYTHON = _wrapped(
    {
        **{f.__name__: f for f in (abs, all, any, bool, divmod, float, int, len, list, max, min, ord, sorted, str, tuple)},
        "dict": dictionary,
        "enumerate": lambda items, start=0: list(enumerate(items, start)),
        "range": _range,
        "reversed": lambda items: list(reversed(items)),
        "round": _rounded,
        "sum": _sum,
        "zip": lambda *items: list(zip(*items, strict=False)),
    }
)
XACRO = _wrapped(
    {
        **dict.fromkeys(("message", "warning", "error", "print_location"), _message),
        "dotify": lambda items: items,  # dictionaries support dots anyway
        "fatal": _fatal,
        "tokenize": tokens,
    }
)


def _joined(between: Any, items: Any) -> str:
    items = list(items)
    _bounded(len(between) * len(items) + sum(map(len, items)))
    return between.join(items)


def _replaced(text: Any, old: Any, new: Any, *count: Any) -> str:
    _bounded(len(text) + text.count(old) * len(new))
    return text.replace(old, new, *count)


_STR = (
    "capitalize casefold count endswith find index isalnum isalpha isdecimal isdigit islower isnumeric isspace isupper lower "
    "lstrip partition removeprefix removesuffix rfind rindex rpartition rsplit rstrip split splitlines startswith strip swapcase "
    "title upper"
)
METHODS: dict[type, dict[str, Callable[..., Any]]] = {
    str: {**{name: getattr(str, name) for name in _STR.split()}, "join": _joined, "replace": _replaced},
    list: {"count": list.count, "index": list.index, "copy": list.copy},
    tuple: {"count": tuple.count, "index": tuple.index},
    dict: {
        "copy": dict.copy,
        "get": dict.get,
        "items": lambda items: list(items.items()),
        "keys": lambda items: list(items.keys()),
        "values": lambda items: list(items.values()),
    },
}
