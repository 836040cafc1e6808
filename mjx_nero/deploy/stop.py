"""Lets a person stop an arm: by Ctrl-C, SIGTERM, a key, or a file that is no longer touched."""

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
typed: collections.deque[str] = collections.deque(maxlen=16)  # other keys, for code that asks questions
FRESH = 0.5  # maximum age of a dead man's file [s]


@contextlib.contextmanager
def operator(alive: pathlib.Path | None = None) -> Iterator[Stop]:
    """Yields a function that says whether someone wants the arm to hold, to be called every cycle.

    Args:
        alive: a file that must be touched at least every half second; None: there is none.
    """
    caught: list[str] = []
    before = {n: signal.signal(n, lambda number, _: caught.append(signal.Signals(number).name)) for n in _SIGNALS}

    def asked() -> Fault | None:
        if caught:
            return Fault("stop", f"{caught[0]} arrived")
        if key := _key():
            return Fault("stop", f"the key {key!r} was pressed")
        if alive and not abs(_age(alive)) <= FRESH:  # abs: a time stamp in the future would stay fresh
            return Fault("stop", f"{alive} was not touched for {FRESH:g} s")
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
    """Returns the pressed key that stops the arm; empty if none was."""
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
    """Makes the terminal deliver keys at once, without Enter."""
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
