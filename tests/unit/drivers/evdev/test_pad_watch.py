"""Changes of input devices through inotify, and periodic scans without it."""

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

from evdev_kit import DS4, FakeInput, FakeNode

from hal.drivers.evdev import finder as finder_module
from hal.drivers.evdev.finder import DeviceFinder, FolderWatch, LinuxInput


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
