"""Which requests are accepted, and the addresses of the page."""

from __future__ import annotations

import socket

import pytest

from hal.auth import Authenticator, host_names, is_loopback, page_link, ssh_tunnel

TOKEN = "Zm9v-Y_mFy"


LOOPBACK = ["127.0.0.1:8470", "127.0.0.1", "127.0.0.2:8470", "[::1]:8470", "localhost:9000", "LocalHost"]
OUTSIDE = ["192.168.1.5:8470", "[fe80::1]:8470", "bench:8470", "BENCH.local"]
FOREIGN = ["attacker.example:8470", "127.0.0.1.attacker.example", "localhost.attacker.example", "localhost.", "::1"]
FOREIGN += ["localhost:", "localhost:84a0", "localhost@attacker.example", "2130706433", "127.1", "0x7f.1", ""]
FOREIGN += ["[localhost]", "127.0.0.1 ; script-src *", "127.0.0.1\n"]


@pytest.mark.parametrize("host", [*LOOPBACK, *OUTSIDE, *FOREIGN, None])
def test_hosts(host: str | None) -> None:
    names = ["Bench", "bench.local"]
    assert Authenticator(TOKEN, "127.0.0.1", names).is_known_host(host) is (host in LOOPBACK)
    assert Authenticator(TOKEN, "0.0.0.0", names).is_known_host(host) is (host in LOOPBACK + OUTSIDE)


OWN_ORIGINS = ["http://127.0.0.1:8470", "HTTP://127.0.0.1:8470"]
FOREIGN_ORIGINS = ["https://127.0.0.1:8470", "http://127.0.0.1", "http://127.0.0.1:8471", "http://localhost:8470"]
FOREIGN_ORIGINS += ["http://attacker.example", "null", ""]


@pytest.mark.parametrize("origin", [*OWN_ORIGINS, *FOREIGN_ORIGINS, None])
def test_origins(origin: str | None) -> None:
    authenticator = Authenticator(TOKEN, "127.0.0.1", [])
    assert authenticator.is_own_origin(origin, "127.0.0.1:8470") is (origin in OWN_ORIGINS)
    assert not authenticator.is_own_origin(origin, None)


VALID = [f"hal.v1, {TOKEN}", f"hal.v1,{TOKEN}"]
INVALID = [f"hal.v1, {TOKEN[:-1]}", f"hal.v1, {TOKEN}x", f"hal.v1, {TOKEN.lower()}", "hal.v1, \udcff\u00e9", "hal.v1, "]
INVALID += ["hal.v1", TOKEN, f"{TOKEN}, hal.v1", f"hal.v1, wrong, {TOKEN}", ""]


@pytest.mark.parametrize("offered", [*VALID, *INVALID, None])
def test_tokens(offered: str | None) -> None:
    assert Authenticator(TOKEN, "127.0.0.1", []).is_valid_token(offered) is (offered in VALID)


def test_the_token_stands_in_the_fragment() -> None:
    assert page_link("127.0.0.1", 8470, "secret") == "http://127.0.0.1:8470/#secret"
    assert page_link("::1", 8470, "secret") == "http://[::1]:8470/#secret"
    assert page_link("0.0.0.0", 80, "secret") == f"http://{socket.gethostname()}:80/#secret"


def test_a_tunnel_keeps_the_port_so_that_the_link_stays_the_same() -> None:
    assert "-L 8470:127.0.0.1:8470 " in ssh_tunnel("127.0.0.1", 8470)
    assert "-L 8470:[::1]:8470 " in ssh_tunnel("::1", 8470)


def test_loopback() -> None:
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost")] == [True] * 3
    assert [is_loopback(host) for host in ("0.0.0.0", "10.0.0.1")] == [False] * 2


def test_host_names_include_the_own_name() -> None:
    assert socket.gethostname().lower() in host_names()
