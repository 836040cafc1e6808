"""Waits for what happens beside a test, in another thread or program."""

import time


def wait(condition, seconds=120.0):
    """Returns what ``condition`` returns, as soon as that is true."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)
    return found
