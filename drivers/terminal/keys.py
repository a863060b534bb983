"""The terminal's protocol: bytes into keys and replies, and the check that keys can be held.

:class:`KeyParser` reads plain terminals and those that speak the Kitty keyboard protocol. Its input may be typed,
pasted or cut in two on the way, so it never raises and never grows without bound; what may be Esc counts as Esc,
because Esc stops the arm. :func:`enable_key_reports` switches the reports of key releases on where the terminal has
them, and :class:`LinkCheck` proves that they still arrive.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from .device import Terminal

__all__ = [
    "ALT",
    "CTRL",
    "PRESS",
    "RELEASE",
    "REPEAT",
    "SHIFT",
    "TerminalReply",
    "Key",
    "KeyParser",
    "LinkCheck",
    "disable_key_reports",
    "enable_key_reports",
]

PRESS, REPEAT, RELEASE = 1, 2, 3
"""What happened to a key. A plain terminal reports PRESS for everything."""

SHIFT, ALT, CTRL = 1, 2 | 8 | 16 | 32, 4
"""Modifiers; super, hyper and meta count as Alt. Caps Lock and Num Lock do not count."""


class Key(NamedTuple):
    """One press, repeat or release of a key."""

    name: str
    """A lower-case character, or the name of a key: up, pageup, home, tab, enter, escape, space, shift and so on."""
    event: int = PRESS
    modifiers: int = 0
    """Bits of SHIFT, ALT and CTRL."""


class TerminalReply(NamedTuple):
    """A sequence that the terminal sends by itself: a reply to a query, or a change of the window's focus."""

    what: str
    """The sequence without its numbers: ``?u``, ``?c``, ``?$y``; ``I`` and ``O`` for focus gained and lost."""
    numbers: tuple[int, ...] = ()


# Parsing.

_ESC = 0x1B
_LONGEST = 48
"""Longest sequence, bytes; longer ones are dropped."""
_SEQUENCE_TIMEOUT = 0.1
"""The rest of a sequence arrives within this time, s; otherwise it was Esc alone."""

_CONTROLS = MappingProxyType(
    {0x00: "space", 0x08: "backspace", 0x09: "tab", 0x7F: "backspace", 0x0A: "enter", 0x0D: "enter", 0x20: "space"}
)
_LETTERS = MappingProxyType({"A": "up", "B": "down", "C": "right", "D": "left", "H": "home", "F": "end"})
_TILDES = MappingProxyType({1: "home", 4: "end", 5: "pageup", 6: "pagedown", 7: "home", 8: "end"})
_CODES = MappingProxyType(
    {
        9: "tab",
        13: "enter",
        27: "escape",
        32: "space",
        127: "backspace",
        57414: "enter",  # from here on: the keypad
        57417: "left",
        57418: "right",
        57419: "up",
        57420: "down",
        57421: "pageup",
        57422: "pagedown",
        57423: "home",
        57424: "end",
        57441: "shift",
        57447: "shift",
    }
)
"""Codes of the Kitty protocol that are not printable characters."""


class KeyParser:
    """Turns bytes into keys and replies. The input may be cut anywhere."""

    def __init__(self) -> None:
        self._pending = bytearray()
        """The beginning of a sequence, from its ESC on."""
        self._since = 0.0

    def feed(self, data: bytes, now: float) -> list[Key | TerminalReply]:
        """Return the keys and replies that ``data`` completes.

        Args:
            data: Bytes that were read. Call it with none, too: an unfinished sequence becomes Esc with time.
            now: Monotonic time, s.
        """
        found: list[Key | TerminalReply] = []
        for byte in data:
            if self._pending:
                self._continue_sequence(byte, found)
            elif byte == _ESC:
                self._pending.append(byte)
            elif byte in _CONTROLS:
                found.append(Key(_CONTROLS[byte]))
            elif 0x21 <= byte <= 0x7E:
                letter = chr(byte)
                found.append(Key(letter.lower(), PRESS, SHIFT if letter.isupper() else 0))
        if data:
            self._since = now
        elif self._pending and now - self._since > _SEQUENCE_TIMEOUT:
            self._pending.clear()
            found.append(Key("escape"))
        return found

    def _continue_sequence(self, byte: int, found: list[Key | TerminalReply]) -> None:
        pending = self._pending
        if byte == _ESC:  # the sequence before it is incomplete: Esc is held down
            found.append(Key("escape"))
            pending[:] = (_ESC,)
            return
        pending.append(byte)
        if len(pending) == 2:
            if byte not in b"[O":  # Alt with a key, or Esc and then a key: the same bytes
                pending.clear()
                found.append(Key("escape"))
            return
        if pending[1] == ord("O") or 0x40 <= byte <= 0x7E:
            inside, final = pending[2:-1].decode("latin-1"), chr(byte)
            focus = not inside and final in "IO" and pending[1] == ord("[")
            event = TerminalReply(final) if focus else _parse_sequence(inside, final)
            pending.clear()
            if event is not None:
                found.append(event)
        elif not 0x20 <= byte <= 0x3F or len(pending) > _LONGEST:
            pending.clear()


