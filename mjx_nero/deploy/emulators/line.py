"""The far end of an emulated serial line: a pseudo-terminal, or a TCP port of this machine that pyserial can open."""

import contextlib
import os
import select
import socket
import time
import tty
from collections.abc import Callable


class Line:
    """A line that one program at a time may open.

    Args:
        terminal: use a pseudo-terminal instead of a TCP port. The kernel moves its bytes in a thread of ordinary priority, which
            can be a tenth of a second late while other programs compute; a TCP port has no such delay.

    Attributes:
        name: address for ``serial.serial_for_url``.
    """

    def __init__(self, terminal: bool = False):
        self._door: socket.socket | None = None
        self._guest: socket.socket | None = None
        if terminal:
            self._end, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._end, False)
            self.name = os.ttyname(self._slave)
        else:
            self._door = socket.create_server(("127.0.0.1", 0))
            self._end, self.name = self._door.fileno(), f"socket://127.0.0.1:{self._door.getsockname()[1]}"

    def read(self) -> bytes:
        """Returns the bytes that have arrived; may be empty."""
        if self._door and not self._guest:
            self._guest, _ = self._door.accept()
            self._guest.setblocking(False)
            self._guest.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._end = self._guest.fileno()
            return b""
        try:
            data = os.read(self._end, 4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not self._guest:
            return data
        if data:  # otherwise the next small packet would wait for this one's acknowledgement
            self._guest.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        else:
            self._leave()
        return data

    def _leave(self) -> None:
        assert self._door and self._guest
        self._guest.close()
        self._guest, self._end = None, self._door.fileno()

    def write(self, data: bytes) -> int:
        """Sends bytes; returns how many the line accepted."""
        if data and (self._guest or not self._door):
            with contextlib.suppress(OSError):
                return os.write(self._end, data)
        return 0

    def serve(
        self,
        take: Callable[[], None],
        tick: Callable[[], None],
        period: float,
        until: Callable[[], bool] = lambda: False,
        other: int | None = None,
    ) -> None:
        """Calls ``take`` when bytes have arrived, and ``tick`` every ``period`` [s].

        Args:
            until: it ends when this returns True.
            other: it also ends when this file descriptor does.
        """
        due = time.monotonic()
        while not until():
            watched = [self._end, *([] if other is None else [other])]
            ready, _, _ = select.select(watched, [], [], max(0.0, due - time.monotonic()))
            if other in ready and not os.read(other or 0, 1000):
                return
            if self._end in ready:
                take()
            if time.monotonic() >= due:
                due = max(due + period, time.monotonic())
                tick()

    def close(self) -> None:
        """Closes the line."""
        for each in (self._guest, self._door):
            if each:
                each.close()
        if not self._door:
            os.close(self._end)
            os.close(self._slave)
