"""The check of a Franka: against nobody, somebody who does not answer, somebody else's robot, and an emulated one."""

from __future__ import annotations

import importlib.util
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from franka_at_home import address, emulator

from hal.config import load
from hal.drivers.franka import preflight
from hal.drivers.franka.claim import claim_arm
from hal.drivers.franka.emulator.control import Control
from hal.drivers.franka.fault_texts import FLAG_TEXTS
from hal.drivers.franka.preflight import check
from hal.drivers.franka.preflight_network import Answer, Route, knock, resolve, route_to
from hal.drivers.franka.preflight_ping import NotMeasured, RoundTrips, judge, measure
from hal.preflight import CheckResult
from hal.specs import RobotSpec

HOST, EMPTY, MUTE = address(1), address(2), address(3)
BRIEF = 0.05

needs_libraries = pytest.mark.skipif(
    importlib.util.find_spec("pylibfranka") is None or importlib.util.find_spec("panda_py") is None,
    reason="needs the Python packages pylibfranka and panda-python",
)


def rig(host: str = HOST, *overrides: str) -> RobotSpec:
    """The arm of a rig."""
    return load("franka_emulator", overrides=[f"robots.arm.real.host={host}", *overrides]).resolve().robots[0]


def checked(spec: RobotSpec) -> dict[str, CheckResult]:
    return {verdict.name: verdict for verdict in check(spec, BRIEF)}


@pytest.fixture(scope="module")
def robot() -> Iterator[Control]:
    with emulator(HOST, "--robot", "fr3") as control:
        yield control


# Who answers.


def test_nobody_there(capfd: pytest.CaptureFixture[str]) -> None:
    found = checked(rig(EMPTY))
    assert set(found) == {"route", "robot"}, "what cannot be answered is not asked"
    assert found["robot"].level == "fail"
    assert f"{EMPTY}:1337 refuses" in found["robot"].found
    assert f"emulator --host {EMPTY}" in found["robot"].remedy, "an address of this computer: the emulator is missing"


def test_a_real_robot_that_refuses_needs_desk() -> None:
    from dataclasses import replace

    found = checked(replace(rig(EMPTY), emulated=False))
    assert "activate FCI" in found["robot"].remedy


def test_a_name_that_no_network_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preflight, "resolve", lambda host: None)
    (found,) = checked(rig("robot-in-room-7")).values()
    assert found.level == "fail"
    assert "no computer called robot-in-room-7" in found.found
    assert "172.16.0.2" in found.remedy


def test_somebody_who_never_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preflight, "PATIENCE", 1.0)
    with socket.create_server((MUTE, 1337)):
        found = checked(rig(MUTE))
    assert found["robot"].level == "fail"
    assert "nobody answers there" in found["robot"].found
    assert found["hand"].level == "fail"


@needs_libraries
def test_an_emulated_fr3_is_in_order(robot: Control) -> None:
    found = checked(rig())
    assert list(found) == ["route", "robot", "state", "set-points", "hand", "network"]
    assert {name: v.level for name, v in found.items() if name != "network"} == dict.fromkeys(
        ["route", "robot", "state", "set-points", "hand"], "ok"
    )
    assert "protocol 10" in found["robot"].found
    assert robot.send("state")["mode"] == "idle", "and it was left alone"


@needs_libraries
def test_set_points_that_are_reported_with_noise(robot: Control) -> None:
    robot.send("report-noise 0.01")
    try:
        found = checked(rig())
    finally:
        robot.send("report-noise 0")
    assert found["set-points"].level == "fail"
    assert found["state"].level == "ok"


@needs_libraries
@pytest.mark.parametrize(
    ("on", "off", "words"),
    [
        ("reflex joint_reflex", "restart", FLAG_TEXTS["joint_reflex"][0]),
        ("user-stop on", "user-stop off", "user stop is pressed"),
        ("guiding on", "guiding off", "guides the arm by hand"),
    ],
)
def test_a_robot_that_may_not_move_is_a_warning(robot: Control, on: str, off: str, words: str) -> None:
    robot.send(on)
    try:
        found = checked(rig())
    finally:
        robot.send(off)
    assert found["robot"].level == "ok"
    assert found["state"].level == "warn"
    assert words in found["state"].found
    assert found["state"].remedy


@needs_libraries
def test_another_arm_than_the_rig_says(robot: Control) -> None:
    found = checked(rig(HOST, "robots.arm.model=panda", "robots.arm.gripper.enabled=false"))
    assert found["robot"].level == "fail"
    assert "it is an FR3" in found["robot"].found
    assert "model: fr3" in found["robot"].remedy
    assert "state" not in found
    assert "hand" not in found, "the rig has none"


@needs_libraries
def test_no_hand_where_the_rig_has_one(robot: Control) -> None:
    found = checked(rig(HOST, f"robots.arm.gripper.real.host={EMPTY}"))
    assert found["hand"].level == "fail"
    assert "gripper: {enabled: false}" in found["hand"].remedy


@needs_libraries
def test_another_client_holds_the_robot(robot: Control) -> None:
    with socket.create_connection((HOST, 1337)):
        found = checked(rig())
    assert found["robot"].level == "fail"
    assert "another program may hold the arm" in found["robot"].found


def test_another_program_on_this_computer_uses_the_arm() -> None:
    claim = claim_arm(EMPTY)
    try:
        (found,) = checked(rig(EMPTY)).values()
    finally:
        claim.release()
    assert (found.name, found.level) == ("in use", "fail")
    assert "in use by another program" in found.found
    assert "robot" in checked(rig(EMPTY)), "and the check itself lets go"


# The network.


