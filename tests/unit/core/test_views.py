"""Where the console may listen."""

from __future__ import annotations

import pytest

from hal.errors import CommandError
from hal.views import PORT, Listen


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, ("127.0.0.1", PORT, False)),
        ("0.0.0.0", ("0.0.0.0", PORT, False)),
        ("0.0.0.0:", ("0.0.0.0", PORT, False)),
        ("0.0.0.0:9000", ("0.0.0.0", 9000, True)),
        (":9000", ("127.0.0.1", 9000, True)),
        ("[::1]:9000", ("::1", 9000, True)),
        ("[::1]", ("::1", PORT, False)),
        ("::1", ("::1", PORT, False)),
        ("robot.lab:0", ("robot.lab", 0, True)),
    ],
)
def test_valid_listen_addresses(text: str | None, expected: tuple[str, int, bool]) -> None:
    assert Listen.parse(text) == expected


@pytest.mark.parametrize("text", ["0.0.0.0:port", "[::1", "[::1]9000", "1.2.3.4:70000", "a:-1", "8470"])
def test_invalid_listen_addresses(text: str) -> None:
    with pytest.raises(CommandError):
        Listen.parse(text)
