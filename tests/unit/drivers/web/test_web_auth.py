"""Which requests are accepted, and the addresses of the page."""

from __future__ import annotations

import socket

import pytest

from hal.drivers.web.auth import Authenticator, host_names, is_loopback, page_link, ssh_tunnel

TOKEN = "Zm9v-Y_mFy"


@pytest.mark.parametrize(
    ("host", "on_loopback", "outside"),
    [
        ("127.0.0.1:8470", True, True),
        ("127.0.0.1", True, True),
        ("127.0.0.2:8470", True, True),
        ("[::1]:8470", True, True),
        ("localhost:9000", True, True),
        ("LocalHost", True, True),
        ("192.168.1.5:8470", False, True),
        ("[fe80::1]:8470", False, True),
        ("bench:8470", False, True),
        ("BENCH.local", False, True),
        ("attacker.example:8470", False, False),
        ("127.0.0.1.attacker.example", False, False),
        ("localhost.attacker.example", False, False),
        ("localhost.", False, False),
        ("localhost:", False, False),
        ("localhost:84a0", False, False),
        ("localhost@attacker.example", False, False),
        ("2130706433", False, False),
        ("127.1", False, False),
        ("0x7f.1", False, False),
        ("[localhost]", False, False),
        ("::1", False, False),
        ("127.0.0.1 ; script-src *", False, False),
        ("127.0.0.1\n", False, False),
        ("", False, False),
        (None, False, False),
    ],
)
def test_hosts(host: str | None, on_loopback: bool, outside: bool) -> None:
    names = ["Bench", "bench.local"]
    assert Authenticator(TOKEN, "127.0.0.1", names).is_known_host(host) is on_loopback
    assert Authenticator(TOKEN, "0.0.0.0", names).is_known_host(host) is outside


@pytest.mark.parametrize(
    ("origin", "own"),
    [
        ("http://127.0.0.1:8470", True),
        ("HTTP://127.0.0.1:8470", True),
        ("https://127.0.0.1:8470", False),
        ("http://127.0.0.1", False),
        ("http://127.0.0.1:8471", False),
        ("http://localhost:8470", False),
        ("http://attacker.example", False),
        ("null", False),
        ("", False),
        (None, False),
    ],
)
def test_origins(origin: str | None, own: bool) -> None:
    assert Authenticator(TOKEN, "127.0.0.1", []).is_own_origin(origin, "127.0.0.1:8470") is own
    assert not Authenticator(TOKEN, "127.0.0.1", []).is_own_origin(origin, None)


@pytest.mark.parametrize(
    ("offered", "admitted"),
    [
        (f"hal.v1, {TOKEN}", True),
        (f"hal.v1,{TOKEN}", True),
        (f"hal.v1, {TOKEN[:-1]}", False),
        (f"hal.v1, {TOKEN}x", False),
        (f"hal.v1, {TOKEN.lower()}", False),
        ("hal.v1, \udcff\u00e9", False),
        ("hal.v1, ", False),
        ("hal.v1", False),
        (TOKEN, False),
        (f"{TOKEN}, hal.v1", False),
        (f"hal.v1, wrong, {TOKEN}", False),
        ("", False),
        (None, False),
    ],
)
def test_tokens(offered: str | None, admitted: bool) -> None:
    assert Authenticator(TOKEN, "127.0.0.1", []).is_valid_token(offered) is admitted


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


def test_host_names_include_the_own_name() -> None:
    assert socket.gethostname().lower() in host_names()
