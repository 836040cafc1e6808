"""The log of the view's servers, limited in rate whatever clients send."""

import logging
import time

EVERY_S = 10.0  # minimum time between two lines
_LONGEST = 160  # characters


class _Rarely(logging.Filter):
    """Lets one line through per ``EVERY_S``, escaped (it may quote untrusted requests) and without its traceback."""

    def __init__(self) -> None:
        super().__init__()
        self._next, self._kept = 0.0, 0

    def filter(self, record: logging.LogRecord) -> bool:
        if record.getMessage() == "opening handshake failed":  # websockets logs this for each page that is closed while it loads
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
