"""Being told of devices that come and go, instead of looking for them."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

if sys.platform != "linux":
    pytest.skip("inotify is Linux only", allow_module_level=True)

from evdev_kit import FakeInput, FakeNode

from hal.drivers.evdev import finder as finder_module
from hal.drivers.evdev.finder import Finder
from hal.drivers.evdev.system import LinuxInput
from hal.drivers.evdev.watch import Watch
from hal.pads.codes import BUS_USB
from hal.pads.model import Identity

DS4 = Identity("Wireless Controller", 0x054C, 0x09CC, BUS_USB, "playstation")


@pytest.fixture
def watch(tmp_path: Path):
    made = Watch(str(tmp_path))
    yield made
    made.close()


def readable(watch: Watch) -> bool:
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
def test_it_tells_of_every_change_that_matters(tmp_path: Path, change: Callable[[Path], None]) -> None:
    (tmp_path / "event0").touch()
    watch = Watch(str(tmp_path))
    try:
        assert (readable(watch), watch.changed()) == (False, False)
        change(tmp_path)
        assert readable(watch)
        assert watch.changed()
        assert not watch.changed(), "once"
    finally:
        watch.close()


def test_reading_and_writing_a_device_is_no_change(tmp_path: Path, watch: Watch) -> None:
    (tmp_path / "event0").write_text("x")
    assert watch.changed()
    with (tmp_path / "event0").open("r+") as file:
        file.read()
        file.write("y")
    assert not watch.changed()


def test_a_folder_that_goes_ends_it(tmp_path: Path) -> None:
    folder = tmp_path / "input"
    folder.mkdir()
    watch = Watch(str(folder))
    folder.rmdir()
    with pytest.raises(OSError, match="gone"):
        watch.changed()
    watch.close()
    watch.close()


def test_no_folder_no_watch(tmp_path: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(FileNotFoundError):
        Watch(str(tmp_path / "input"))
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        Watch(str(tmp_path / "file"))
    assert len(os.listdir("/proc/self/fd")) == before, "nothing stays open"


class Machine(LinuxInput):
    """This machine's input devices, in a folder of the test's."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "sys", folder / "dev")


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "dev").mkdir()
    (tmp_path / "sys").mkdir()
    monkeypatch.setattr(finder_module, "Watch", lambda: Watch(str(tmp_path / "dev")))
    return tmp_path


def plug(machine: Path) -> None:
    (machine / "sys" / "event0" / "device").mkdir(parents=True)
    (machine / "dev" / "event0").touch()


def test_a_device_that_is_plugged_in_ends_the_wait_and_is_found(machine: Path) -> None:
    finder = Finder(Machine(machine), watched=True)
    assert finder.look() == []
    assert not finder.due(), "nothing changed"
    assert not finder.wait(0.0)
    plug(machine)
    start = time.monotonic()
    assert finder.wait(60.0)
    assert time.monotonic() - start < 30.0, "not because the time was over"
    found = finder.look()
    assert found is not None
    assert [info.path for info in found] == [str(machine / "dev" / "event0")]
    (machine / "dev" / "event0").chmod(0o640)
    assert finder.due(), "its permissions changed"
    assert finder.look() is not None
    finder.close()


def test_a_folder_that_comes_and_goes_is_looked_at_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a container, or with the last device: no /dev/input at all."""
    (tmp_path / "sys").mkdir()
    monkeypatch.setattr(finder_module, "Watch", lambda: Watch(str(tmp_path / "dev")))
    finder = Finder(Machine(tmp_path), watched=True)
    assert finder.look() == []
    (tmp_path / "dev").mkdir()
    plug(tmp_path)
    until_found(finder)
    (tmp_path / "dev" / "event0").unlink()
    (tmp_path / "dev").rmdir()
    assert finder.due()
    assert finder.look() is not None
    finder.close()


def test_without_a_watch_it_looks_now_and_then(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> Watch:
        raise OSError(24, "the user's watches are used up")

    monkeypatch.setattr(finder_module, "Watch", refuse)
    finder = Finder(Machine(machine), watched=True)
    assert finder.look() == []
    plug(machine)
    until_found(finder)
    finder.close()


def test_another_systems_devices_are_not_watched_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finder_module, "Watch", lambda: pytest.fail("a watch of this machine"))
    system = FakeInput()
    finder = Finder(system, watched=False)
    assert finder.look() == []
    node = FakeNode("/dev/input/event3", {}, [])
    system.put(node, DS4)
    until_found(finder)
    finder.close()
    node.dispose()


def until_found(finder: Finder, limit: float = 10.0) -> None:
    end = time.monotonic() + limit
    while not (finder.due() and finder.look()):
        assert time.monotonic() < end, "it was not looked for"
        finder.wait(0.01)
