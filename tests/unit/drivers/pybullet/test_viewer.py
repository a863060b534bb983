"""The viewer's window, on an X server without a screen."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from errors_kit import raises_code
from specs import box, data, world_spec
from waiting import wait_until

from hal.drivers.pybullet.viewer import PyBulletViewer
from hal.errors import DriverMissing, NotSupported
from hal.host.hosts import LocalHost
from hal.specs import BodySpec, GroupSpec, to_json


class Display(NamedTuple):
    """An X server; its screen is in a file."""

    server: subprocess.Popen[bytes]
    screen: Path


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Display]:
    if not shutil.which("Xvfb"):
        pytest.skip("not installed: xvfb")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24", "-nolisten", "tcp", "-fbdir", str(tmp_path)],
        pass_fds=[write],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with os.fdopen(read) as number:
        monkeypatch.setenv("DISPLAY", f":{number.readline().strip()}")
    yield Display(server, tmp_path / "Xvfb_screen0")
    server.terminate()
    server.wait(10)


def lock_step() -> LocalHost:
    data("plane.urdf")  # skips where PyBullet is not installed
    spec = world_spec(box("block", (0.0, 0.0, 0.5), (0.1, 0.1, 0.1)))
    return LocalHost(GroupSpec("world", "lock_step", 240.0, (), spec))


@pytest.mark.parametrize("name", [None, ":9999"])
def test_without_a_display_the_viewer_is_not_supported(monkeypatch: pytest.MonkeyPatch, name: str | None) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    if name is not None:
        monkeypatch.setenv("DISPLAY", name)
    with raises_code(NotSupported, "no_display"):
        PyBulletViewer(lock_step()).wait_ready()


def test_without_pybullet_the_viewer_is_a_missing_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    host = lock_step()
    monkeypatch.setattr("hal.drivers.pybullet.viewer.find_spec", lambda name: None)
    with pytest.raises(DriverMissing):
        PyBulletViewer(host)
    host.close()


def test_the_window_shows_the_world_and_its_edits_until_it_is_closed(display: Display) -> None:
    host = lock_step()
    viewer = PyBulletViewer(host)
    shown: set[bytes] = set()

    def picture_changed() -> bool:
        viewer._child.check()
        new = display.screen.read_bytes()
        changed = new not in shown
        shown.add(new)
        return changed

    try:
        viewer.wait_ready()
        for number in range(3):
            ball = BodySpec(f"ball{number}", (0.0, 0.0, 0.3 * number), (0, 0, 0, 1), "sphere", radius=0.1)
            edit = {"spec": to_json(ball)}
            revision = host.request("world.add", edit)
            host.advance_to(host.now() + 0.1)
            viewer.note_edit("add", edit, revision)
            wait_until(picture_changed)
        display.server.terminate()
        wait_until(lambda: viewer._child.process.poll() is not None)
        viewer.note_edit("set_color", {"name": "block", "rgba": [1, 0, 0, 1]}, 4)  # not an error
    finally:
        viewer.close()
        viewer.close()
        host.close()
