"""Whether the person's end of the link is still there."""

from __future__ import annotations

import math

from .keys import Answer

__all__ = ["FLAGS", "FOCUS", "Pings"]

FLAGS = 1 | 2 | 4 | 8
"""Of the Kitty protocol: Esc told from sequences, releases, keys of other alphabets, releases of letters and space."""
_NEEDED = 2 | 8
FOCUS = 1004
"""The private mode that reports whether the terminal's window has the focus."""
_SET = (1, 3)
"""States of a private mode that is on."""
_FIRST, _COUNT = 60000, 4000
"""Numbers of private modes that no terminal has."""
_PERIOD, _RARELY = 0.025, 0.25
"""Between two questions, s: usually, and while nothing is answered."""
_FORGET = 2.0


class Pings:
    """The terminal is asked, again and again, and must answer: are you there, and do you still report releases?

    Each question has a number that comes back in its answer (it asks for the state of a private mode that no terminal
    has). So the age of the newest *question* that was answered is a bound on the age of everything that we know of the
    keys, and a late answer to an old question, after a stall, is not taken for a new one.
    """

    def __init__(self) -> None:
        self.t_alive = -math.inf
        """When the newest question that was answered had been asked, s."""
        self.lost = False
        """Did somebody switch the reports off? Then a key that is let go of would go unnoticed."""
        self._asked: dict[int, float] = {}
        self._number = 0
        self._next = -math.inf

    def wait(self, now: float) -> float:
        """How long until the next question is due, s."""
        return max(0.0, self._next - now)

    def ask(self, now: float) -> bytes:
        """The next question, asked at ``now``, s."""
        self._next = now + (_PERIOD if now - self.t_alive < 1.0 else _RARELY)
        self._number = (self._number + 1) % _COUNT
        self._asked = {number: t for number, t in self._asked.items() if now - t < _FORGET}
        self._asked[self._number] = now
        return f"\x1b[?u\x1b[?{FOCUS}$p\x1b[?{_FIRST + self._number}$p".encode()

    def hear(self, answer: Answer) -> bool:
        """Take what the terminal said. True when it answered a question that was asked here."""
        numbers = answer.numbers
        if answer.what == "?u":
            self.lost = self.lost or numbers[0] & _NEEDED != _NEEDED
        elif answer.what == "?$y" and numbers[0] == FOCUS:
            self.lost = self.lost or numbers[-1] not in _SET
        elif answer.what == "?$y":
            asked = self._asked.pop(numbers[0] - _FIRST, None)
            if asked is not None and not self.lost:
                self.t_alive = max(self.t_alive, asked)
                self._next = min(self._next, asked + _PERIOD)
            return asked is not None
        return False
