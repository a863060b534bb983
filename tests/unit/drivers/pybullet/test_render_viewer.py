"""The viewer's window and its keyboard, on an X server without a screen."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator

import pytest
from pictures_kit import world
from specs import box, data, world_spec

from hal.drivers.pybullet.keyboard import HELP, KEYS, LAYOUT, KeyboardPad, KeyboardSource
from hal.drivers.pybullet.keyboard_process import KeyWatch
from hal.drivers.pybullet.viewer import PyBulletViewer
from hal.drivers.pybullet.x11 import windows
from hal.errors import ConnectionLost, NotSupported
from hal.gamepad import PadReading
from hal.host.hosts import LocalHost
from hal.host.mailbox import Mailbox
from hal.specs import BodySpec, GroupSpec, PadSpec, to_json

PAD = PadSpec("pad", "pybullet", None)


class Desk:
    """A record, the watch that writes it and the pad that reads it, on a clock that stands still."""

    def __init__(self) -> None:
        mailbox = Mailbox(memoryview(bytearray(Mailbox.size(LAYOUT))), LAYOUT)
        self.watch = KeyWatch(mailbox)
        self.t = 50.0
        self.gone = False
        self.shown: Callable[[float], float] = lambda t: t
        self.pad = KeyboardPad(PAD, KeyboardSource(mailbox, lambda: self.t, self.check))
        self.pad.open()

    def check(self) -> None:
        if self.gone:
            raise ConnectionLost("the viewer process ended")

    def press(self, *keys: str, seconds: float = 0.0) -> PadReading:
        assert set(keys) <= set(KEYS)
        for _ in range(max(1, round(seconds / 0.01))):
            self.t += 0.01
            self.watch.look(frozenset(keys), self.t, self.shown(self.t))
        return self.pad.poll(self.t + 1000.0, 0.0)  # the rig's clock is another one


class TestKeys:
    def test_keys_are_canonical_controls(self) -> None:
        desk = Desk()
        nothing = desk.pad.poll(0.0, 0.0)
        assert not nothing.connected
        rest = desk.press()
        assert rest.connected
        assert set(rest.axes.values()) == {0.0}
        assert not rest.buttons
        moving = desk.press("space", "Up", "Left", "a", "i", "Prior", "1")
        assert moving.axes["l2"] == 1.0
        assert (moving.axes["dpad_y"], moving.axes["dpad_x"]) == (1.0, -1.0)
        assert (moving.axes["left_x"], moving.axes["right_y"]) == (-1.0, 1.0)
        assert moving.buttons == {"l2", "l1", "south"}
        assert desk.press("Up", "Down").axes["dpad_y"] == 0.0
        slow = desk.press("space", "Up", "Shift_L")
        assert 0 < slow.axes["dpad_y"] < 0.5
        assert slow.axes["l2"] == 1.0

    def test_the_grip_stays_where_it_was_left(self) -> None:
        desk = Desk()
        desk.press()
        closing = desk.press("g", seconds=0.6).axes["r2"]
        assert closing == pytest.approx(0.6, abs=0.02)
        assert "r2" in desk.press(seconds=0.3).buttons
        assert desk.press(seconds=0.3).axes["r2"] == pytest.approx(closing)
        assert desk.press("h", seconds=2.0).axes["r2"] == 0.0

    def test_stamps_are_on_the_rigs_clock(self) -> None:
        desk = Desk()
        pressed = desk.press("space")
        later = desk.press("space", seconds=0.2)
        assert later.t == pytest.approx(pressed.t)
        assert later.seq == pressed.seq
        assert later.t_alive == pytest.approx(1000.0 + desk.t)
        desk.t += 0.5  # the window hangs
        frozen = desk.pad.poll(desk.t + 1000.0, 0.0)
        assert frozen.t_alive == pytest.approx(1000.0 + desk.t - 0.5)

    def test_a_window_that_hangs_is_silence(self) -> None:
        desk = Desk()
        desk.press("space")
        hung = desk.t
        desk.shown = lambda t: hung
        assert desk.press("space", seconds=0.3).t_alive == pytest.approx(1000.0 + desk.t)  # a busy graphics card
        assert desk.press("space", seconds=0.4).t_alive == pytest.approx(1000.0 + hung)

    def test_a_closed_window_is_a_pad_that_is_gone(self) -> None:
        desk = Desk()
        assert desk.press("space").connected
        desk.gone = True
        reading = desk.pad.poll(1000.0, 0.0)
        assert not reading.connected
        assert not reading.buttons

    def test_without_a_window_it_says_so(self) -> None:
        with pytest.raises(NotSupported, match="--viewer gui"):
            KeyboardPad(PAD).open()
        assert "Space" in HELP


def test_without_a_display_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(NotSupported, match="DISPLAY"):
        PyBulletViewer(lock_step())


def lock_step() -> LocalHost:
    data("plane.urdf")  # skips where PyBullet is not installed
    spec = world_spec(box("block", (0.0, 0.0, 0.5), (0.1, 0.1, 0.1)))
    return LocalHost(GroupSpec("world", "lock_step", 240.0, (), spec))


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An X server of its own."""
    missing = [package for program, package in (("Xvfb", "xvfb"), ("xdotool", "xdotool")) if not shutil.which(program)]
    if missing:
        pytest.skip(f"not installed: {' '.join(missing)}")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24", "-nolisten", "tcp"],
        pass_fds=[write],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with os.fdopen(read) as number:
        name = f":{number.readline().strip()}"
    monkeypatch.setenv("DISPLAY", name)
    yield name
    server.terminate()
    server.wait(10)


