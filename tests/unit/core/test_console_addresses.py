"""Where the console listens, and what a person is told to open."""

from __future__ import annotations

import socket

import pytest

from hal.drivers.web.auth import host_names, is_loopback, page_link, ssh_tunnel
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
def test_what_may_be_asked_for(text: str | None, expected: tuple[str, int, bool]) -> None:
    assert Listen.parse(text) == expected


@pytest.mark.parametrize("text", ["0.0.0.0:port", "[::1", "[::1]9000", "1.2.3.4:70000", "a:-1", "8470"])
def test_what_may_not(text: str) -> None:
    with pytest.raises(CommandError, match="--listen"):
        Listen.parse(text)


def test_the_token_stands_in_the_fragment() -> None:
    assert page_link("127.0.0.1", 8470, "secret") == "http://127.0.0.1:8470/#secret"
    assert page_link("::1", 8470, "secret") == "http://[::1]:8470/#secret"
    assert page_link("0.0.0.0", 80, "secret") == f"http://{socket.gethostname()}:80/#secret"


def test_a_tunnel_keeps_the_port_so_that_the_link_stays_the_same() -> None:
    assert "-L 8470:127.0.0.1:8470 " in ssh_tunnel("127.0.0.1", 8470)
    assert "-L 8470:[::1]:8470 " in ssh_tunnel("::1", 8470)


def test_loopback() -> None:
    assert is_loopback("127.0.0.1")
    assert is_loopback("::1")
    assert is_loopback("localhost")
    assert not is_loopback("0.0.0.0")
    assert not is_loopback("10.0.0.1")


def test_the_machine_knows_its_names() -> None:
    assert socket.gethostname().lower() in host_names()
