"""A thread that talks to a device repeatedly, until that fails."""

import threading
from collections.abc import Callable

from mjx_nero.deploy.arm import ArmError


class Turning:
    """Calls ``work`` repeatedly in a separate thread. A failure ends the calls, and ``check`` reports it.

    Args:
        pause: time between two calls [s].
    """

    def __init__(self, work: Callable[[], None], pause: float = 0.0):
        self._work, self._pause, self._error = work, pause, ""
        self._over, self._thread = threading.Event(), threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Starts the calls."""
        self._thread.start()

    def _run(self) -> None:
        while not self._over.wait(self._pause) and not self._error:
            self.turn()

    def turn(self) -> None:
        """Makes one call, unless an earlier one failed."""
        try:
            if not self._error:
                self._work()
        except ArmError as error:
            self._error = str(error)

    def check(self) -> None:
        """Reports a failure.

        Raises:
            ArmError: a call has failed.
        """
        if self._error:
            raise ArmError(self._error)

    def stop(self) -> None:
        """Ends the calls, and waits for the last one."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join(1.0)