def until(condition: Callable[[], bool], limit: float = 20.0) -> None:
    deadline = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < deadline, "it did not come to that"
        time.sleep(0.01)


def xdotool(*arguments: str) -> None:
    subprocess.run(["xdotool", *arguments], check=True, timeout=10, stdout=subprocess.DEVNULL)


class OtherWindow:
    """A window of another program."""

    def __init__(self) -> None:
        x = self.x = ctypes.CDLL("libX11.so.6")
        x.XOpenDisplay.restype = ctypes.c_void_p
        x.XDefaultRootWindow.restype = x.XCreateSimpleWindow.restype = ctypes.c_ulong
        self.display = ctypes.c_void_p(x.XOpenDisplay(None))
        root = ctypes.c_ulong(x.XDefaultRootWindow(self.display))
        self.window = x.XCreateSimpleWindow(self.display, root, 0, 0, 50, 50, 0, ctypes.c_ulong(0), ctypes.c_ulong(0))
        x.XMapWindow(self.display, ctypes.c_ulong(self.window))
        x.XSync(self.display, 0)


def test_the_window_its_keys_its_focus_and_its_end(display: str) -> None:
    host = lock_step()
    viewer = PyBulletViewer(host)
    try:
        viewer.wait_ready()
        (ours,) = windows("Bullet Physics")
        other = OtherWindow()
        pad = KeyboardPad(PAD, viewer.keyboard())
        pad.open()

        def reading() -> PadReading:
            return pad.poll(time.monotonic(), 0.0)

        def settle() -> None:
            """Until it looked at the keys again, twice."""
            for _ in range(2):
                alive = reading().t_alive
                until(lambda: reading().t_alive > alive)  # noqa: B023  # called at once

        def focus(window: int) -> None:
            xdotool("windowfocus", "--sync", str(window))
            settle()

        until(lambda: reading().connected)
        focus(other.window)
        xdotool("keydown", "Up")
        settle()
        assert reading().axes["dpad_y"] == 0.0  # not our window
        focus(ours)
        xdotool("keydown", "space")
        until(lambda: reading().axes["l2"] == 1.0)
        assert reading().axes["dpad_y"] == 0.0  # pressed elsewhere: it counts when it was up once
        xdotool("keyup", "Up")
        settle()
        xdotool("keydown", "Up")
        until(lambda: reading().axes["dpad_y"] == 1.0)

        focus(other.window)  # with both keys still down
        until(lambda: not reading().buttons)
        assert reading().connected
        assert reading().axes["dpad_y"] == 0.0
        focus(ours)
        assert not reading().buttons
        xdotool("keyup", "space")
        settle()
        xdotool("keydown", "space")
        until(lambda: "l2" in reading().buttons)

        process = viewer._child.process
        os.kill(process.pid, signal.SIGSTOP)
        until(lambda: time.monotonic() - reading().t_alive > 0.3)
        os.kill(process.pid, signal.SIGCONT)
        until(lambda: time.monotonic() - reading().t_alive < 0.2)
        assert viewer._watch is not None
        watch = viewer._watch.process
        os.kill(watch.pid, signal.SIGSTOP)
        until(lambda: time.monotonic() - reading().t_alive > 0.3)
        os.kill(watch.pid, signal.SIGCONT)
        until(lambda: time.monotonic() - reading().t_alive < 0.2)

        xdotool("windowclose", str(ours))
        until(lambda: not reading().connected)
        until(lambda: process.poll() is not None)
        viewer.edited("set_color", {"name": "block", "rgba": [1, 0, 0, 1]}, 1)  # nobody is there; no error
    finally:
        viewer.close()
        viewer.close()
        host.close()


def test_the_window_follows_edits_in_lock_step(display: str) -> None:
    """The process keeps running and alive while bodies come and go."""
    host = lock_step()
    viewer = PyBulletViewer(host)
    try:
        viewer.wait_ready()
        source = viewer.keyboard()
        assert source is not None
        for number in range(3):
            ball = BodySpec(f"ball{number}", (0.0, 0.0, 1.0 + number), (0, 0, 0, 1), "sphere", radius=0.05, mass=1.0)
            edit = {"spec": to_json(ball)}
            revision = host.request("world.add", edit)
            host.advance_to(host.now() + 0.1)
            viewer.edited("add", edit, revision)
        alive = time.monotonic()
        until(lambda: (source.mailbox.read() or (0, (0.0,)))[1][0] > alive + 0.3)
        source.check()
    finally:
        viewer.close()
        host.close()


def test_a_mirror_has_no_physics() -> None:
    scene = world(mirror=True)
    with pytest.raises(NotSupported):
        scene.step()
    scene.close()
