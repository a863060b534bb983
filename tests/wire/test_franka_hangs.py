"""An app that is gone leaves no process behind, though the robot hangs: the libraries then wait for ever."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator

import pytest

from .franka_kit import Emulator
from .test_franka_ends import App

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")
pytestmark = pytest.mark.slow

LONGEST = 40.0
"""s: what docs/safety.md gives an app that is silent (30), and some."""
ROBOTS = ("fr3", "panda")


def runs(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@contextlib.contextmanager
def killed(robot: str) -> Iterator[int]:
    """The process of an arm whose robot hangs, and whose app was killed."""
    with Emulator(robot=robot) as emulator:
        app = App(emulator, robot)
        host = app.children[0]
        try:
            emulator.process.send_signal(signal.SIGSTOP)
            time.sleep(0.05)
            app.process.kill()
            yield host
        finally:
            emulator.process.send_signal(signal.SIGCONT)
            if runs(host):
                os.kill(host, signal.SIGKILL)
            app.close()


def test_an_app_is_killed_while_the_robot_hangs() -> None:
    """Both arms at once, for both wait for as long."""
    with contextlib.ExitStack() as stack:
        hosts = {robot: stack.enter_context(killed(robot)) for robot in ROBOTS}
        deadline = time.monotonic() + LONGEST
        while any(map(runs, hosts.values())) and time.monotonic() < deadline:
            time.sleep(0.05)
        left = [robot for robot, host in hosts.items() if runs(host)]
        assert not left, "the arm's process holds the arm for ever"
