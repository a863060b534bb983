"""What a terminal sends, made into keys and answers: plain terminals, and those that speak the Kitty protocol.

Whatever comes in is only bytes that somebody may have typed, pasted, or cut in two on the way. Nothing here raises or
grows without bound, and what cannot be told from Esc counts as Esc, because Esc stops the arm.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

__all__ = ["ALT", "CTRL", "PRESS", "RELEASE", "REPEAT", "SHIFT", "Answer", "Key", "KeyParser"]

PRESS, REPEAT, RELEASE = 1, 2, 3
"""What happened to a key. A plain terminal says PRESS for all that it says."""

SHIFT, ALT, CTRL = 1, 2 | 8 | 16 | 32, 4
"""Modifiers; whatever else makes a shortcut (super, hyper, meta) counts as Alt. The locks do not count."""

_ESC = 0x1B
_LONGEST = 48
"""A sequence longer than this is none, bytes."""
_PATIENCE = 0.1
"""The rest of a sequence comes within this time, s. Esc alone is known by it."""

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
"""Numbers of the Kitty protocol that are no printable character."""


class Key(NamedTuple):
    """One thing that a key did."""

    name: str
    """A lower-case character, or the name of a key: up, pageup, home, tab, enter, escape, space, shift and so on."""
    event: int = PRESS
    modifiers: int = 0
    """Of SHIFT, ALT and CTRL; bits."""


class Answer(NamedTuple):
    """What the terminal says by itself: answers to queries, and whether its window has the focus."""

    what: str
    """The sequence without its numbers: ``?u``, ``?c``, ``?$y``; ``I`` and ``O`` for focus gained and lost."""
    numbers: tuple[int, ...] = ()


class KeyParser:
    """Feed it what was read; it may end anywhere."""

    def __init__(self) -> None:
        self._pending = bytearray()
        """The beginning of a sequence, from its ESC on."""
        self._since = 0.0

    def feed(self, data: bytes, now: float) -> list[Key | Answer]:
        """What ``data`` completes. Call it with nothing, too: time alone (``now``, s) makes an Esc of an ESC."""
        found: list[Key | Answer] = []
        for byte in data:
            if self._pending:
                self._go_on(byte, found)
            else:
                self._begin(byte, found)
        if data:
            self._since = now
        elif self._pending and now - self._since > _PATIENCE:
            self._pending.clear()
            found.append(Key("escape"))
        return found

    def _begin(self, byte: int, found: list[Key | Answer]) -> None:
        if byte == _ESC:
            self._pending.append(byte)
        elif byte in _CONTROLS:
            found.append(Key(_CONTROLS[byte]))
        elif 0x21 <= byte <= 0x7E:
            letter = chr(byte)
            found.append(Key(letter.lower(), PRESS, SHIFT if letter.isupper() else 0))

    def _go_on(self, byte: int, found: list[Key | Answer]) -> None:
        pending = self._pending
        if byte == _ESC:  # the sequence before it was none: someone leans on Esc
            found.append(Key("escape"))
            pending[:] = (_ESC,)
            return
        pending.append(byte)
        if len(pending) == 2:
            if byte not in b"[O":  # Alt and a key, or Esc and then a key: the terminal says the same
                pending.clear()
                found.append(Key("escape"))
            return
        if pending[1] == ord("O") or 0x40 <= byte <= 0x7E:
            inside, final = pending[2:-1].decode("latin-1"), chr(byte)
            focus = not inside and final in "IO" and pending[1] == ord("[")
            event = Answer(final) if focus else _sequence(inside, final)
            pending.clear()
            if event is not None:
                found.append(event)
        elif not 0x20 <= byte <= 0x3F or len(pending) > _LONGEST:
            pending.clear()


def _sequence(inside: str, final: str) -> Key | Answer | None:
    """``CSI inside final``; None where it means nothing to us."""
    if inside[:1] in ("<", "=", ">"):
        return None
    if inside.startswith("?"):
        digits = inside[1:].rstrip("$")
        numbers = [_number(field) for field in digits.split(";")]
        return Answer("?" + inside[1 + len(digits) :] + final, tuple(numbers))
    fields = [[_number(part) for part in field.split(":")] for field in inside.split(";")]
    code = fields[0][0]
    if final == "u":
        # The third part is where the key lies on a Latin keyboard, which finds Ctrl-C on a Cyrillic one.
        base = fields[0][2] if len(fields[0]) > 2 else 0
        code = base if base and not 0x21 <= code <= 0x7E and code not in _CODES else code
        name = _CODES.get(code) or (chr(code).lower() if 0x21 <= code <= 0x7E else None)
    else:
        name = _TILDES.get(code) if final == "~" else _LETTERS.get(final)
    if name is None:
        return None
    modifiers = fields[1] if len(fields) > 1 else [1]
    event = modifiers[1] if len(modifiers) > 1 else PRESS
    return Key(name, event, _known(max(0, modifiers[0] - 1))) if event in (PRESS, REPEAT, RELEASE) else None


def _known(modifiers: int) -> int:
    return (modifiers & (SHIFT | CTRL)) | (ALT if modifiers & ALT else 0)


def _number(text: str) -> int:
    return int(text) if text.isascii() and text.isdigit() else 0
