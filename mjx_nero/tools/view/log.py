"""The one voice of the view's servers: a line now and then, whatever comes in."""

import logging
import time

EVERY_S = 10.0  # a line at most
_LONGEST = 160  # characters


class _Rarely(logging.Filter):
    """Lets one line through at a time, in plain letters (what strangers send may be in it) and without its traceback."""

    def __init__(self) -> None:
        super().__init__()
        self._next, self._kept = 0.0, 0

    def filter(self, record: logging.LogRecord) -> bool:
        if record.getMessage() == "opening handshake failed":  # websockets says so of each page that is closed while it loads
            return False
        if time.monotonic() < self._next:
            self._kept += 1
            return False
        text = record.getMessage()
        if record.exc_info and record.exc_info[1]:
            text += f": {type(record.exc_info[1]).__name__}: {record.exc_info[1]}"
        text = text.encode("unicode_escape").decode()[:_LONGEST]
        record.msg, record.args = "view: " + text + (f" (and {self._kept} more)" if self._kept else ""), ()
        record.exc_info = record.exc_text = None
        self._next, self._kept = time.monotonic() + EVERY_S, 0
        return True


LOG = logging.getLogger(__name__)
LOG.setLevel(logging.WARNING)
LOG.addFilter(_Rarely())
