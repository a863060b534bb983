"""Asking a terminal whether keys can be held: does it report releases, and focus, and answer fast enough?"""

from __future__ import annotations

import time
from collections.abc import Callable

from .device import Terminal
from .keys import Answer, Key, KeyParser
from .pings import FLAGS, FOCUS, Pings

__all__ = ["SLOWEST", "leave", "why_not_hold"]

SLOWEST = 0.06
"""Longest way to the terminal and back, s. With the time between two questions it stays well below the silence after
which the servo's watchdog stops the arm (``PAD_SILENCE``)."""

_REPORT = f"\x1b[>{FLAGS}u\x1b[?{FOCUS}h"
_UNDO = f"\x1b[<u\x1b[?{FOCUS}l"
_FENCE = b"\x1b[c"
"""Every terminal answers that one, and answers in order: what has not been answered before it never will be."""
_PATIENCE = 0.5
_DRAIN = 0.2
_TRIES = 3


def why_not_hold(terminal: Terminal, parser: KeyParser, on_key: Callable[[Key], None]) -> str | None:
    """Switch the terminal to reporting presses, repeats and releases; None, or why that cannot be, for people.

    Takes a few round trips, and at most two seconds; keys that are pressed meanwhile go to ``on_key``. Raises OSError
    when the terminal is gone.
    """
    terminal.write(b"\x1b[?u" + _FENCE)
    answers = _hear(terminal, parser, lambda answer: answer.what == "?c", on_key)
    if answers is None:
        return "the terminal does not answer"
    if "?u" not in answers:
        return "this terminal does not report when a key is let go of"
    terminal.undo_with(_UNDO)
    terminal.write(_REPORT.encode())
    why = _why_not(terminal, parser, on_key)
    if why is not None:
        terminal.write(_UNDO.encode())
        terminal.undo_with("")
    return why


def _why_not(terminal: Terminal, parser: KeyParser, on_key: Callable[[Key], None]) -> str | None:
    pings, longest = Pings(), 0.0
    for _ in range(_TRIES):
        begun = time.monotonic()
        terminal.write(pings.ask(begun))
        if _hear(terminal, parser, pings.hear, on_key) is None:
            return "this terminal does not answer when it is asked whether it is still there"
        longest = max(longest, time.monotonic() - begun)
    if pings.lost:
        return "this terminal does not report when a letter is let go of, or its window loses the focus"
    if longest > SLOWEST:
        return f"the link is too slow to hold keys: {1e3 * longest:.0f} ms there and back, {1e3 * SLOWEST:.0f} at most"
    return None


def leave(terminal: Terminal) -> None:
    """Take back what the terminal was told to report, and wait for what it still has to say. Never raises."""
    try:
        terminal.write(_UNDO.encode() + _FENCE)
        terminal.undo_with("")
        _hear(terminal, KeyParser(), lambda answer: answer.what == "?c", lambda key: None, _DRAIN)
    except OSError:
        pass


def _hear(
    terminal: Terminal,
    parser: KeyParser,
    enough: Callable[[Answer], bool],
    on_key: Callable[[Key], None],
    patience: float = _PATIENCE,
) -> set[str] | None:
    """Kinds of answers until one is ``enough``, None when none was within ``patience`` s."""
    heard: set[str] = set()
    done = False
    deadline = time.monotonic() + patience
    while not done and (rest := deadline - time.monotonic()) > 0.0:
        for event in parser.feed(terminal.read(rest), time.monotonic()):
            if isinstance(event, Key):
                on_key(event)
            else:
                heard.add(event.what)
                done = enough(event) or done
    return heard if done else None
