"""Bytes from a terminal as keys, in pieces of any size."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.terminal.keys import KeyParser


def parsed(*pieces: bytes) -> list[str]:
    parser = KeyParser()
    return [key for k, piece in enumerate(pieces) for key in parser.feed(piece, 0.001 * k)]


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wW1", ["w", "w", "1"]),
        (b"\t\r\n\x7f\x08", ["tab", "enter", "enter", "backspace", "backspace"]),
        (b"\x1b[A\x1bOB\x1b[1;2C", ["up", "down", "right"]),
        (b"\x1b[5~\x1b[6~\x1b[1~\x1b[7~\x1b[H", ["pageup", "pagedown", "home", "home", "home"]),
        (b"\x1b[1;5D\x1b[1;3D\x1b[5;5~", []),  # with Ctrl or Alt
        # Without a meaning here.
        (b"\x1b[12;40R\x1b[99~\x1b[>1;2c\x1b[<0;3;5M\x1b[119u\x1b[32;1:3u\x00 \x01\xc3\xa4", []),
        # Esc: alone in front of another key it is a stop, and so is Alt with a key, which looks the same.
        (b"\x1bw", ["escape"]),
        (b"\x1b\x1b\x1b[A", ["escape", "escape", "up"]),
        (b"\x1b[\x1b[A", ["escape", "up"]),
        (b"\x1b[" + b"1" * 1000, ["escape", *1000 * ["1"]]),
    ],
)
def test_bytes_become_keys(data: bytes, keys: list[str]) -> None:
    assert parsed(data) == keys
    assert parsed(*(bytes([byte]) for byte in data)) == keys, "byte by byte"


@pytest.mark.parametrize("begun", [b"\x1b", b"\x1b[", b"\x1b[1;"])
def test_unfinished_sequence_becomes_esc(begun: bytes) -> None:
    parser = KeyParser()
    assert parser.feed(begun, 5.0) == []
    assert parser.feed(b"", 5.05) == [], "the rest may still arrive"
    assert (parser.feed(b"", 5.2), parser.feed(b"w", 5.3)) == (["escape"], ["w"])


@settings(deadline=None)
@given(st.lists(st.binary(max_size=40) | st.sampled_from([b"\x1b", b"\x1b[", b"\x1b[?", b"\x1bO", b"u"]), max_size=30))
def test_arbitrary_bytes_neither_fail_nor_accumulate(pieces: list[bytes]) -> None:
    parser = KeyParser()
    for piece in pieces:
        parser.feed(piece, 0.0)
        assert len(parser._rest) < 64
    parser.feed(b"", 1.0)
    assert parser.feed(b"w", 1.0)[-1:] == ["w"]
