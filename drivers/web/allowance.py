"""How much a page may say."""

from __future__ import annotations

__all__ = ["MALFORMED", "MESSAGES", "Allowance"]

MESSAGES = 400
"""In a second. A page that drives sends 50, and one more for every change of the pad."""
MALFORMED = 100
"""Ever."""


class Allowance:
    """Counts the messages of one socket."""

    def __init__(self) -> None:
        self._second = 0.0
        self._messages = 0
        self.malformed = 0

    def may_go_on(self, now: float) -> bool:
        """Count a message; False where there were too many in this second."""
        if not 0.0 <= now - self._second < 1.0:
            self._second, self._messages = now, 0
        self._messages += 1
        return self._messages <= MESSAGES

    def may_err(self) -> bool:
        """Count a malformed one; False where there were too many."""
        self.malformed += 1
        return self.malformed <= MALFORMED
