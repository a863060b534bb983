"""The process that serves the page: between any number of browsers and one app.

It only ever reads the memory that the hosts write, and asks the app for everything else, over a channel on which
neither waits for the other. When it is killed, stopped or too busy, the pad's proof of life grows old, as with a cable
that is pulled.

It takes 3 % of a processor with a page that drives, and 2 ms for each small picture that a page is shown. It keeps the
app's priority: a stop from a page is as urgent as the app itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import resource
from collections.abc import Sequence
from typing import Any

from hal.errors import DriverMissing
from hal.host.process import Channel, SharedMemory

__all__ = ["main"]

_DESCRIPTORS = 8192
"""Far more than pages and visitors need, see :class:`~.visitors.Visitors`."""


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process; ``memories`` are that of the pictures, and one for each host.

    Raises NotSupported where it cannot listen, DriverMissing without its libraries or its page.
    """
    try:
        from .logs import bound_logs
        from .service import Service
    except ImportError as error:
        remedy = "install what it needs with: pip install aiohttp simplejpeg"
        raise DriverMissing(f"the console does not import ({error}); {remedy}") from error
    bound_logs()
    _allow_descriptors()
    asyncio.run(Service(channel, memories, config).run())


def _allow_descriptors() -> None:
    """Shells often allow 1024 or fewer, of what the machine allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
