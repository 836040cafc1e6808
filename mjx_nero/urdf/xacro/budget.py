"""What a file may cost: sizes of values, and how much of everything an expansion may use up."""

from typing import Any

MAX_SIZE = 100_000  # characters and items of one value, those of its items among them
MAX_BITS = 1_024  # of a whole number: as far as floats go
MAX_NESTING = 30  # of lists and dictionaries in one another
LIMITS = {
    "evaluation steps": 500_000,
    "expanded elements": 50_000,
    "characters of text": 20_000_000,
    "included files": 1_000,
    "included bytes": 20_000_000,
}

Value = bool | int | float | str | list[Any] | tuple[Any, ...] | dict[Any, Any] | None


class Fault(Exception):
    """What is wrong, and in which expression; the expander adds the construct and where it stands."""

    def __init__(self, message: str, expression: str = ""):
        super().__init__(f"{expression!r}: {message}" if expression else message)
        self.message = message
        self.expression = expression


class Budget:
    """How much is left of each of ``LIMITS``."""

    def __init__(self) -> None:
        self._left = dict(LIMITS)

    def spend(self, what: str, amount: int = 1) -> None:
        """Raises Fault: the limit is passed."""
        self._left[what] -= amount
        if self._left[what] < 0:
            raise Fault(f"the file asks for more than {LIMITS[what]:,} {what}: no robot needs that; does it repeat itself?")

    def checked(self, value: Any) -> Value:
        """``value``, if it is plain and small.

        Raises:
            Fault: it is too large, nested too deep, or something else than numbers, strings, lists and dictionaries of these.
        """
        self.spend("evaluation steps", 1 + size(value) // 16)
        return value


def size(value: Any) -> int:
    """Characters and items of a plain value, counted as often as they occur.

    Raises:
        Fault: as ``Budget.checked``.
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
