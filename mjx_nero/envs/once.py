"""Properties that are computed once, also if two threads ask at the same time."""

import functools
import threading
from typing import Any


class once(functools.cached_property):
    """A ``functools.cached_property`` with a lock, which Python has left out since 3.12."""

    def __init__(self, compute: Any):
        super().__init__(compute)
        self._lock = threading.RLock()

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with self._lock:
            return super().__get__(instance, owner)
