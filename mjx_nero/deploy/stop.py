"""Ways in which a person stops an arm: Ctrl-C, SIGTERM, a key, or a file that nobody touches any more."""

import collections
import contextlib
import os
import pathlib
import select
import signal
import sys
import time
from collections.abc import Iterator

from mjx_nero.deploy.loop import Stop
from mjx_nero.deploy.safety import Fault

KEYS = b" q\x1b"  # space, q, escape
typed: collections.deque[str] = collections.deque(maxlen=16)  # other keys, for who asks questions
FRESH = 0.5  # [s] a dead man's file has to be younger


@contextlib.contextmanager
def operator(alive: pathlib.Path | None = None) -> Iterator[Stop]:
    """Asks, once a cycle, whether somebody wants the arm to hold.

    Args:
        alive: a file that somebody has to touch every half second; None: there is none.
    """
    caught: list[str] = []
    before = {n: signal.signal(n, lambda number, _: caught.append(signal.Signals(number).name)) for n in _SIGNALS}

    def asked() -> Fault | None:
        if caught:
            return Fault("stop", f"{caught[0]} came")
        if key := _key():
            return Fault("stop", f"the key {key!r} was pressed")
        if alive and not abs(_age(alive)) <= FRESH:  # one from the future would be fresh for long
            return Fault("stop", f"nobody has touched {alive} for {FRESH:g} s")
        return None

    try:
        with _keys():
            yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def _age(path: pathlib.Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except OSError:
        return float("inf")


def _key() -> str:
    """A key that stops, if it was pressed."""
    if not sys.stdin or sys.stdin.closed or not sys.stdin.isatty():
        return ""
    while select.select([sys.stdin], [], [], 0)[0]:
        if not (pressed := os.read(sys.stdin.fileno(), 16)):
            return ""
        if hit := next((k for k in pressed if k in KEYS), None):
            return {" ": "space", "\x1b": "escape"}.get(chr(hit), chr(hit))
        typed.extend(pressed.decode("ascii", "ignore"))
    return ""


@contextlib.contextmanager
def _keys() -> Iterator[None]:
    """Keys come at once, without Enter."""
    if not sys.stdin or sys.stdin.closed or not sys.stdin.isatty():
        yield
        return
    import termios
    import tty

    kept = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, kept)
