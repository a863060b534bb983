"""An app that is gone leaves no process behind, though the robot hangs: the libraries then wait for ever."""

from __future__ import annotations

import os
import signal
import time

import pytest

from .franka_kit import Emulator
from .test_franka_ends import App

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")
pytestmark = pytest.mark.slow

LONGEST = 40.0
"""s: what docs/safety.md gives an app that is silent (30), and some."""


def runs(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("robot", ["fr3", "panda"])
def test_an_app_is_killed_while_the_robot_hangs(robot: str) -> None:
    with Emulator(robot=robot) as emulator:
        app = App(emulator, robot)
        host = app.children[0]
        try:
            emulator.process.send_signal(signal.SIGSTOP)
            time.sleep(0.05)
            app.process.kill()
            deadline = time.monotonic() + LONGEST
            while runs(host) and time.monotonic() < deadline:
                time.sleep(0.05)
            assert not runs(host), "the arm's process holds the arm for ever"
        finally:
            emulator.process.send_signal(signal.SIGCONT)
            if runs(host):
                os.kill(host, signal.SIGKILL)
            app.close()
