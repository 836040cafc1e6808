"""Signals end a program at once before training, and let it save first during training."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)  # Ctrl-C, and what job queues and terminals send


class Signalled(KeyboardInterrupt):
    """A signal that ends the program. ``code`` is its exit status, 128 plus the signal's number."""

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.code = 128 + number


class Stop:
    """Records whether a signal came, and which."""

    number: int | None = None

    @property
    def code(self) -> int:
        """Exit status of a program that the signal ended."""
        return 128 + (self.number or 0)


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Raises ``Signalled`` at a signal, wherever the program is, so that it cleans up as it ends."""

    def handle(number: int, _: Any) -> None:
        raise Signalled(number)

    with _handled(handle):
        yield


@contextlib.contextmanager
def after_this(say: Callable[[str], None]) -> Iterator[Stop]:
    """Sets a flag at the first signal, so that the current work completes; ends the process at the second.

    The second signal raises nothing, because the program may be inside a callback of compiled code, which no exception may cross.
    Files appear whole or not at all, so nothing is left half-written.
    """
    stop = Stop()

    def handle(number: int, _: Any) -> None:
        if stop.number is not None:
            os._exit(128 + number)
        stop.number = number
        say("stopping after this update or evaluation, to save it (Ctrl-C again: stop at once, with the last checkpoint) ...")

    with _handled(handle):
        yield stop


def check(stop: Stop) -> None:
    """Ends the program if a signal came.

    Raises:
        Signalled: it did.
    """
    if stop.number is not None:
        raise Signalled(stop.number)


@contextlib.contextmanager
def ended() -> Iterator[None]:
    """Ends the process at a signal, with one line and without an exception, which may not cross compiled code that calls back."""

    def handle(number: int, _: Any) -> None:
        os.write(2, b"interrupted\n")
        os._exit(128 + number)

    with _handled(handle):
        yield


@contextlib.contextmanager
def _handled(handle: Callable[[int, Any], None]) -> Iterator[None]:
    before = {}
    for number in SIGNALS:
        if signal.getsignal(number) is signal.SIG_IGN:  # as under nohup
            continue
        try:
            before[number] = signal.signal(number, handle)
        except ValueError:  # only the main thread may set handlers
            break
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
