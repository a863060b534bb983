"""A CAN bus that the devices of a process share: who gets which frame, what is counted, and what its errors say."""

from __future__ import annotations

import errno
import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest

from hal.drivers.can.bus import CanBus, bring_up
from hal.drivers.can.settings import BusSettings
from hal.errors import ConfigError, ConnectionLost, DeviceNotFound, DriverMissing, HalError

_numbers = itertools.count()


def settings(**changes: Any) -> BusSettings:
    return BusSettings(**{"interface": "virtual", "channel": f"unit-{next(_numbers)}", **changes})


@pytest.fixture
def bus() -> Iterator[CanBus]:
    """A bus in memory."""
    bus = CanBus.acquire(settings())
    yield bus
    bus.release()


@pytest.fixture
def far(bus: CanBus) -> Iterator[can.BusABC]:
    """The other end of the bus."""
    with can.Bus(interface="virtual", channel=bus.settings.channel) as far:
        yield far


def frame(id: int, data: bytes = b"\x01" * 8) -> can.Message:
    return can.Message(arbitration_id=id, data=data, is_extended_id=False)


def test_devices_of_one_process_share_an_open_bus() -> None:
    wanted = settings()
    first, second = CanBus.acquire(wanted), CanBus.acquire(wanted)
    assert first is second
    first.release()
    second.send(1, bytes(8))
    second.release()
    with pytest.raises(ConnectionLost):
        second.send(1, bytes(8))


def test_another_setting_of_a_shared_bus_is_refused(bus: CanBus) -> None:
    with pytest.raises(ConfigError):
        CanBus.acquire(settings(channel=bus.settings.channel, fd=True))


def test_frames_go_to_their_device_by_id(bus: CanBus, far: can.BusABC) -> None:
    got: dict[int, list[bytes]] = {0x11: [], 0x12: []}
    bus.subscribe({id: lambda data, id=id: got[id].append(bytes(data)) for id in got}, sent=[1, 2])
    for id, value in ((0x12, 2), (0x11, 1), (0x11, 3), (0x2FF, 9), (1, 0)):
        far.send(frame(id, bytes([value] * 8)))
    assert bus.poll()
    assert got == {0x11: [b"\x01" * 8, b"\x03" * 8], 0x12: [b"\x02" * 8]}
    found = bus.statistics()
    assert (found["received"], found["unexpected"], found["unexpected_ids"]) == (5, 1, [0x2FF])


def test_the_bus_s_own_frames_are_no_unexpected_ones() -> None:
    """They come back over UDP multicast."""
    wanted = settings(interface="udp_multicast", channel="239.74.250.1")
    bus = CanBus.acquire(wanted)
    bus.subscribe({0x11: lambda data: None}, sent=[1])
    for _ in range(10):
        bus.send(1, bytes(8))
    deadline = time.monotonic() + 5.0
    while bus.received < 10 and time.monotonic() < deadline:
        bus.poll()
    assert (bus.received, bus.unexpected) == (10, 0)
    bus.release()


def test_two_devices_may_not_have_one_id(bus: CanBus) -> None:
    bus.subscribe({0x11: lambda data: None}, sent=[1])
    bus.subscribe({0x12: lambda data: None}, sent=[2, 0x7FF])
    with pytest.raises(ConfigError):
        bus.subscribe({0x11: lambda data: None}, sent=[3])
    bus.unsubscribe([0x11])
    bus.subscribe({0x11: lambda data: None}, sent=[3])


def test_a_device_may_be_asked_at_the_id_at_which_it_answers(bus: CanBus, far: can.BusABC) -> None:
    got: list[bytes] = []
    handlers = {0x4AF: lambda data: got.append(bytes(data)), 0x11: lambda data: None}
    bus.subscribe(handlers, sent=[0x4AF, 1])
    far.send(frame(0x4AF, bytes(8)))
    bus.poll()
    assert got == [bytes(8)]
    bus.unsubscribe(handlers, [0x4AF, 1])
    bus.subscribe(handlers, sent=[0x4AF, 1])


def test_frames_are_discarded_by_drain(bus: CanBus, far: can.BusABC) -> None:
    for _ in range(700):
        far.send(frame(0x11))
    bus.drain()
    bus.poll()
    assert bus.received == 0


def failing(error: Exception) -> Callable[..., Any]:
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    return fail


