"""Certificates: who is let in, over sockets, and in which words everybody else is refused; the command ``hal keys``."""

from __future__ import annotations

import contextlib
import socket
import ssl
import stat
import threading
import time
from pathlib import Path

import pytest
from errors_kit import raises_code
from keys_kit import make_keys

from hal.apps.keys import main
from hal.errors import CommandError, ConnectionLost, DriverMissing, HalError, NotSupported, PolicyError
from hal.keys import Credentials, find_key, hang_up, make_key, revoke
from hal.learning.remote import PolicyClient, PolicyServer

AT = "127.0.0.2"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one folder of keys for each kind of person and host."""
    root = tmp_path_factory.mktemp("keys")
    make_keys(root, AT)
    return root


def connect(root: Path, host: str, person: str, patch: pytest.MonkeyPatch) -> tuple[list[HalError], list[HalError]]:
    """Connect the keys of a person with those of a host; return the errors of either end."""
    errors: tuple[list[HalError], list[HalError]] = ([], [])
    patch.setenv("HAL_KEYS", str(root / host))
    here = Credentials("host")
    patch.setenv("HAL_KEYS", str(root / person))
    there = Credentials("person")
    with socket.create_server((AT, 0)) as server:

        def serve() -> None:
            secured = here.wrap(server.accept()[0])
            try:
                here.shake(secured, "the person")
                secured.sendall(b"in")
                hang_up(secured)
            except HalError as error:
                errors[0].append(error)

        thread = threading.Thread(target=serve)
        thread.start()
        secured = there.wrap(socket.create_connection(server.getsockname()), AT)
        try:
            there.shake(secured, AT)
            assert secured.recv(2) == b"in"
            there.check(secured.getpeercert() or {}, AT)
        except HalError as error:
            errors[1].append(error)
        except ssl.SSLError as error:
            errors[1].append(there.explain(error, AT))
        finally:
            secured.close()
        thread.join()
    return errors


@pytest.mark.parametrize(
    ("host", "person", "code"),
    [
        ("foreign host", "person", "certificate_foreign"),
        ("host", "foreign person", "certificate_foreign"),
        ("other host", "person", "certificate_wrong_name"),
        ("expired host", "person", "certificate_expired"),
        ("host", "expired person", "certificate_expired"),
        ("person as host", "person", "certificate_wrong_role"),
        ("host", "host as person", "certificate_wrong_role"),
    ],
)
def test_each_end_says_what_is_wrong_and_what_to_do(
    made: Path, host: str, person: str, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for errors in connect(made, host, person, monkeypatch):
        assert [(type(error), error.code) for error in errors] == [(ConnectionLost, code)]
        assert "hal keys make" in str(errors[0]) or code == "certificate_wrong_name"


def test_those_with_fitting_certificates_are_let_in(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert connect(made, "host", "person", monkeypatch) == ([], [])


@pytest.mark.parametrize(
    ("sent", "code"),
    [(b"GET / HTTP/1.0\r\n\r\n", "no_tls"), (b"\x16\x03\x01\x02", "no_tls"), (None, "certificate_missing")],
    ids=["no TLS", "slow", "no certificate"],
)
def test_strangers_are_refused_within_the_time_of_a_handshake(
    made: Path, sent: bytes | None, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HAL_KEYS", str(made / "host"))
    monkeypatch.setattr("hal.keys.HANDSHAKE_LIMIT", 0.2)
    host = Credentials("host")
    with socket.create_server((AT, 0)) as server:
        stranger = socket.create_connection(server.getsockname())
        if sent is None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
            secured = context.wrap_socket(stranger, do_handshake_on_connect=False)
            threading.Thread(target=secured.do_handshake).start()
        else:
            stranger.sendall(sent)
        with raises_code(ConnectionLost, code):
            host.shake(host.wrap(server.accept()[0]), "the stranger")
        stranger.close()


def test_a_certificate_ends_while_it_is_in_use(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HAL_KEYS", str(made / "host"))
    host = Credentials("host")
    known = {"subject": ((("commonName", "anna"),),), "serialNumber": "1F", "notAfter": "Jan  1 00:00:00 2100 GMT"}
    assert host.check(known, "there") == "anna"
    later = time.time() + 200 * 365 * 86400
    monkeypatch.setattr("hal.keys.time.time", lambda: later)
    with raises_code(ConnectionLost, "certificate_expired"):
        host.check(known, "there")


def test_keys_are_private_listed_and_revoked_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "keys"
    monkeypatch.setenv("HAL_KEYS", str(folder))
    assert main(["make", "--host", "arm-pc", "--person", "anna", "--days", "30"]) == 0
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in folder.iterdir()} == {0o600}
    authority = (folder / "authority.crt").read_text()
    make_key("person", "bob")
    assert (folder / "authority.crt").read_text() == authority
    assert main(["revoke", "anna"]) == 0
    capsys.readouterr()
    assert main(["list"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [(line[1], line[4:]) for line in lines] == [("arm-pc", []), ("anna", ["revoked"]), ("bob", [])]
    with raises_code(CommandError, "unknown_name"):
        revoke("carl")
    with raises_code(NotSupported, "many_certificates"):
        find_key("person")
    find_key("host").chmod(0o640)
    with raises_code(NotSupported, "keys_readable"):
        find_key("host")
    (folder / "authority.key").unlink()  # as on a host: another authority would replace what works
    before = (folder / "host-arm-pc.pem").read_bytes()
    with raises_code(CommandError, "no_authority"):
        make_key("host", "arm-pc")
    assert (folder / "host-arm-pc.pem").read_bytes() == before


@pytest.mark.parametrize("arguments", [["make", "--person", "../x"], ["make", "--person", "x", "--days", "0"]])
def test_wrong_arguments_make_nothing(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HAL_KEYS", str(tmp_path / "keys"))
    assert main(arguments) == 2
    assert not (tmp_path / "keys").exists()


def test_a_computer_without_openssl_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HAL_KEYS", str(tmp_path / "keys"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DriverMissing, match="apt install openssl"):
        make_key("person", "anna")


@pytest.mark.parametrize(
    ("host", "person", "code"),
    [
        ("host", "person", None),
        ("host", "foreign person", "certificate_foreign"),
        ("host", "expired person", "policy_unreachable"),
        ("foreign host", "person", "certificate_foreign"),
        ("other host", "person", "certificate_wrong_name"),
        ("revoking host", "person", "policy_error"),
        ("host", "viewer", "policy_error"),
    ],
)
def test_a_policy_is_served_to_those_with_certificates(
    made: Path, host: str, person: str, code: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("msgpack")
    monkeypatch.setenv("HAL_KEYS", str(made / host))
    with PolicyServer(lambda request: {"got": request["x"]}, host=AT, credentials=Credentials("host")) as server:
        monkeypatch.setenv("HAL_KEYS", str(made / person))
        with contextlib.closing(PolicyClient(server.url)) as client:
            if code is not None:
                with raises_code(PolicyError, code):
                    client.connect()
                return
            client.connect()
            assert client.request({"x": 3}).result(10.0) == {"got": 3}
