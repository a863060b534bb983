"""Finding input devices: periodic scans, and the devices in sysfs."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import pytest

from hal.drivers.evdev.finder import DeviceFinder, LinuxInput, lock_device
from hal.drivers.evdev.pad import EvdevPad
from hal.pads.codes import BUS_USB
from hal.pads.model import Identity


class Machine(LinuxInput):
    """The input devices of this machine, in a folder of the test."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "sys", folder / "dev")


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    (tmp_path / "dev").mkdir()
    (tmp_path / "sys").mkdir()
    return tmp_path


def plug(machine: Path) -> None:
    (machine / "sys" / "event0" / "device").mkdir(parents=True)
    (machine / "dev" / "event0").touch()


def test_devices_and_their_permissions_are_found_within_a_moment(machine: Path) -> None:
    finder = DeviceFinder(Machine(machine))
    assert finder.scan() == []
    assert not finder.due()
    plug(machine)
    assert until_found(finder) == [str(machine / "dev" / "event0")]
    assert finder.scan() is None, "nothing changed"
    (machine / "dev" / "event0").chmod(0o640)  # udev, a moment after the kernel made it
    assert until_found(finder)


def test_folder_may_come_and_go(tmp_path: Path) -> None:
    """As in a container, or with the last device: no /dev/input at all."""
    (tmp_path / "sys").mkdir()
    finder = DeviceFinder(Machine(tmp_path))
    assert finder.scan() == []
    (tmp_path / "dev").mkdir()
    plug(tmp_path)
    assert until_found(finder)
    (tmp_path / "dev" / "event0").unlink()
    (tmp_path / "dev").rmdir()
    assert finder.scan() is not None


def until_found(finder: DeviceFinder, limit: float = 10.0) -> list[str]:
    """Return the paths of the devices when a scan finds some."""
    end = time.monotonic() + limit
    while not (finder.due() and (found := finder.scan())):
        assert time.monotonic() < end, "it was not found"
        time.sleep(0.01)
    return [info.path for info in found]


# Devices of this machine, from sysfs.


def test_machine_without_input_devices_has_no_pad(tmp_path: Path) -> None:
    nothing = LinuxInput(tmp_path / "none", tmp_path / "none")
    assert nothing.nodes() == []
    assert nothing.fingerprint() == ()
    assert isinstance(EvdevPad.list_plugged().pads, tuple)


def put_device(root: Path, number: int, keys: str = "0", axes: str = "0", rels: str = "0", **ids: str) -> None:
    """Write an input device as sysfs shows it."""
    device = root / "sys" / f"event{number}" / "device"
    files = {"name": f"Pad {number}\n", "uniq": "\n", "id/vendor": "045e\n", "id/product": "028e\n"}
    files |= {"id/bustype": "0003\n", "capabilities/key": f"{keys}\n", "capabilities/abs": f"{axes}\n"}
    files |= {"capabilities/rel": f"{rels}\n"} | {f"id/{name}": f"{text}\n" for name, text in ids.items()}
    for name, text in files.items():
        (device / name).parent.mkdir(parents=True, exist_ok=True)
        (device / name).write_text(text)
    (root / "hardware").mkdir(exist_ok=True)
    (device / "device").symlink_to(root / "hardware")


def test_devices_are_read_from_sysfs(tmp_path: Path) -> None:
    (tmp_path / "bus" / "xpad").mkdir(parents=True)
    put_device(tmp_path, 12, "7cdb000000000000 0 0 0 0", "3003f")
    put_device(tmp_path, 2, "10000 0 0 0 0", "3003f")
    (tmp_path / "hardware" / "driver").symlink_to(tmp_path / "bus" / "xpad")
    (tmp_path / "sys" / "mouse0").mkdir()
    mouse, pad = LinuxInput(tmp_path / "sys", tmp_path / "dev").nodes()
    assert pad.identity == Identity("Pad 12", 0x045E, 0x028E, BUS_USB, "xpad")
    assert pad.path == str(tmp_path / "dev" / "event12")
    assert (mouse.is_pad, pad.is_pad) == (False, True)
    assert pad.belongs_to(mouse)  # the same hardware, where there is no serial number


@pytest.mark.parametrize(
    ("keys", "axes", "rels", "kind"),
    [
        ("7cdb000000000000 0 0 0 0", "3003f", "0", (True, False)),  # xpad
        ("7cdb000000000000 0 0 0 0", "0", "0", (False, False)),  # buttons alone
        ("3 0 0 0 0", "0", "3f", (True, False)),  # a SpaceMouse, REL
        ("3 0 0 0 0", "3f", "0", (True, False)),  # a SpaceMouse, ABS
        ("0", "3f", "0", (False, False)),  # the motion sensor of a Sony pad
        ("70000 0 0 0 0", "0", "943", (False, False)),  # a mouse
        ("fff00000000 0 0 0 0", "30027", "0", (False, True)),  # Logitech F310, D mode
        ("2420 10000 0 0 0 0", "2608000 3", "0", (False, False)),  # the touchpad of a Sony pad
    ],
)
def test_pads_are_recognised_by_the_events_that_they_can_send(tmp_path, keys, axes, rels, kind):
    put_device(tmp_path, 0, keys, axes, rels)
    (info,) = LinuxInput(tmp_path / "sys", tmp_path / "dev").nodes()
    assert (info.is_pad, info.is_joystick) == kind


def test_fingerprint_changes_with_devices_and_permissions(tmp_path: Path) -> None:
    system = LinuxInput(tmp_path, tmp_path)
    marks = [system.fingerprint()]
    (tmp_path / "event0").touch()
    marks.append(system.fingerprint())
    (tmp_path / "event0").chmod(0o600)
    marks.append(system.fingerprint())
    (tmp_path / "event0").unlink()
    marks.append(system.fingerprint())
    assert all(before != after for before, after in pairwise(marks))


def test_device_is_locked_once(tmp_path: Path) -> None:
    (tmp_path / "event3").touch()
    with (tmp_path / "event3").open() as first, (tmp_path / "event3").open() as second:
        assert lock_device(first.fileno())
        assert not lock_device(second.fileno())
        first.close()
        assert lock_device(second.fileno())
