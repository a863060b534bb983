"""CAN interfaces as ``ip -details -json link`` lists them: whether they are set up as the rig has it, and bus load."""

from __future__ import annotations

import importlib.util
import json
from typing import Any

import can
import pytest

from hal.apps.check import main as check_program
from hal.drivers.can import interfaces, preflight
from hal.drivers.can.bus import CanBus
from hal.drivers.can.interfaces import CanInterface, list_buses, parse_links, read_interfaces
from hal.drivers.can.preflight import bus_load, check_damiao, check_piper, judge_interface
from hal.drivers.can.settings import BusSettings, check_piper_arm
from hal.errors import ConfigError, DeviceNotFound, HalError
from hal.testing import robot_spec


def link(name: str = "can0", up: bool = True, kind: str = "can", **data: Any) -> dict[str, Any]:
    """Return an interface as iproute2 6.1 lists it; ``data`` are fields of its ``info_data``."""
    usual = {
        "state": "ERROR-ACTIVE" if up else "STOPPED",
        "restart_ms": 0,
        "bittiming": {"bitrate": 1_000_000, "sample_point": "0.750"},
        "bittiming_const": {"name": "gs_usb", "tseg1": {"min": 1, "max": 16}},
        "clock": 48_000_000,
    }
    return {
        "ifindex": 4,
        "ifname": name,
        "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"] if up else ["NOARP", "ECHO"],
        "operstate": "UP" if up else "DOWN",
        "link_type": "can",
        "linkinfo": {"info_kind": kind, "info_data": {} if kind == "vcan" else {**usual, **data}},
    }


