"""The bus of the CAN drivers on the kernel's own SocketCAN: vcan0, an interface without a wire.

The contracts of both arms run here as in the fast tests, with the kernel's sockets between driver and emulator.
"""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from hal.drivers.can.bus import CanBus
from hal.drivers.can.interfaces import read_interfaces
from hal.drivers.can.settings import BusSettings
from hal.errors import ConnectionLost, DeviceNotFound
from hal.testing import RobotBench, RobotContract

ROOT = Path(__file__).parents[3]
sys.path += [str(ROOT), str(ROOT / "tests" / "kits")]

import stepped_can  # noqa: E402

from tests.contract.can_arms import piper_arm  # noqa: E402
from tests.contract.damiaos import damiao_arm  # noqa: E402

_FRAME = struct.Struct("=IB3x8s")  # identifier, length, data: linux/can.h
_ERROR_FRAME, _BUS_OFF, _CONTROLLER = 0x20000000, 0x40, 0x04  # linux/can/error.h
_SETTINGS = BusSettings(interface="socketcan", channel="vcan0")
_REOPENING = 10.0
"""Longest time until a bus is open again, s: the machine is slow."""


def _open() -> socket.socket:
    opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    opened.bind(("vcan0",))
    return opened


def _receive(opened: socket.socket) -> tuple[int, bytes]:
    """Return id and data of the next frame."""
    opened.settimeout(2.0)
    id, _, data = _FRAME.unpack(opened.recv(_FRAME.size))
    return id, data


def _set(state: str) -> None:
    subprocess.run(["ip", "link", "set", "vcan0", state], check=True)


@pytest.fixture
def bus() -> Iterator[CanBus]:
    """vcan0, open; up again afterwards."""
    opened = CanBus.acquire(_SETTINGS)
    yield opened
    opened.release()
    _set("up")


def check_vcan() -> None:
    """vcan0 is up, and one program receives what another one sends."""
    assert int(Path("/sys/class/net/vcan0/flags").read_text(), 16) & 1, "the interface is up"
    with _open() as sender, _open() as receiver:
        sender.send(_FRAME.pack(0x123, 8, b"setpoint"))
        assert _receive(receiver) == (0x123, b"setpoint")
    interfaces = read_interfaces()
    assert interfaces is not None
    assert [(one.name, one.up, one.virtual) for one in interfaces if one.name == "vcan0"] == [("vcan0", True, True)]


def check_frames_are_handed_out_by_id(bus: CanBus) -> None:
    """A device gets the frames of its id; the bus's own do not come back, and others are counted."""
    got: list[bytes] = []
    bus.subscribe({0x11: lambda data: got.append(bytes(data))}, (0x01,))
    with _open() as other:
        bus.send(0x01, b"command.")
        assert _receive(other) == (0x01, b"command.")
        for id, data in ((0x11, b"reply..1"), (0x345, b"stranger"), (0x11, b"reply..2")):
            other.send(_FRAME.pack(id, 8, data))
        assert bus.poll()
    assert got == [b"reply..1", b"reply..2"]
    figures = bus.statistics()
    assert (figures["sent"], figures["received"], figures["unexpected_ids"]) == (1, 3, [0x345])
    bus.unsubscribe([0x11])


def check_old_frames_are_drained(bus: CanBus) -> None:
    """What waits in the socket is discarded."""
    got: list[bytes] = []
    bus.subscribe({0x11: lambda data: got.append(bytes(data))}, ())
    with _open() as other:
        for _ in range(50):
            other.send(_FRAME.pack(0x11, 8, b"old....."))
        bus.drain()
        other.send(_FRAME.pack(0x11, 8, b"new....."))
        bus.poll()
    assert got == [b"new....."]
    bus.unsubscribe([0x11])


