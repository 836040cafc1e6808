"""Limits on what a file may cost: sizes of values, and the total work of an expansion."""

from typing import Any

MAX_SIZE = 100_000  # characters and items of one value, including nested ones
MAX_BITS = 1_024  # bits of a whole number, the range of floats
MAX_NESTING = 30  # nested lists and dictionaries
LIMITS = {
    "evaluation steps": 500_000,
    "expanded elements": 50_000,
    "characters of text": 20_000_000,
    "included files": 1_000,
    "included bytes": 20_000_000,
}

Value = bool | int | float | str | list[Any] | tuple[Any, ...] | dict[Any, Any] | None


class Fault(Exception):
    """An error, and the expression in which it occurs. The expander adds the construct and its place."""

    def __init__(self, message: str, expression: str = ""):
        super().__init__(f"{expression!r}: {message}" if expression else message)
        self.message = message
        self.expression = expression


class Budget:
    """Tracks what is left of each of ``LIMITS``."""

    def __init__(self) -> None:
        self._left = dict(LIMITS)

    def spend(self, what: str, amount: int = 1) -> None:
        """Uses up part of a limit; raises Fault if it is exceeded."""
        self._left[what] -= amount
        if self._left[what] < 0:
            raise Fault(f"the file asks for more than {LIMITS[what]:,} {what}: no robot needs that; does it repeat itself?")

    def checked(self, value: Any) -> Value:
        """Returns ``value`` if it is plain and small.

        Raises:
            Fault: it is too large or nested too deep, or holds anything but numbers, strings, lists and dictionaries.
        """
        self.spend("evaluation steps", 1 + size(value) // 16)
        return value


def size(value: Any) -> int:
    """Counts the characters and items of a plain value, as often as they occur.

    Raises:
        Fault: the value is too large or not plain (see ``Budget.checked``).
    """
    total = 0
    stack: list[tuple[Any, int]] = [(value, 0)]
    while stack:
        item, depth = stack.pop()
        kind: type = type(item)
        inner: list[Any] | tuple[Any, ...] = ()
        if kind is str:
            total += len(item)
        elif kind is list or kind is tuple:
            inner = item
        elif kind is dict:
            inner = (*item.keys(), *item.values())
        elif kind is int:
            if item.bit_length() > MAX_BITS:
                raise Fault(f"a number of more than {MAX_BITS} bits: correct it")
        elif kind is not float and kind is not bool and item is not None:
            raise Fault(f"{kind.__name__.lower()} is not a value: only numbers, strings, lists and dictionaries are")
        total += 1 + len(inner)
        if total > MAX_SIZE:
            raise Fault(f"a value of more than {MAX_SIZE:,} characters or items: make it smaller")
        if depth > MAX_NESTING:
            raise Fault(f"lists nested more than {MAX_NESTING} deep: make them flatter")
        stack.extend((i, depth + 1) for i in inner)
    return total
