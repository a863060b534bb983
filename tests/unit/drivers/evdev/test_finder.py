"""Finding input devices: changes through inotify, periodic scans without it, and the devices in sysfs."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from evdev_kit import DS4, FakeInput, FakeNode

from hal.drivers.evdev import finder as finder_module
from hal.drivers.evdev.finder import DeviceFinder, FolderWatch, LinuxInput, lock_device
from hal.drivers.evdev.pad import EvdevPad
from hal.pads.codes import BUS_USB
from hal.pads.model import Identity


@pytest.fixture
def watch(tmp_path: Path):
    made = FolderWatch(str(tmp_path))
    yield made
    made.close()


def readable(watch: FolderWatch) -> bool:
    return bool(select.select([watch.fileno()], [], [], 0.0)[0])


@pytest.mark.parametrize(
    "change",
    [
        lambda folder: (folder / "event1").touch(),
        lambda folder: (folder / "event0").unlink(),
        lambda folder: (folder / "event0").chmod(0o640),  # udev, a moment after the kernel made it
        lambda folder: (folder / "event0").rename(folder / "event7"),
    ],
)
def test_watch_reports_every_relevant_change(tmp_path: Path, change: Callable[[Path], None]) -> None:
    (tmp_path / "event0").touch()
    watch = FolderWatch(str(tmp_path))
    try:
        assert (readable(watch), watch.changed()) == (False, False)
        change(tmp_path)
        assert readable(watch)
        assert watch.changed()
        assert not watch.changed(), "once"
    finally:
        watch.close()


def test_watch_ignores_reads_and_writes(tmp_path: Path, watch: FolderWatch) -> None:
    (tmp_path / "event0").write_text("x")
    assert watch.changed()
    with (tmp_path / "event0").open("r+") as file:
        file.read()
        file.write("y")
    assert not watch.changed()


def test_watch_ends_with_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "input"
    folder.mkdir()
    watch = FolderWatch(str(folder))
    folder.rmdir()
    with pytest.raises(OSError):  # noqa: PT011
        watch.changed()
    watch.close()
    watch.close()


def test_watch_needs_a_folder(tmp_path: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(FileNotFoundError):
        FolderWatch(str(tmp_path / "input"))
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        FolderWatch(str(tmp_path / "file"))
    assert len(os.listdir("/proc/self/fd")) == before, "nothing stays open"


class Machine(LinuxInput):
    """The input devices of this machine, in a folder of the test."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "sys", folder / "dev")


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "dev").mkdir()
    (tmp_path / "sys").mkdir()
    monkeypatch.setattr(finder_module, "FolderWatch", lambda: FolderWatch(str(tmp_path / "dev")))
    return tmp_path


def plug(machine: Path) -> None:
    (machine / "sys" / "event0" / "device").mkdir(parents=True)
    (machine / "dev" / "event0").touch()


def test_plugging_in_ends_the_wait(machine: Path) -> None:
    finder = DeviceFinder(Machine(machine), watched=True)
    assert finder.scan() == []
    assert not finder.due(), "nothing changed"
    assert not finder.wait(0.0)
    plug(machine)
    start = time.monotonic()
    assert finder.wait(60.0)
    assert time.monotonic() - start < 30.0, "before the time-out"
    found = finder.scan()
    assert found is not None
    assert [info.path for info in found] == [str(machine / "dev" / "event0")]
    (machine / "dev" / "event0").chmod(0o640)
    assert finder.due(), "its permissions changed"
    assert finder.scan() is not None
    finder.close()


def test_folder_may_come_and_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container, or with the last device: no /dev/input at all."""
    (tmp_path / "sys").mkdir()
    monkeypatch.setattr(finder_module, "FolderWatch", lambda: FolderWatch(str(tmp_path / "dev")))
    finder = DeviceFinder(Machine(tmp_path), watched=True)
    assert finder.scan() == []
    (tmp_path / "dev").mkdir()
    plug(tmp_path)
    until_found(finder)
    (tmp_path / "dev" / "event0").unlink()
    (tmp_path / "dev").rmdir()
    assert finder.due()
    assert finder.scan() is not None
    finder.close()


def test_devices_are_scanned_periodically_without_a_watch(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> FolderWatch:
        raise OSError(24, "the user's watches are used up")

    monkeypatch.setattr(finder_module, "FolderWatch", refuse)
    finder = DeviceFinder(Machine(machine), watched=True)
    assert finder.scan() == []
    plug(machine)
    until_found(finder)
    finder.close()


def test_devices_of_another_system_are_not_watched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finder_module, "FolderWatch", lambda: pytest.fail("a watch of this machine"))
    system = FakeInput()
    finder = DeviceFinder(system, watched=False)
    assert finder.scan() == []
    node = FakeNode("/dev/input/event3", {}, [])
    system.put(node, DS4)
    until_found(finder)
    finder.close()
    node.dispose()


def until_found(finder: DeviceFinder, limit: float = 10.0) -> None:
    end = time.monotonic() + limit
    while not (finder.due() and finder.scan()):
        assert time.monotonic() < end, "it was not found"
        finder.wait(0.01)


# Devices of this machine, from sysfs.


def test_machine_without_input_devices_has_no_pad(tmp_path: Path) -> None:
    nothing = LinuxInput(tmp_path / "none", tmp_path / "none")
    assert nothing.nodes() == []
    assert nothing.fingerprint() == ()
    assert isinstance(EvdevPad.plugged().pads, tuple)


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