def check_an_interface_that_goes_down_and_up(bus: CanBus) -> None:
    """It is lost with the command that brings it up, and open again once it is."""
    _set("down")
    with pytest.raises(ConnectionLost) as caught:
        for _ in range(10):
            bus.poll()
            bus.send(0x01, b"........")
    assert caught.value.code == "interface_down"
    assert "ip link set vcan0 up" in str(caught.value)
    assert not bus.poll()
    assert not bus.try_reopen()
    _set("up")
    end = time.monotonic() + _REOPENING
    while not bus.try_reopen():
        assert time.monotonic() < end, "it was not opened again"
        time.sleep(0.01)
    with _open() as other:
        bus.send(0x01, b"again...")
        assert _receive(other) == (0x01, b"again...")


def check_an_interface_that_is_down_or_missing_is_named() -> None:
    """Before anything is sent, with what is there and what to do."""
    _set("down")
    try:
        with pytest.raises(ConnectionLost) as down:
            CanBus.acquire(_SETTINGS).send(0x01, b"........")
    finally:
        CanBus._open_buses.clear()
        _set("up")
    assert down.value.code == "interface_down"
    with pytest.raises(DeviceNotFound) as missing:
        CanBus.acquire(BusSettings(interface="socketcan", channel="can7"))
    assert missing.value.code == "no_interface"
    assert "vcan0" in str(missing.value)


def check_an_interface_that_is_down_is_noticed_by_a_device_that_sends_nothing(bus: CanBus) -> None:
    """The kernel reports it once, to the first reader, which discards old frames."""
    _set("down")
    bus.drain()
    assert not bus.poll()
    assert bus.fault is not None
    assert bus.fault.code == "interface_down"


def check_an_interface_without_can_fd_is_named() -> None:
    """It opens, and refuses the first CAN-FD frame."""
    subprocess.run("ip link set vcan0 down; ip link set vcan0 mtu 16; ip link set vcan0 up", shell=True, check=True)
    try:
        with pytest.raises(ConnectionLost) as refused:
            CanBus.acquire(BusSettings(interface="socketcan", channel="vcan0", fd=True)).send(0x01, b"........")
    finally:
        CanBus._open_buses.clear()
        subprocess.run("ip link set vcan0 down; ip link set vcan0 mtu 72; ip link set vcan0 up", shell=True, check=True)
    assert refused.value.code == "no_can_fd"


def check_error_frames_are_counted_and_bus_off_is_a_loss(bus: CanBus) -> None:
    """A controller with errors is counted; one that took itself off the bus is lost."""
    with _open() as other:
        other.send(_FRAME.pack(_ERROR_FRAME | _CONTROLLER, 8, bytes(8)))
        assert bus.poll()
        assert bus.statistics()["error_frames"] == 1
        other.send(_FRAME.pack(_ERROR_FRAME | _BUS_OFF, 8, bytes(8)))
        assert not bus.poll()
    assert bus.fault is not None
    assert bus.fault.code == "bus_off"


# The contracts of both arms.


class _Piper(RobotContract, left_out={"freeze": "it reports by itself", "torque": "it takes positions only"}):
    pass


class _Damiao(
    RobotContract,
    left_out={"freeze": "a motor answers every frame", "holds": "it has no brakes", "torque": "runs in the fast tests"},
):
    pass


_CHECKS = [
    pytest.param(name, contract, bench, id=f"{arm} {name.removeprefix('test_').replace('_', ' ')}")
    for arm, contract, bench in (("damiao", _Damiao, damiao_arm), ("piper", _Piper, piper_arm))
    for name in dir(contract)
    if name.startswith("test_") and getattr(contract, name) and "block" not in name  # its times are a fast processor's
]


@pytest.mark.parametrize(("name", "contract", "bench"), _CHECKS)
def check_contract(
    name: str,
    contract: type[RobotContract],
    bench: Callable[[], AbstractContextManager[RobotBench]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A check of the contract, over vcan0."""
    overrides = ["cameras={}", "robots.arm.real.interface=socketcan", "robots.arm.real.channel=vcan0"]
    monkeypatch.setattr(stepped_can, "can_overrides", lambda interface: overrides)
    with bench() as made:
        getattr(contract(), name)(made)
