"""The intervals that the start of a run is made of, some of them side by side."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple


class Span(NamedTuple):
    """A named interval [s] since the first of its ``Spans`` began."""

    name: str
    begun: float
    seconds: float


class Spans:
    """Records intervals; threads may do so at once."""

    def __init__(self) -> None:
        self._zero = time.perf_counter()
        self.found: list[Span] = []

    @contextlib.contextmanager
    def span(self, name: str) -> Iterator[None]:
        """Records how long its body takes."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.found.append(Span(name, begun - self._zero, time.perf_counter() - begun))

    def timed(self, name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """Returns ``work``, each call of which is recorded."""

        def recorded(*args: Any) -> Any:
            with self.span(name):
                return work(*args)

        return recorded
