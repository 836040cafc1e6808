"""Orders of pages, carried out one after another."""

import threading
from collections.abc import Callable, Hashable

from mjx_nero.tools.view.log import LOG


class Orders:
    """A thread that carries out the orders of pages. Only the last of the waiting orders with one name is done, so that no page
    can pile up work. An order that fails only logs a line."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, Callable[[], object]] = {}
        self._changed, self._ended = threading.Condition(), False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def give(self, name: Hashable, work: Callable[[], object]) -> None:
        """Queues ``work``, and replaces a waiting order with the same name."""
        with self._changed:
            self._waiting[name] = work
            self._changed.notify()

    def close(self) -> None:
        """Ends the thread; waiting orders are dropped."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(timeout=5)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ended)
                if self._ended:
                    return
                work = self._waiting.pop(next(iter(self._waiting)))
            try:
                work()
            except Exception:
                LOG.warning("an order of a page failed", exc_info=True)
