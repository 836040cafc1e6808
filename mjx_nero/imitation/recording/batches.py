"""Callers in several threads, served together: a GPU does much at once in hardly more time than a little."""

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
    """Calls a function of rows with the rows of all callers that wait.

    Whoever gets the lock works for all that wait, and lets go of it before the results have come to the host: the device does
    the next batch meanwhile.

    Args:
        function: arrays [rows, ...] in any tree -> an array [rows, ...] of JAX. One call runs at a time, whatever functions there
            are: a first call may capture a graph, which nothing else on the device may disturb.
        sizes: rows that it may be called with, ascending; each is a program of its own. No caller has more rows than the last.
    """

    _lock = threading.Lock()

    def __init__(self, function: Callable[[Any], jax.Array], sizes: Sequence[int]):
        self._function, self._sizes = function, tuple(sizes)
        self._waiting: collections.deque[_Asked] = collections.deque()

    def __call__(self, given: Any) -> np.ndarray:
        """The results of ``given``, arrays [rows, ...] in a tree. Any thread may call it."""
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
        """The callers that one batch has room for. Each caller takes after it has asked, so none is left."""
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
