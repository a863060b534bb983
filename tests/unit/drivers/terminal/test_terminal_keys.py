"""Bytes from a terminal as keys and replies, in pieces of any size."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.terminal.keys import ALT, CTRL, PRESS, RELEASE, REPEAT, SHIFT, Key, KeyParser, TerminalReply


def parsed(*pieces: bytes) -> list[Key | TerminalReply]:
    parser = KeyParser()
    return [event for k, piece in enumerate(pieces) for event in parser.feed(piece, 0.001 * k)]


@pytest.mark.parametrize(
    ("data", "events"),
    [
        # A plain terminal.
        (b"w", [Key("w")]),
        (b"W", [Key("w", PRESS, SHIFT)]),
        (b" \t\r\n", [Key("space"), Key("tab"), Key("enter"), Key("enter")]),
        (b"\x00", [Key("space")]),
        (b"\x1b[A\x1bOB\x1b[1;2C", [Key("up"), Key("down"), Key("right", PRESS, SHIFT)]),
        (b"\x1b[5~\x1b[6~\x1b[1~\x1b[H", [Key("pageup"), Key("pagedown"), Key("home"), Key("home")]),
        (b"\x1b[1;5D\x1b[1;3D", [Key("left", PRESS, CTRL), Key("left", PRESS, ALT)]),
        # The Kitty protocol.
        (b"\x1b[119u\x1b[119;1:2u\x1b[119;1:3u", [Key("w"), Key("w", REPEAT), Key("w", RELEASE)]),
        (b"\x1b[32;1:1u\x1b[27u", [Key("space"), Key("escape")]),
        (b"\x1b[1;1:3A\x1b[5;1:3~", [Key("up", RELEASE), Key("pageup", RELEASE)]),
        (b"\x1b[57419;129u", [Key("up")]),  # of the keypad, with Num Lock
        (b"\x1b[99;5u\x1b[99;69u", [Key("c", PRESS, CTRL), Key("c", PRESS, CTRL)]),  # the second with Caps Lock
        (b"\x1b[1089::99;5u", [Key("c", PRESS, CTRL)]),  # on a Cyrillic keyboard
        (b"\x1b[119:87;2u", [Key("w", PRESS, SHIFT)]),
        (b"\x1b[57441;2u\x1b[57441;1:3u", [Key("shift", PRESS, SHIFT), Key("shift", RELEASE)]),
        (b"\x1b[119;9u", [Key("w", PRESS, ALT)]),  # super
        # Answers.
        (b"\x1b[?15u\x1b[?62;22c", [TerminalReply("?u", (15,)), TerminalReply("?c", (62, 22))]),
        (b"\x1b[?1004;1$y\x1b[I\x1b[O", [TerminalReply("?$y", (1004, 1)), TerminalReply("I"), TerminalReply("O")]),
        # Sequences without a meaning here.
        (b"\x1b[12;40R\x1b[99~\x1b[>1;2c\x1b[<0;3;5M\x1b[3;1:9u\x01\xc3\xa4", []),
        (b"\x7f\x08\x1b[127u", [Key("backspace"), Key("backspace"), Key("backspace")]),
        (b"\x1b[" + b"1" * 1000 + b"uw", [Key("1")] * 953 + [Key("u"), Key("w")]),
        # Esc: alone in front of another key it is a stop, and so is Alt with a key, which looks the same.
        (b"\x1bw", [Key("escape")]),
        (b"\x1b\x1b\x1b[A", [Key("escape"), Key("escape"), Key("up")]),
    ],
)
def test_bytes_become_keys_and_replies(data: bytes, events: list[Key | TerminalReply]) -> None:
    assert parsed(data) == events
    assert parsed(*(bytes([byte]) for byte in data)) == events, "byte by byte"


@pytest.mark.parametrize("begun", [b"\x1b", b"\x1b[", b"\x1b[1;"])
def test_unfinished_sequence_becomes_esc(begun: bytes) -> None:
    parser = KeyParser()
    assert parser.feed(begun, 5.0) == []
    assert parser.feed(b"", 5.05) == [], "the rest may still arrive"
    assert (parser.feed(b"", 5.2), parser.feed(b"w", 5.3)) == ([Key("escape")], [Key("w")])


@settings(deadline=None)
@given(st.lists(st.binary(max_size=40) | st.sampled_from([b"\x1b", b"\x1b[", b"\x1b[?", b"\x1bO", b"u"]), max_size=30))
def test_arbitrary_bytes_neither_fail_nor_accumulate(pieces: list[bytes]) -> None:
    parser = KeyParser()
    for piece in pieces:
        parser.feed(piece, 0.0)
        assert len(parser._pending) < 64
    parser.feed(b"", 1.0)
    assert parser.feed(b"w", 1.0)[-1:] == [Key("w")]
