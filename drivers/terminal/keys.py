"""Bytes from a terminal as keys."""

from __future__ import annotations

import re
from types import MappingProxyType

_ESC = 0x1B
_SEQUENCE = re.compile(rb"\x1b(?:\[([0-?]{0,32})|O)([@-~])")
_BEGUN = re.compile(rb"\x1b(?:\[[0-?]{0,32}|O)?")
"""What may become a sequence with the next bytes."""
_SEQUENCE_TIMEOUT = 0.1
"""The rest of a sequence arrives within this time, s; otherwise it was Esc alone."""

_CONTROLS = MappingProxyType({0x08: "backspace", 0x09: "tab", 0x0A: "enter", 0x0D: "enter", 0x7F: "backspace"})
_LETTERS = MappingProxyType({b"A": "up", b"B": "down", b"C": "right", b"D": "left", b"H": "home"})
_NUMBERS = MappingProxyType({b"1": "home", b"5": "pageup", b"6": "pagedown", b"7": "home"})
_PLAIN: tuple[list[bytes], ...] = ([], [b"1"], [b"2"])
"""Modifiers of a key that counts: none, or Shift."""


class KeyParser:
    """Turns bytes into names of keys. The input may be typed, pasted or cut anywhere.

    It never raises and never grows without bound. What may be Esc counts as Esc, because Esc stops the arm: also Alt
    with a key, which sends the same bytes as Esc and then the key.
    """

    def __init__(self) -> None:
        self._rest = b""
        """The beginning of a sequence, from its ESC on."""
        self._since = 0.0

    def feed(self, data: bytes, now: float) -> list[str]:
        """Return the keys that ``data`` completes: lower-case characters, or names such as up, pageup and escape.

        Args:
            data: Bytes that were read. Call it with none, too: an unfinished sequence becomes Esc with time.
            now: Monotonic time, s.
        """
        if data:
            self._since = now
        elif self._rest and now - self._since > _SEQUENCE_TIMEOUT:
            self._rest = b""
            return ["escape"]
        found: list[str | None] = []
        text, at = self._rest + data, 0
        while at < len(text):
            if text[at] != _ESC:
                found.append(_CONTROLS.get(text[at]) or (chr(text[at]).lower() if 0x21 <= text[at] <= 0x7E else None))
                at += 1
            elif sequence := _SEQUENCE.match(text, at):
                found.append(_name_sequence(sequence[1] or b"", sequence[2]))
                at = sequence.end()
            elif _BEGUN.fullmatch(text, at):
                break
            else:
                found.append("escape")
                at += 1 if text[at + 1] == _ESC else 2
        self._rest = text[at:]
        return [key for key in found if key is not None]


def _name_sequence(inside: bytes, final: bytes) -> str | None:
    """Return the key of a control sequence; None for one with Alt or Ctrl, and for all others."""
    number, *modifiers = inside.split(b";")
    if modifiers not in _PLAIN:
        return None
    return _NUMBERS.get(number) if final == b"~" else _LETTERS.get(final)
