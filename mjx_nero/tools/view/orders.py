"""Orders of pages, carried out one after the other."""

import threading
from collections.abc import Callable, Hashable

from mjx_nero.tools.view.log import LOG


class Orders:
    """A thread that does what pages ask for. Of the orders that wait under one name only the last is done, so that no page can
    pile up work; one that fails is a line in the terminal and nothing more."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, Callable[[], object]] = {}
        self._changed, self._ended = threading.Condition(), False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def give(self, name: Hashable, work: Callable[[], object]) -> None:
        """Asks for ``work``, in place of what still waits under ``name``."""
        with self._changed:
            self._waiting[name] = work
            self._changed.notify()

    def close(self) -> None:
        """Ends the thread; what waits is not done any more."""
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
                LOG.warning("what a page asked for failed", exc_info=True)
