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


def parts(found: jax.Array, counts: Sequence[int]) -> list[np.ndarray]:
    """Splits rows on the host: the first count of them, the next count, and so on."""
    return np.split(np.asarray(found)[: sum(counts)], np.cumsum(counts)[:-1])


class Batches:
    """Calls a function of rows once for all waiting callers. The caller that gets the lock works for all that wait.

    Args:
        function: arrays [rows, ...] in any tree -> a JAX array [rows, ...]. Only one call of any such function runs at a time,
            because a first call may capture a graph, which nothing else on the device may disturb.
        sizes: numbers of rows that it may be called with, ascending; each is a separate program. No caller may have more rows
            than the last.
        fetch: brings the callers' rows to the host, as ``parts`` does; under the same lock.
    """

    _lock = threading.Lock()

    def __init__(
        self,
        function: Callable[[Any], jax.Array],
        sizes: Sequence[int],
        fetch: Callable[[jax.Array, Sequence[int]], list[np.ndarray]] = parts,
    ):
        self._function, self._sizes, self._fetch = function, tuple(sizes), fetch
        self._waiting: collections.deque[_Asked] = collections.deque()

    def __call__(self, given: Any) -> np.ndarray:
        """Returns the results for ``given``, arrays [rows, ...] in a tree. Any thread may call it."""
        mine = _Asked(given, len(jax.tree.leaves(given)[0]))
        self._waiting.append(mine)
        with self._lock:
            if served := self._take():
                self._serve(served)
        return mine.done.result()

    def _take(self) -> list[_Asked]:
        """Takes as many waiting callers as fit in one batch. Every caller takes after it has queued, so none is left over."""
        served, rows = list[_Asked](), 0
        while self._waiting and rows + self._waiting[0].rows <= self._sizes[-1]:
            served.append(self._waiting.popleft())
            rows += served[-1].rows
        return served

    def _serve(self, served: Sequence[_Asked]) -> None:
        counts = [each.rows for each in served]
        try:
            size = next(size for size in self._sizes if size >= sum(counts))
            filled = np.minimum(np.arange(size), sum(counts) - 1)
            together = jax.tree.map(lambda *x: np.concatenate(x)[filled], *(each.given for each in served))
            found = self._fetch(jax.block_until_ready(self._function(together)), counts)
        except Exception as error:
            for each in served:
                each.done.set_exception(error)
        else:
            for each, rows in zip(served, found, strict=True):
                each.done.set_result(rows)
