"""A served rig behind certificates, from the command line: those who may drive do, intruders see and move nothing."""

from __future__ import annotations

import contextlib
import json
import socket
import ssl
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from errors_kit import raises_code
from keys_kit import end_validity, make_keys
from link_kit import start_server

import hal
from hal.apps.check import main as check
from hal.apps.keys import main
from hal.errors import ConnectionLost, NotSupported
from hal.keys import Credentials
from hal.remote.client import split_address
from hal.types import RobotStatus

pytestmark = pytest.mark.slow
ADDRESS = "127.0.0.2"
STRANGERS = 100
"""Connections of an intruder at the same time."""


class Recorder:
    """Passes connections on, and keeps what the client of the newest one sends."""

    def __init__(self, to: tuple[str, int]) -> None:
        self.sent = b""
        self._server = socket.create_server((ADDRESS, 0))
        self.at = f"{ADDRESS}:{self._server.getsockname()[1]}"
        self._to = to
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            here, there = self._server.accept()[0], socket.create_connection(self._to)
            self.sent = b""
            threading.Thread(target=self._copy, args=(there, here), daemon=True).start()
            threading.Thread(target=self._copy, args=(here, there, True), daemon=True).start()

    def _copy(self, source: socket.socket, to: socket.socket, keep: bool = False) -> None:
        try:
            while data := source.recv(1 << 16):
                self.sent += data if keep else b""
                to.sendall(data)
            to.shutdown(socket.SHUT_WR)
        except OSError:
            pass


def send(to: tuple[str, int], data: bytes, context: ssl.SSLContext | None = None) -> bytes:
    """Send bytes as a stranger; return what the server answers until it closes the connection."""
    sock = socket.create_connection(to, timeout=20.0)
    if context is not None:
        sock = context.wrap_socket(sock)
    answer = b""
    try:
        sock.sendall(data)
        while more := sock.recv(1 << 16):
            answer += more
    except OSError:
        pass
    sock.close()
    return answer


def test_keys_from_the_command_line_and_certificates_that_are_revoked_and_expire(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_keys(tmp_path, ADDRESS)
    become: Callable[[str], None] = lambda who: monkeypatch.setenv("HAL_KEYS", str(tmp_path / who))  # noqa: E731
    become("host")
    server, at = start_server(listen=f"{ADDRESS}:0")
    where: Any = split_address(at)
    rig = {"robots": {"panda": {"at": at}}}
    try:
        for who, code in (
            ("foreign person", "certificate_foreign"),
            ("expired person", "certificate_expired"),
            ("host as person", "certificate_wrong_role"),
        ):
            become(who)
            with raises_code(ConnectionLost, code):
                hal.open(rig, pad="none")
        become("nobody")
        with raises_code(NotSupported, "no_certificates"):
            hal.open(rig, pad="none")

        blind = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        blind.check_hostname, blind.verify_mode = False, ssl.CERT_NONE
        assert send(where, b"\0" * 100, blind) == b"", "no certificate"
        assert b"no_tls" in send(where, b"\0\0\0\x40" + b"\0" * 1000), "1 GB without TLS"
        idle = [socket.create_connection(where) for _ in range(STRANGERS)]  # more than may wait; none says anything

        become("person")
        tap, began = Recorder(where), time.monotonic()
        with hal.open({"robots": {"panda": {"at": tap.at}}}, pad="none") as one:
            opening, arm = time.monotonic() - began, one.robots["panda"]
            arm.move_to(arm.home + [0.1, 0, 0, 0, 0, 0, 0], speed=0.5)
            moved = arm.state().q[0] - arm.home[0]
            assert moved > 0.09
            rest = arm.state().q_set
            assert send(where, tap.sent) != b"", "replayed, answered with a handshake that nobody can finish"
            secured = Credentials("person").wrap(socket.create_connection(where), ADDRESS)
            secured.do_handshake()
            secured.sendall(b"\0\0\0\x40" + b"\0" * 1000)  # 1 GB of somebody with a certificate
            secured.settimeout(20.0)
            while secured.recv(1 << 16):
                pass
            assert (arm.state(1.0).q_set == rest).all()
            capsys.readouterr()
            assert check(["--at", at, "--duration", "0.3", "--json"]) == 0, "the link, while somebody drives over it"
            measured = json.loads(capsys.readouterr().out)
            assert len(measured["link"]["round_trips"]) >= 20
            assert abs(measured["link"]["offset"]) <= measured["link"]["shortest"] / 2.0, "one computer has one clock"
            assert measured["verdicts"][0]["found"].startswith("TLSv1.3")
            become("viewer")
            with hal.open(rig, pad="none") as watched:
                assert (watched.robots["panda"].state().q_set == rest).all()
                with raises_code(NotSupported, "read_only"), watched.robots["panda"].control():
                    pass
                watched.stop()  # of that program, and of no other
            become("person")
            with raises_code(ConnectionLost, "certificate_revoked"), arm.control(rate_hz=5) as control:
                control.send(hal.JointVelocity([0.0] * 7))
                (tmp_path / "host" / "certificates.txt").write_text(revoke(tmp_path, "anna"))
                turn(control)
        with raises_code(ConnectionLost, "certificate_revoked"):
            hal.open(rig, pad="none")

        end_validity(tmp_path / "person" / "person-anna.pem", tmp_path / "home", 2.0 + 2.0 * opening)  # not revoked
        with raises_code(ConnectionLost, "certificate_expired"), hal.open(rig, pad="none") as other:
            begun = other.robots["panda"].state(1.0).q_set
            with other.robots["panda"].control(rate_hz=5) as control:
                turn(control)
        with raises_code(ConnectionLost, "certificate_expired"):
            hal.open(rig, pad="none")
        become("viewer")
        with hal.open(rig, pad="none") as watched:
            state = watched.robots["panda"].state(1.0)
            assert (state.status, state.dq_set.any()) == (RobotStatus.IDLE, False), "held as between two sessions"
            assert state.q_set[0] > begun[0] + 0.01, "it moved until then"
        assert server.poll() is None
        del idle
    finally:
        server.kill()


def turn(control: hal.Control) -> None:
    """Let the arm turn for 30 s, or until the link ends."""
    for _ in range(3000):
        with contextlib.suppress(hal.MotionStopped):  # by a busy computer
            control.send(hal.JointVelocity([0.1, 0, 0, 0, 0, 0, 0]))
        time.sleep(0.01)


def revoke(root: Path, name: str) -> str:
    """Revoke a certificate at the authority; return the list."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HAL_KEYS", str(root / "home"))
        assert main(["revoke", name]) == 0
    return (root / "home" / "certificates.txt").read_text()