LOOPBACK = {"ifname": "lo", "flags": ["LOOPBACK", "UP"], "link_type": "loopback"}
FD = {"data_bittiming": {"bitrate": 5_000_000}}


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that prepares the answer of ``ip``."""

    def prepare(*links: dict[str, Any] | None) -> None:
        text = None if links == (None,) else json.dumps([LOOPBACK, *links])
        monkeypatch.setattr(interfaces, "_run_ip", lambda: text)

    return prepare


def settings(**options: Any) -> BusSettings:
    return BusSettings(interface="socketcan", channel="can0", **options)


def test_an_answer_of_ip_is_read() -> None:
    text = json.dumps([LOOPBACK, link(), link("can1", up=False, **FD), link("vcan0", kind="vcan")])
    assert parse_links(text) == (
        CanInterface("can0", True, False, 1_000_000, None, "ERROR-ACTIVE", "gs_usb"),
        CanInterface("can1", False, False, 1_000_000, 5_000_000, "STOPPED", "gs_usb"),
        CanInterface("vcan0", True, True),
    )
    assert parse_links("") == parse_links("[]") == parse_links('Object "-json" is unknown') == ()


@pytest.mark.parametrize(
    ("found", "options", "level", "words", "remedy"),
    [
        (link(), {}, "ok", "1000000 bit/s", ""),
        (link("can0", kind="vcan"), {}, "ok", "up", ""),
        (link(up=False), {}, "fail", "can0 is down", "ip link set can0 up type can bitrate 1000000"),
        (
            link(bittiming={"bitrate": 500_000}),
            {},
            "fail",
            "500000 bit/s, the rig has 1000000",
            "ip link set can0 down; sudo ip link set can0 up type can bitrate 1000000",
        ),
        (link(), {"fd": True}, "fail", "no CAN-FD", "dbitrate 5000000 fd on"),
        (link(**FD), {"fd": True}, "ok", "data 5000000 bit/s", ""),
        (link(**FD), {"fd": True, "data_bit_rate": 2_000_000}, "fail", "data bit rate of 5000000", "dbitrate 2000000"),
        (link(state="BUS-OFF"), {}, "fail", "bus-off", "termination"),
        (link(state="ERROR-PASSIVE"), {}, "warn", "ERROR-PASSIVE", "termination"),
    ],
)
def test_an_interface_is_compared_with_the_rig(
    found: dict[str, Any], options: dict[str, Any], level: str, words: str, remedy: str
) -> None:
    interface = parse_links(json.dumps([found]))[0]
    result = judge_interface(interface, settings(**options))
    assert result.level == level
    assert words in result.found
    assert remedy in result.remedy
    assert bool(result.remedy) == (level != "ok")


@pytest.mark.parametrize("check", [check_damiao, check_piper])
@pytest.mark.parametrize(
    ("links", "words", "remedy"),
    [
        ((), "no CAN interface can0; interfaces: none", "--can"),
        ((link("can1"),), "interfaces: can1", "--can"),
        ((link(up=False),), "can0 is down", "ip link set can0 up"),
        ((link(bittiming={"bitrate": 250_000}),), "250000", "bitrate 1000000"),
    ],
)
def test_a_wrong_interface_ends_the_check_before_it_is_opened(
    check: Any, links: Any, words: str, remedy: str, answer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preflight.CanBus, "acquire", lambda settings: pytest.fail("the bus was opened"))
    answer(*links)
    motors = [{"id": 1, "type": "DM4310", "kp": 10, "kd": 1}]
    options = {"interface": "socketcan", "channel": "can0", **({"motors": motors} if check is check_damiao else {})}
    results = list(check(robot_spec(1, options=options), 0.1))
    assert [result.level for result in results] == ["fail"]
    assert words in results[0].found
    assert remedy in results[0].remedy


def test_the_list_of_buses_has_the_command_that_brings_one_up(answer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interfaces, "_other_adapters", lambda: [{"interface": "slcan", "channel": "/dev/ttyACM0"}])
    answer(link(), link("can1", up=False), link("vcan0", up=False, kind="vcan"))
    first, second, third, fourth = list_buses()
    assert "up, 1000000 bit/s" in first
    assert "ip link" not in first
    assert "down" in second
    assert "sudo ip link set can1 up type can bitrate 1000000" in second
    assert "sudo ip link set vcan0 up" in third
    assert fourth.split() == ["/dev/ttyACM0", "slcan"]


def test_without_ip_nothing_is_invented(answer: Any) -> None:
    answer(None)
    assert read_interfaces() is None


def test_the_bus_load_is_that_of_its_frames() -> None:
    """7 motors at 250 Hz: 455 kbit/s; a PiPER alone 40 %; CAN-FD needs less than half of the time."""
    assert bus_load(2 * 7 * 250, settings()) == pytest.approx(0.455)
    assert 0.38 < bus_load(3040, settings()) < 0.42
    assert bus_load(1000, settings(fd=True)) < 0.5 * bus_load(1000, settings())


@pytest.mark.parametrize(
    ("options", "error", "code"),
    [
        ({"interface": "socketcan", "channel": "can77"}, DeviceNotFound, {"no_interface", "no_socketcan"}),
        ({"interface": "socketcam", "channel": "can0"}, ConfigError, {"unknown_interface"}),
        (
            {"interface": "robotell", "channel": "COM1", "bus": {"nosuch": 1}},
            HalError,
            {"bad_bus", "bus_lost", "driver_missing"},
        ),
    ],
)
def test_a_bus_that_cannot_be_opened_is_named(options: Any, error: type[HalError], code: set[str]) -> None:
    with pytest.raises(error) as caught:
        CanBus.acquire(BusSettings(**options))
    codes = {problem.code for problem in caught.value.problems} if isinstance(caught.value, ConfigError) else set()
    assert (codes or {caught.value.code}) <= code
    assert options["interface"] in str(caught.value)


def test_a_bit_rate_that_the_adapter_cannot_do_is_a_mistake_of_the_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    """As python-can's interface of serial adapters refuses it."""

    def refuse(**_: Any) -> None:
        raise ValueError("Invalid bitrate, choose one of 10000 20000 50000 100000 125000 250000 500000 750000 1000000")

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(ConfigError) as caught:
        CanBus.acquire(BusSettings(interface="slcan", channel="/dev/ttyACM0", bus={"bitrate": 300_000}))
    assert [problem.code for problem in caught.value.problems] == ["bad_bus"]
    assert "choose one of" in str(caught.value)


def test_a_multicast_channel_must_be_a_multicast_address() -> None:
    spec = robot_spec(6, rate_hz=200.0, options={"interface": "udp_multicast", "channel": "192.168.0.1"})
    assert [(key, code) for key, _, code in check_piper_arm(spec)] == [("real", "invalid")]


def test_the_program_lists_the_buses(
    answer: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(interfaces, "_other_adapters", list)
    answer(link("can1", up=False))
    assert check_program(["--can"]) == 0
    assert "sudo ip link set can1 up" in capsys.readouterr().out
    answer()
    assert check_program(["--can"]) == 2
    assert "no CAN interface" in capsys.readouterr().out


def test_the_program_names_every_driver_whose_library_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "can" else find_spec(name))
    assert check_program(["--can"]) == 2
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("damiao", "piper", "pip install 'robot-hal[can]'"))
