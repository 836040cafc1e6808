"""Serves callers in several threads together, because a GPU takes hardly longer for a large batch than for a small one."""

import collections
import dataclasses
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class _Asked:
    given: Any
    rows: int
    done: Future[np.ndarray] = dataclasses.field(default_factory=Future)


class Batches:
    """Calls a function of rows once for all waiting callers.

    The caller that gets the lock works for all that wait. It releases the lock before the results are on the host, so that the
    device can compute the next batch meanwhile.

    Args:
        function: arrays [rows, ...] in any tree -> a JAX array [rows, ...]. Only one call of any such function runs at a time,
            because a first call may capture a graph, which nothing else on the device may disturb.
        sizes: numbers of rows that it may be called with, ascending; each is a separate program. No caller may have more rows
            than the last.
    """

    _lock = threading.Lock()

    def __init__(self, function: Callable[[Any], jax.Array], sizes: Sequence[int]):
        self._function, self._sizes = function, tuple(sizes)
        self._waiting: collections.deque[_Asked] = collections.deque()

    def __call__(self, given: Any) -> np.ndarray:
        """Returns the results for ``given``, arrays [rows, ...] in a tree. Any thread may call it."""
        mine = _Asked(given, len(jax.tree.leaves(given)[0]))
        self._waiting.append(mine)
        with self._lock:
            served = self._take()
            try:
                found: Any = self._work(served) if served else None
            except Exception as error:
                found = error
        self._hand_out(served, found)
        return mine.done.result()

    def _take(self) -> list[_Asked]:
        """Takes as many waiting callers as fit in one batch. Every caller takes after it has queued, so none is left over."""
        served, rows = list[_Asked](), 0
        while self._waiting and rows + self._waiting[0].rows <= self._sizes[-1]:
            served.append(self._waiting.popleft())
            rows += served[-1].rows
        return served

    def _work(self, served: Sequence[_Asked]) -> jax.Array:
        rows = sum(each.rows for each in served)
        size = next(size for size in self._sizes if size >= rows)
        filled = np.minimum(np.arange(size), rows - 1)
        together = jax.tree.map(lambda *x: np.concatenate(x)[filled], *(each.given for each in served))
        return jax.block_until_ready(self._function(together))

    def _hand_out(self, served: Sequence[_Asked], found: Any) -> None:
        try:
            if isinstance(found, Exception):
                raise found
            results = np.asarray(found)
        except Exception as error:
            for each in served:
                each.done.set_exception(error)
            return
        first = 0
        for each in served:
            each.done.set_result(results[first : first + each.rows])
            first += each.rows