def test_doors_open_closed_and_silent() -> None:
    assert knock(EMPTY, 1337) is Answer.REFUSED
    assert knock("255.255.255.255", 1337) is Answer.NO_WAY
    with socket.create_server((MUTE, 1337), backlog=0) as listener:
        assert knock(MUTE, 1337) is Answer.OPEN
        waiting = []
        for _ in range(5):  # the kernel takes in a few, and then keeps quiet
            one = socket.socket()
            one.setblocking(False)
            one.connect_ex(listener.getsockname())
            waiting.append(one)
        assert knock(MUTE, 1337, timeout=0.2) is Answer.SILENT
        for one in waiting:
            one.close()


def test_names_become_numbers() -> None:
    assert resolve("127.0.5.1") == "127.0.5.1"
    assert resolve("x" * 70) is None


def test_the_way_to_a_robot(tmp_path: Path) -> None:
    (tmp_path / "proc/net").mkdir(parents=True)
    (tmp_path / "proc/net/route").write_text(
        "Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT\n"
        "wlan0 00000000 0101A8C0 0003 0 0 600 00000000 0 0 0\n"
        "eth0 000010AC 00000000 0001 0 0 100 00FFFFFF 0 0 0\n"
        "wlan0 0001A8C0 00000000 0001 0 0 600 00FFFFFF 0 0 0\n"
    )
    (tmp_path / "sys/class/net/wlan0/wireless").mkdir(parents=True)
    assert route_to("172.16.0.2", tmp_path) == Route("eth0", None, False)
    assert route_to("192.168.1.7", tmp_path) == Route("wlan0", None, True)
    assert route_to("172.16.1.2", tmp_path) == Route("wlan0", "192.168.1.1", True)
    assert route_to("172.16.0.2", tmp_path / "nothing") is None
    assert route_to("127.0.5.1", tmp_path) == Route("lo", None, False)


@pytest.mark.parametrize(
    ("route", "level", "word"),
    [
        (Route("eth0", None, False), "ok", "eth0"),
        (Route("eth0", "10.0.0.1", False), "warn", "router 10.0.0.1"),
        (Route("wlan0", None, True), "warn", "radio"),
        (None, "unknown", "does not say"),
    ],
)
def test_only_a_straight_cable_is_ok(
    monkeypatch: pytest.MonkeyPatch, route: Route | None, level: str, word: str
) -> None:
    monkeypatch.setattr(preflight, "route_to", lambda _: route)
    found = checked(rig(EMPTY))["route"]
    assert found.level == level
    assert word in found.found


def may_ping() -> bool:
    try:
        measure("127.0.0.1", 0.01)
    except NotMeasured:
        return False
    return True


@pytest.mark.skipif(not may_ping(), reason="needs net.ipv4.ping_group_range, or the package iputils-ping")
def test_round_trips_are_measured() -> None:
    trips = measure("127.0.5.1", 0.3)
    assert 20 < trips.sent <= 300
    assert 0.0 < trips.quantile(0.5) <= trips.quantile(0.99) <= trips.times[-1]
    assert trips.lost < trips.sent


def test_where_nobody_may_ping_the_program_does_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With what iputils' ping prints: a new one, which allows 2 ms, and an old one, which wants 200 ms."""
    forbid_sockets(monkeypatch)
    program = tmp_path / "ping"
    program.write_text(
        '#!/bin/sh\necho "$@" >> "$0.log"\n'
        'case "$*" in *"-i 0.002"*) echo "ping: cannot flood; minimal interval allowed for user is 200ms" >&2\n'
        "exit 2;; esac\n"
        "echo '1208 bytes from 127.0.5.1: icmp_seq=1 ttl=64 time=0.279 ms'\n"
        "echo '1208 bytes from 127.0.5.1: icmp_seq=2 ttl=64 time=0.224 ms'\n"
        "echo '3 packets transmitted, 2 received, 33.3333% packet loss, time 400ms'\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    trips = measure("127.0.5.1", 0.5)
    assert trips == RoundTrips(3, [0.000224, 0.000279])
    assert trips.lost == 1
    assert "-s 1200" in (tmp_path / "ping.log").read_text()


@needs_libraries
def test_a_network_that_cannot_be_measured_is_unknown_and_says_what_allows_it(
    robot: Control, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forbid_sockets(monkeypatch)
    monkeypatch.setenv("PATH", str(tmp_path))
    found = checked(rig())["network"]
    assert found.level == "unknown"
    assert "sysctl -w net.ipv4.ping_group_range" in found.remedy


def forbid_sockets(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the kernel does where ``ping_group_range`` is empty."""

    class Ordinary(socket.socket):
        def __init__(self, family: int = -1, type: int = -1, proto: int = -1, fileno: int | None = None) -> None:
            if proto == socket.IPPROTO_ICMP:
                raise PermissionError(1, os.strerror(1))
            super().__init__(family, type, proto, fileno)

    monkeypatch.setattr(socket, "socket", Ordinary)


@pytest.mark.parametrize(
    ("trips", "level"),
    [
        (RoundTrips(100, [0.0002] * 100), "ok"),
        (RoundTrips(100, [0.0002] * 99), "warn"),
        (RoundTrips(100, [0.0002] * 98 + [0.0004] * 2), "warn"),
        (RoundTrips(1000, [0.0002] * 999 + [0.0015]), "warn"),
        (RoundTrips(100, [0.0012] * 100), "fail"),
        (RoundTrips(100, []), "unknown"),
    ],
)
def test_round_trips_are_judged_by_the_budget_of_a_cycle(trips: RoundTrips, level: str) -> None:
    found = judge(trips)
    assert found.level == level
    assert (level in ("warn", "fail")) == bool(found.remedy)
