"""The emulator as a program: its start, output, commands, end and pace."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from hal_emulators.control import EmulatorControl
from hal_emulators.franka.__main__ import main

from .franka_kit import Client, Emulator


@pytest.fixture(scope="module")
def _real_time() -> Iterator[Emulator]:
    with Emulator("--q", "0.1", "-0.7", "0", "-2.3", "0", "1.6", "0.8") as emulator:
        yield emulator


@pytest.fixture
def arm(_real_time: Emulator) -> Emulator:
    """An FR3 in real time."""
    _real_time.refresh()
    return _real_time


@pytest.fixture
def client(arm: Emulator) -> Iterator[Client]:
    client = Client(arm.host)
    assert client.reply() == b"\0\x0a\0"
    yield client
    client.close()


def test_it_reports_ready_and_ends_on_request() -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        with Emulator() as emulator:
            (ready,) = [line for line in emulator.lines if "ready:" in line]
            for part in ("FR3", emulator.host, "1337", "no hand", "1339", "protocol 10", "real time", "plant ideal"):
                assert part in ready
            assert emulator.end(number) == 0
            emulator.close()
            assert emulator.lines[-1].endswith("ended")
            assert not any("Traceback" in line for line in emulator.lines)


def test_an_address_that_is_taken_or_foreign_is_one_line(arm: Emulator, capsys: pytest.CaptureFixture[str]) -> None:
    for host, reason in ((arm.host, "Address already in use"), ("192.0.2.1", "Cannot assign requested address")):
        assert main(["--host", host, "--no-hand"]) == 1
        assert capsys.readouterr().err == f"error: cannot listen on {host}:1337: {reason}\n"


def test_invalid_options_are_refused() -> None:
    apart = ["--config", "franka_emulator", "--lockstep", "--unpaced"]
    for options in (["--host", "here"], ["--patience", "0"], ["--robot", "ur5"], apart):
        with contextlib.suppress(SystemExit):  # argparse, with a status of 2
            assert main(options) == 1


def test_commands_that_are_typed(arm: Emulator) -> None:
    arm.type("reflex joint_reflex")
    arm.wait_event("reflex", after=0)
    arm.type("nonsense")
    arm.type("help")
    deadline = time.monotonic() + 5.0
    while not any("silence S" in line for line in arm.lines) and time.monotonic() < deadline:
        time.sleep(0.005)
    assert any("no command 'nonsense'" in line for line in arm.lines)
    assert any("silence S" in line for line in arm.lines)


@pytest.mark.parametrize(
    "line",
    ["", "reflex", "reflex nothing", "silence", "silence -1", "silence x", "lose-states 2", "lose-states next", "log x",
     "version 70000", "place 1 2", "place 9 0 0 0 0 0 0", "guiding", "hand object none", "restart soon", "stall 1e9"],
)  # fmt: skip
def test_invalid_commands_are_refused_with_a_message(arm: Emulator, line: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        arm.control.send(line)
    assert arm.control.send("state")["mode"] == "idle"


def test_the_control_port_answers_each_line(arm: Emulator) -> None:
    with socket.create_connection((arm.host, 1339), 5.0) as connection:
        answers = connection.makefile()
        connection.sendall(b"user-stop on\nuser-stop off\nbroken\n\n")
        found = [answers.readline() for _ in range(4)]
        assert found[:2] == ['{"ok": true}\n'] * 2
        assert all('"ok": false' in answer for answer in found[2:])
    assert arm.control.send("state")["mode"] == "idle"


def test_states_come_every_millisecond_and_the_numbers_go_up(arm: Emulator, client: Client) -> None:
    client.udp.recv(2000)
    began = time.monotonic()
    numbers = [struct.unpack_from("<Q", client.udp.recv(2000))[0] for _ in range(100)]
    took = time.monotonic() - began
    assert numbers == list(range(numbers[0], numbers[0] + 100))
    assert took > 0.05
    stats = arm.control.send("stats")
    assert stats["states"] >= 100
    assert 0.0 < stats["lateness"]["p50"] <= stats["lateness"]["max"]


def test_its_own_stalls_are_written_down(arm: Emulator, client: Client) -> None:
    before = time.monotonic()
    arm.control.send("stall 0.1")
    after = time.monotonic()
    client.udp.recv(2000)
    stalls = [stall for stall in arm.control.send("stats")["stalls"] if before <= stall["t"] <= after]
    assert any(stall["length"] > 0.09 for stall in stalls)


def test_what_is_no_request_ends_the_connection_and_not_the_emulator(arm: Emulator) -> None:
    for data in (
        b"\xff" * 12,
        struct.pack("<III", 0, 0, 5),
        struct.pack("<III", 99, 0, 12),
        struct.pack("<III", 1, 0, 12),
    ):
        with socket.create_connection((arm.host, 1337), 5.0) as connection:
            connection.sendall(data)
            assert connection.recv(100) == b""
    assert arm.control.send("state")["connected"] is False


def test_requests_in_pieces_of_the_wrong_size_and_commands_that_are_none(arm: Emulator, client: Client) -> None:
    request = struct.pack("<III", 4, 1, 68) + struct.pack("<7d", *[1000.0] * 7)
    for k in range(len(request)):
        client.tcp.sendall(request[k : k + 1])
    assert client.reply() == b"\0"
    client.send(4, bytes(48))
    assert client.reply() == b"\2"  # invalid argument
    _, place = client.udp.recvfrom(2000)
    for size in (0, 10, 370, 1000):
        client.udp.sendto(bytes(size), place)
    while arm.control.send("stats")["malformed"] < 4:
        client.udp.recv(2000)
    assert arm.control.send("state")["mode"] == "idle"


def test_a_client_that_is_killed_makes_room_at_once(arm: Emulator, client: Client) -> None:
    client.close()
    again = Client(arm.host)
    try:
        assert again.reply()[0] == 0
    finally:
        again.close()


def test_a_client_that_never_connects_properly_blocks_no_other(arm: Emulator) -> None:
    with socket.create_connection((arm.host, 1337), 5.0):
        welcome = False
        deadline = time.monotonic() + 5.0
        while not welcome and time.monotonic() < deadline:
            client = Client(arm.host)
            with contextlib.suppress(OSError, struct.error):  # turned away
                welcome = client.reply()[0] == 0
            client.close()
            time.sleep(0.05)
        assert welcome


def test_kill_is_sudden() -> None:
    with Emulator() as emulator:
        emulator.control.send("kill")
        assert emulator.process.wait(5) == -signal.SIGKILL


def test_output_that_is_not_read_does_not_block_it() -> None:
    """A closed pipe is no reason to stop serving."""
    reading, writing = os.pipe()
    host = "127.0.1.251"
    process = subprocess.Popen(
        [sys.executable, "-m", "hal_emulators.franka", "--host", host, "--no-hand"],
        stdin=subprocess.DEVNULL,
        stdout=writing,
    )
    os.close(writing)
    try:
        assert select.select([reading], [], [], 20.0)[0]
        os.close(reading)
        with EmulatorControl(host) as control:
            for _ in range(3):
                control.send("user-stop on")
            assert control.send("state")["mode"] == "user_stopped"
    finally:
        process.terminate()
        assert process.wait(5) == 0


def test_in_lock_step_a_client_that_does_not_answer_is_waited_for_and_then_given_up() -> None:
    with Emulator("--lockstep", "--patience", "0.5") as emulator:
        client = Client(emulator.host)
        client.reply()
        client.send(1, struct.pack("<II6d", 0, 0, *[1.0] * 6) + bytes(57))
        assert client.reply() == b"\1"
        while True:
            state, place = client.udp.recvfrom(2000)
            if state[1288] == 1:  # a joint position generator runs
                break
        number, q = struct.unpack_from("<Q", state)[0], struct.unpack_from("<7f", state, 596)
        began = time.monotonic()
        client.udp.sendto(struct.pack("<Q7d", number, *q) + bytes(307), place)
        assert client.reply() == b"\x08"  # by a reflex
        took = time.monotonic() - began
        assert 0.5 <= took < 3.0
        assert emulator.control.send("state")["errors"] == ["communication_constraints_violation"]
        client.close()
