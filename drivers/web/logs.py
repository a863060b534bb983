"""What the libraries of the console's process write: enough to find a mistake, never as much as a stranger wants.

All that the process prints is kept in a file as long as the app lives.
"""

from __future__ import annotations

import logging

from aiohttp.http import HttpProcessingError

__all__ = ["Bound", "bound_logs"]

_MOST = 20


class Bound(logging.Filter):
    """Lets a number of records through, then one that says that there are more, then none.

    A request that makes no sense is none of them: whoever sent it was told.
    """

    def __init__(self, most: int = _MOST) -> None:
        super().__init__()
        self._left = most + 1

    def filter(self, record: logging.LogRecord) -> bool:
        """May this be written? Makes the last one say that it is the last."""
        if record.exc_info and isinstance(record.exc_info[1], HttpProcessingError):
            return False
        self._left = max(self._left - 1, -1)
        if self._left == 0:
            record.msg, record.args = "there is more of this kind: it is left out", ()
            record.exc_info = record.exc_text = record.stack_info = None
        return self._left >= 0


def bound_logs() -> None:
    """Bound what this process writes by way of ``logging``; what ends it is written all the same."""
    handler = logging.StreamHandler()
    handler.addFilter(Bound())
    logging.getLogger().addHandler(handler)
    logging.getLogger("aiohttp").setLevel(logging.ERROR)  # its warnings repeat headers, and so a mistyped token