@pytest.mark.parametrize(
    ("error", "kind", "code"),
    [
        (OSError(errno.ENETDOWN, "down"), ConnectionLost, "interface_down"),
        (OSError(errno.ENODEV, "no device"), DeviceNotFound, "no_interface"),
        (OSError(errno.EAFNOSUPPORT, "no family"), DeviceNotFound, "no_socketcan"),
        (OSError(errno.EACCES, "not allowed"), DeviceNotFound, "no_permission"),
        (ValueError("bit rate"), ConfigError, "config"),
        (can.CanInitializationError("broken"), ConnectionLost, "bus_lost"),
    ],
)
def test_a_bus_that_does_not_open_says_why(
    monkeypatch: pytest.MonkeyPatch, error: Exception, kind: type[HalError], code: str
) -> None:
    monkeypatch.setattr(can, "Bus", failing(error))
    with pytest.raises(kind) as raised:
        CanBus.acquire(settings(interface="socketcan", channel="can0"))
    assert raised.value.code == code
    if code == "interface_down":
        assert bring_up(settings(interface="socketcan", channel="can0")) in str(raised.value)


def test_an_interface_without_can_fd_is_a_loss_with_the_command_that_sets_it_up(
    bus: CanBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel refuses the first CAN-FD frame, not the opening."""
    monkeypatch.setattr(bus, "settings", settings(interface="socketcan", channel="can0", fd=True))
    monkeypatch.setattr(bus._bus, "send", failing(can.CanOperationError("invalid argument", errno.EINVAL)))
    with pytest.raises(ConnectionLost) as raised:
        bus.send(1, bytes(8))
    assert raised.value.code == "no_can_fd"
    assert bring_up(bus.settings) in str(raised.value)


@pytest.mark.parametrize("interface", ["slcan", "gs_usb"])
def test_a_missing_library_of_an_interface_is_named_with_its_command(
    monkeypatch: pytest.MonkeyPatch, interface: str
) -> None:
    monkeypatch.setattr(can, "Bus", failing(can.CanInterfaceNotImplementedError("no module")))
    with pytest.raises(DriverMissing, match="pip install"):
        CanBus.acquire(settings(interface=interface, channel="0"))


def test_an_interface_that_is_down_is_noticed_when_old_frames_are_discarded(
    bus: CanBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel reports it once, to the first reader."""
    monkeypatch.setattr(bus, "settings", settings(interface="socketcan", channel="can0"))
    monkeypatch.setattr(bus._bus, "recv", failing(can.CanOperationError("down", errno.ENETDOWN)))
    bus.drain()
    monkeypatch.undo()
    assert not bus.poll()
    assert bus.fault is not None
    assert bus.fault.code == "interface_down"


def test_the_command_that_brings_an_interface_up_fits_its_settings() -> None:
    classic = settings(interface="socketcan", channel="can0", bit_rate=500_000)
    assert bring_up(classic) == "sudo ip link set can0 up type can bitrate 500000"
    fast = settings(interface="socketcan", channel="can1", fd=True)
    assert bring_up(fast) == "sudo ip link set can1 up type can bitrate 1000000 dbitrate 5000000 fd on"
    assert bring_up(settings(interface="socketcan", channel="vcan0")) == "sudo ip link set vcan0 up"
    assert bring_up(settings(interface="socketcan", channel="vcan0", fd=True)) == "sudo ip link set vcan0 up mtu 72"


def test_a_full_queue_drops_frames_and_counts_them(bus: CanBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus._bus, "send", failing(can.CanOperationError("full", errno.ENOBUFS)))
    bus.send(1, bytes(8))
    assert (bus.sent, bus.unsent) == (0, 1)
    assert bus.fault is None


def test_bus_off_is_a_loss_with_the_command_that_fixes_it(bus: CanBus, far: can.BusABC) -> None:
    far.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8)))
    assert not bus.poll()
    assert bus.fault is not None
    assert bus.fault.code == "bus_off"
    assert bus.error_frames == 1
    with pytest.raises(ConnectionLost):
        bus.send(1, bytes(8))


def test_a_lost_bus_is_opened_again_by_a_thread(bus: CanBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus._bus, "recv", failing(can.CanOperationError("gone", errno.ENETDOWN)))
    assert not bus.poll()
    assert bus.fault is not None
    assert bus.fault.code == "interface_down"
    deadline = time.monotonic() + 20.0
    while not bus.try_reopen():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert bus.poll()
    assert bus.reopened == 1
