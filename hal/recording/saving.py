"""An episode that is being finished in the background."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

__all__ = ["Saving"]

_LOG = logging.getLogger("hal.recording")


class Saving:
    """Runs ``work`` in a thread of its own, which a program that ends waits for; a failure is kept, and logged."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.error: Exception | None = None
        self._work = work
        self._thread = threading.Thread(target=self._run, name="hal-recorder-save")
        self._thread.start()

    def _run(self) -> None:
        try:
            self._work()
        except Exception as error:
            self.error = error
            _LOG.warning("%s", error)

    @property
    def done(self) -> bool:
        """Is it over, well or not?"""
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Return when it is over."""
        self._thread.join()

    def result(self) -> None:
        """The same; raises what went wrong."""
        self.wait()
        if self.error is not None:
            raise self.error
