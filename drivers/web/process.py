"""The process that serves the page, between any number of browsers and one app: its entry point and its limits.

It only reads the memory that the hosts write, and sends everything else to the app over a channel on which neither
waits for the other. When it is killed, stopped or too busy, the pad's newest proof of life grows old, as if a cable
were pulled.

It keeps the app's priority: a stop from a page is as urgent as the app itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import resource
from collections.abc import Sequence
from typing import Any

from hal.errors import DriverMissing
from hal.host.process import Channel, SharedMemory

_DESCRIPTORS = 8192
"""Far more than pages and other connections need, see :class:`~.sockets.ConnectionLimit`."""
_MAX_RECORDS = 20


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Serve pages until the app ends; the entry point of the child process.

    Args:
        channel: The channel to the app.
        memories: The memory of the pictures, then one for each host.
        config: What :class:`~.console.WebConsole` sends.

    Raises:
        NotSupported: The address or the port cannot be listened at.
        DriverMissing: A library is not installed.
    """
    try:
        from aiohttp.http import HttpProcessingError

        from .server import ConsoleServer
    except ImportError as error:
        remedy = "install what it needs with: pip install aiohttp simplejpeg"
        raise DriverMissing(f"the console does not import ({error}); {remedy}", name=error.name) from error
    _limit_logs(HttpProcessingError)
    _allow_descriptors()
    asyncio.run(ConsoleServer(channel, memories, config).run())


class LogLimit(logging.Filter):
    """Passes a number of log records, then one that says that there are more, then none.

    All that the process prints is kept in a file as long as the app runs, so a stranger must not be able to fill it.
    Malformed requests are not logged at all: their sender got an answer.
    """

    def __init__(self, most: int = _MAX_RECORDS, ignored: type[Exception] | None = None) -> None:
        """Pass ``most`` records, none of them about an error of type ``ignored``."""
        super().__init__()
        self._left = most + 1
        self._ignored = ignored

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is written; the last one is replaced by a note."""
        if self._ignored is not None and record.exc_info and isinstance(record.exc_info[1], self._ignored):
            return False
        self._left = max(self._left - 1, -1)
        if self._left == 0:
            record.msg, record.args = "further records of this kind are not shown", ()
            record.exc_info = record.exc_text = record.stack_info = None
        return self._left >= 0


def _limit_logs(ignored: type[Exception]) -> None:
    """Limit what this process writes through ``logging``; the error that ends it is written all the same."""
    handler = logging.StreamHandler()
    handler.addFilter(LogLimit(ignored=ignored))
    logging.getLogger().addHandler(handler)
    logging.getLogger("aiohttp").setLevel(logging.ERROR)  # its warnings repeat headers, and so a mistyped token


def _allow_descriptors() -> None:
    """Raise the soft limit of open files: shells often allow 1024 or fewer of what the machine allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
