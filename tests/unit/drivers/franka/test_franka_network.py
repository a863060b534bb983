"""Network path to a Franka, and the pre-flight checks that need no robot."""

from __future__ import annotations

import os
import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from hal.config import load
from hal.drivers.franka import preflight
from hal.drivers.franka.network import (
    NotMeasured,
    PortState,
    RoundTrips,
    Route,
    lock_arm,
    measure_round_trips,
    probe_port,
    resolve_host,
    route_to,
)
from hal.drivers.franka.preflight import check, rate_round_trips
from hal.preflight import CheckResult
from hal.preflight import preflight as check_rig
from hal.specs import RobotSpec

_PID = os.getpid()
EMPTY, MUTE = (f"127.{k}.{_PID >> 8 & 0xFF}.{_PID & 0xFF}" for k in (6, 7))
"""Loopback addresses that no other test process uses."""


def rig(host: str = EMPTY, *overrides: str) -> RobotSpec:
    return load("franka_emulator", overrides=[f"robots.arm.real.host={host}", *overrides]).resolve().robots[0]


def checked(spec: RobotSpec) -> dict[str, CheckResult]:
    return {result.name: result for result in check(spec, 0.05)}


# Checks without a robot.


def test_a_refused_port_ends_the_check_with_the_way_to_start_the_emulator_or_fci() -> None:
    found = checked(rig())
    assert (list(found), found["robot"].level) == (["route", "robot"], "fail")
    assert f"hal emulate franka --host {EMPTY}" in found["robot"].remedy
    assert "FCI" in checked(replace(rig(), emulated=False))["robot"].remedy


def test_an_unknown_host_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preflight, "resolve_host", lambda host: None)
    (found,) = checked(rig("robot-in-room-7")).values()
    assert (found.name, found.level) == ("address", "fail")
    assert "robot-in-room-7" in found.found


def test_a_robot_that_accepts_and_never_answers_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
    monkeypatch.setattr(preflight, "PATIENCE", 1.0)
    with socket.create_server((MUTE, 1337)):
        found = checked(rig(MUTE))
    assert (found["robot"].level, found["hand"].level) == ("fail", "fail")


def test_an_arm_that_another_program_uses_is_not_checked_further() -> None:
    lock = lock_arm(EMPTY)
    try:
        plan = load("franka_emulator", overrides=[f"robots.arm.real.host={EMPTY}"]).resolve()
        (found,) = (one for one in check_rig(plan, 0.05, machine=False) if one.name.startswith("arm:"))
    finally:
        lock.release()
    assert (found.name, found.level) == ("arm: in use", "fail")
    assert "robot" in checked(rig()), "the check releases its own lock"


@pytest.mark.parametrize(
    ("route", "level", "word"),
    [
        (Route("eth0", None, False), "ok", "eth0"),
        (Route("eth0", "10.0.0.1", False), "warn", "10.0.0.1"),
        (Route("wlan0", None, True), "warn", "radio"),
        (None, "unknown", ""),
    ],
)
def test_only_a_direct_cable_is_ok(monkeypatch: pytest.MonkeyPatch, route: Route | None, level: str, word: str) -> None:
    monkeypatch.setattr(preflight, "route_to", lambda _: route)
    found = checked(rig())["route"]
    assert found.level == level
    assert word in found.found


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
def test_round_trips_are_rated_by_the_budget_of_a_cycle(trips: RoundTrips, level: str) -> None:
    found = rate_round_trips(trips)
    assert (found.level, level in ("warn", "fail")) == (level, bool(found.remedy))


# The network.


def test_ports_open_refused_silent_and_without_a_route() -> None:
    assert probe_port(EMPTY, 1337) is PortState.REFUSED
    assert probe_port("255.255.255.255", 1337) is PortState.NO_ROUTE
    with socket.create_server((MUTE, 1337), backlog=0) as listener:
        assert probe_port(MUTE, 1337) is PortState.OPEN
        waiting = []
        for _ in range(5):  # the kernel accepts a few, then drops the rest
            one = socket.socket()
            one.setblocking(False)
            one.connect_ex(listener.getsockname())
            waiting.append(one)
        assert probe_port(MUTE, 1337, timeout=0.2) is PortState.SILENT
        for one in waiting:
            one.close()


def test_host_names_are_resolved() -> None:
    assert resolve_host("127.0.5.1") == "127.0.5.1"
    assert resolve_host("x" * 70) is None


def test_the_route_is_the_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert route_to("127.0.5.1") == Route("lo", None, False)
    answers = {
        "172.16.0.2": '[{"dst":"172.16.0.2","dev":"eth0","prefsrc":"172.16.0.1","flags":[],"uid":0,"cache":[]}]',
        "192.168.1.7": '[{"dst":"192.168.1.7","dev":"wlan0","prefsrc":"192.168.1.2","flags":[],"uid":0,"cache":[]}]',
        "172.16.1.2": '[{"dst":"172.16.1.2","gateway":"192.168.1.1","dev":"wlan0","flags":[],"uid":0,"cache":[]}]',
    }

    def run(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        if words[-1] not in answers:  # as without a network that leads there
            raise subprocess.CalledProcessError(2, words)
        return subprocess.CompletedProcess(words, 0, answers[words[-1]])

    monkeypatch.setattr(subprocess, "run", run)
    (tmp_path / "wlan0/wireless").mkdir(parents=True)
    assert route_to("172.16.0.2", tmp_path) == Route("eth0", None, False)
    assert route_to("192.168.1.7", tmp_path) == Route("wlan0", None, True)
    assert route_to("172.16.1.2", tmp_path) == Route("wlan0", "192.168.1.1", True)
    assert route_to("203.0.113.1", tmp_path) is None


def may_ping() -> bool:
    try:
        measure_round_trips("127.0.0.1", 0.01)
    except NotMeasured:
        return False
    return True


@pytest.mark.skipif(not may_ping(), reason="needs net.ipv4.ping_group_range")
def test_round_trips_are_measured() -> None:
    trips = measure_round_trips("127.0.5.1", 0.3)
    assert 20 < trips.sent <= 300
    assert 0.0 < trips.quantile(0.5) <= trips.quantile(0.99) <= trips.times[-1]
    assert trips.lost < trips.sent


def test_without_permission_nothing_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    forbid_icmp(monkeypatch)
    with pytest.raises(NotMeasured):
        measure_round_trips("127.0.5.1", 0.5)


def forbid_icmp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse ICMP sockets, as the kernel does where ``ping_group_range`` is empty."""

    class NoIcmpSocket(socket.socket):
        def __init__(self, family: int = -1, type: int = -1, proto: int = -1, fileno: int | None = None) -> None:
            if proto == socket.IPPROTO_ICMP:
                raise PermissionError(1, os.strerror(1))
            super().__init__(family, type, proto, fileno)

    monkeypatch.setattr(socket, "socket", NoIcmpSocket)