def _parse_sequence(inside: str, final: str) -> Key | TerminalReply | None:
    """Return what ``CSI inside final`` means; None where it has no meaning here."""
    if inside[:1] in ("<", "=", ">"):
        return None
    if inside.startswith("?"):
        digits = inside[1:].rstrip("$")
        numbers = [_number(field) for field in digits.split(";")]
        return TerminalReply("?" + inside[1 + len(digits) :] + final, tuple(numbers))
    fields = [[_number(part) for part in field.split(":")] for field in inside.split(";")]
    code = fields[0][0]
    if final == "u":
        # The third part is the key's place on a Latin keyboard, which finds Ctrl-C on a Cyrillic one.
        base = fields[0][2] if len(fields[0]) > 2 else 0
        code = base if base and not 0x21 <= code <= 0x7E and code not in _CODES else code
        name = _CODES.get(code) or (chr(code).lower() if 0x21 <= code <= 0x7E else None)
    else:
        name = _TILDES.get(code) if final == "~" else _LETTERS.get(final)
    if name is None:
        return None
    field = fields[1] if len(fields) > 1 else [1]
    event = field[1] if len(field) > 1 else PRESS
    modifiers = max(0, field[0] - 1)
    known = (modifiers & (SHIFT | CTRL)) | (ALT if modifiers & ALT else 0)
    return Key(name, event, known) if event in (PRESS, REPEAT, RELEASE) else None


def _number(text: str) -> int:
    return int(text) if text.isascii() and text.isdigit() else 0


# Whether keys can be held, and still can.

_FLAGS = 1 | 2 | 4 | 8
"""Of the Kitty protocol: Esc distinct from sequences, releases, other alphabets, releases of letters and space."""
_NEEDED_FLAGS = 2 | 8
_FOCUS_MODE = 1004
"""The private mode that reports whether the terminal's window has the focus."""
_MODE_IS_SET = (1, 3)
"""States of a private mode that is on."""
_FIRST_UNUSED, _UNUSED_COUNT = 60000, 4000
"""Numbers of private modes that no terminal has."""
_PERIOD, _IDLE_PERIOD = 0.025, 0.25
"""Time between two questions, s: usually, and while the terminal does not answer."""
_FORGET = 2.0
"""Age at which a question without an answer is forgotten, s."""
_SLOWEST = 0.06
"""Longest round trip to the terminal, s. With the time between two questions it stays well below the silence after
which the servo's watchdog stops the arm (``PAD_SILENCE``)."""

_REPORT = f"\x1b[>{_FLAGS}u\x1b[?{_FOCUS_MODE}h"
_UNDO = f"\x1b[<u\x1b[?{_FOCUS_MODE}l"
_FENCE = b"\x1b[c"
"""Every terminal answers this query, and answers in order: what is unanswered before its reply stays unanswered."""
_ANSWER_TIMEOUT = 0.5
_DRAIN = 0.2
_TRIES = 3


