"""Signals end a program at once before training, and let it save first during training."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any

AGAIN = 1.0  # [s] until a signal whose exception was dropped is sent again
IMPORTING = 0.2  # [s] until a signal that came as compiled code was imported is sent again
SAME = 0.1  # [s] signals closer than this are one: `timeout`, for example, signals the program and then its whole group
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)  # Ctrl-C, and what job queues and terminals send


class Signalled(KeyboardInterrupt):
    """A signal that ends the program. ``code`` is its exit status, 128 plus the signal's number."""

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.code = 128 + number


class Stop:
    """Records whether a signal came, and which was the first."""

    number: int | None = None
    _came = 0.0

    @property
    def code(self) -> int:
        """Exit status of a program that the signal ended."""
        return 128 + (self.number or 0)

    def took(self, number: int) -> bool:
        """Records a signal. Returns False if it only repeats the one just before."""
        now = time.monotonic()
        if self.number is not None and now - self._came < SAME:
            return False
        self.number, self._came = self.number or number, now
        return True


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Raises ``Signalled`` at a signal, wherever the program is, so that it cleans up as it ends.

    Python drops an exception raised in a destructor or in a callback of the garbage collector, and a library may catch it or
    turn it into its own. So a timer sends the signal again until the program begins to end, but never interrupts clean-up.
    It also sends a signal again that came as a library of compiled code was imported, which an exception can crash.

    Raises:
        Signalled: a signal came, whatever became of the exception that it raised.
    """
    stop = Stop()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.took(number):
            imports = _imports(frame)
            signal.setitimer(signal.ITIMER_REAL, IMPORTING if imports else AGAIN)
            if not imports:
                raise Signalled(number)

    def again(*_: Any) -> None:
        if _ends(sys.exception()):
            signal.setitimer(signal.ITIMER_REAL, AGAIN)
        else:
            signal.raise_signal(stop.number or signal.SIGTERM)  # to the handler of the moment

    try:
        with _unsaid(), _handled(again, (signal.SIGALRM,)):
            try:
                with _handled(handle):
                    yield
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
    except BaseException:
        check(stop)
        raise
    check(stop)


@contextlib.contextmanager
def after_this(say: Callable[[str], None]) -> Iterator[Stop]:
    """Sets a flag at the first signal, so that the current work completes; ends the process at the second.

    The second signal raises nothing, because the program may be inside a callback of compiled code, which no exception may cross.
    Files appear whole or not at all, so nothing is left half-written.
    """
    stop = Stop()

    def handle(number: int, _: Any) -> None:
        first = stop.number is None
        if not stop.took(number):
            return
        if not first:
            os._exit(128 + number)
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


def _imports(frame: FrameType | None) -> bool:
    """Returns whether a module of compiled code is being imported where a signal came."""
    while frame is not None and not frame.f_code.co_qualname.startswith("ExtensionFileLoader."):
        frame = frame.f_back
    return frame is not None


def _ends(error: BaseException | None) -> bool:
    """Returns whether clean-up after a signal is under way, given the exception that is being handled.

    Where compiled code calls back, JAX raises its own error with ours in its text.
    """
    while error is not None and Signalled.__name__ not in f"{type(error).__name__} {error}":
        error = error.__context__
    return error is not None


@contextlib.contextmanager
def _unsaid() -> Iterator[None]:
    """Says nothing of a ``Signalled`` that Python drops."""
    before = sys.unraisablehook

    def hook(dropped: Any) -> None:
        if not issubclass(dropped.exc_type, Signalled):
            before(dropped)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


@contextlib.contextmanager
def _handled(handle: Callable[[int, Any], None], numbers: Sequence[int] = SIGNALS) -> Iterator[None]:
    before = {}
    for number in numbers:
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