class LinkCheck:
    """Repeated questions to the terminal, whose answers prove that it is there and still reports key releases.

    Each question has a number that is part of its answer (it queries a private mode that no terminal has). So the age
    of the newest *question* that was answered bounds the age of all that is known of the keys, and a late answer to an
    old question, after a stall, does not count as a new one.
    """

    def __init__(self) -> None:
        self.t_alive = -math.inf
        """Time at which the newest answered question was asked, s."""
        self.lost = False
        """Whether the reports were switched off, so that a released key would go unnoticed."""
        self._asked: dict[int, float] = {}
        self._number = 0
        self._next = -math.inf

    def time_to_next(self, now: float) -> float:
        """Return the time until the next question is due, s."""
        return max(0.0, self._next - now)

    def question(self, now: float) -> bytes:
        """Return the next question; it counts as asked at ``now``, s."""
        self._next = now + (_PERIOD if now - self.t_alive < 1.0 else _IDLE_PERIOD)
        self._number = (self._number + 1) % _UNUSED_COUNT
        self._asked = {number: t for number, t in self._asked.items() if now - t < _FORGET}
        self._asked[self._number] = now
        return f"\x1b[?u\x1b[?{_FOCUS_MODE}$p\x1b[?{_FIRST_UNUSED + self._number}$p".encode()

    def handle_answer(self, answer: TerminalReply) -> bool:
        """Evaluate a reply of the terminal; True when it answers a question that was asked here."""
        numbers = answer.numbers
        if answer.what == "?u":
            self.lost = self.lost or numbers[0] & _NEEDED_FLAGS != _NEEDED_FLAGS
        elif answer.what == "?$y" and numbers[0] == _FOCUS_MODE:
            self.lost = self.lost or numbers[-1] not in _MODE_IS_SET
        elif answer.what == "?$y":
            asked = self._asked.pop(numbers[0] - _FIRST_UNUSED, None)
            if asked is not None and not self.lost:
                self.t_alive = max(self.t_alive, asked)
                self._next = min(self._next, asked + _PERIOD)
            return asked is not None
        return False


def enable_key_reports(terminal: Terminal, parser: KeyParser, on_key: Callable[[Key], None]) -> str | None:
    """Switch the terminal to reporting presses, repeats and releases. Takes a few round trips, at most two seconds.

    Args:
        terminal: An entered terminal.
        parser: Parses its input.
        on_key: Called with keys that are pressed meanwhile.

    Returns:
        None, or the reason why keys cannot be held, as text for the user; the terminal is then as before.

    Raises:
        OSError: The terminal is gone.
    """
    terminal.write(b"\x1b[?u" + _FENCE)
    answers = _collect_answers(terminal, parser, _is_fence, on_key)
    if answers is None:
        return "the terminal does not answer"
    if "?u" not in answers:
        return "this terminal does not report key releases"
    terminal.undo_with(_UNDO)
    terminal.write(_REPORT.encode())
    reason = _test_reports(terminal, parser, on_key)
    if reason is not None:
        terminal.write(_UNDO.encode())
        terminal.undo_with("")
    return reason


def _test_reports(terminal: Terminal, parser: KeyParser, on_key: Callable[[Key], None]) -> str | None:
    link, longest = LinkCheck(), 0.0
    for _ in range(_TRIES):
        begun = time.monotonic()
        terminal.write(link.question(begun))
        if _collect_answers(terminal, parser, link.handle_answer, on_key) is None:
            return "this terminal does not answer the query that shows whether the link is alive"
        longest = max(longest, time.monotonic() - begun)
    if link.lost:
        return "this terminal does not report the release of letters, or the focus of its window"
    if longest > _SLOWEST:
        return f"the link is too slow to hold keys: round trip {1e3 * longest:.0f} ms, at most {1e3 * _SLOWEST:.0f} ms"
    return None


def disable_key_reports(terminal: Terminal) -> None:
    """Switch the reports off again, and drop the replies that are still on their way. Never raises."""
    try:
        terminal.write(_UNDO.encode() + _FENCE)
        terminal.undo_with("")
        _collect_answers(terminal, KeyParser(), _is_fence, lambda key: None, _DRAIN)
    except OSError:
        pass


def _is_fence(answer: TerminalReply) -> bool:
    return answer.what == "?c"


def _collect_answers(
    terminal: Terminal,
    parser: KeyParser,
    is_last: Callable[[TerminalReply], bool],
    on_key: Callable[[Key], None],
    timeout: float = _ANSWER_TIMEOUT,
) -> set[str] | None:
    """Return the kinds of replies up to one that ``is_last``; None when that did not come within ``timeout`` s."""
    found: set[str] = set()
    done = False
    deadline = time.monotonic() + timeout
    while not done and (rest := deadline - time.monotonic()) > 0.0:
        for event in parser.feed(terminal.read(rest), time.monotonic()):
            if isinstance(event, Key):
                on_key(event)
            else:
                found.add(event.what)
                done = is_last(event) or done
    return found if done else None
