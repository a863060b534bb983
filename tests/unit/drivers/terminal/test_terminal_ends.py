"""The terminal is restored when the program ends, and while it is stopped."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from pathlib import Path

import pytest
from terminal_kit import FarEnd, InTerminal, wait_for

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")

PROGRAM = """
import os, sys, time
from hal.drivers.terminal.pad import TerminalPad
from hal.gamepad import Gamepad
from hal.specs import PadSpec

pad = Gamepad(TerminalPad(PadSpec(name="pad", driver="terminal", model=None)))
try:
    pad.open(time.monotonic())
    pad.start_thread(time.monotonic)
    print("pid", os.getpid(), pad.describe(), flush=True)
    {ending}
    for _ in range(6000):
        time.sleep(0.01)
finally:
    pad.close()
"""


def script(folder: Path, ending: str = "") -> str:
    """Return the path of a program that is driven by its terminal until it is ended."""
    path = folder / "program.py"
    path.write_text(PROGRAM.format(ending=ending))
    return str(path)


@pytest.mark.parametrize("ending", ["sys.exit()", "raise RuntimeError('a mistake')"])
def test_terminal_is_restored_when_the_program_ends(tmp_path: Path, ending: str) -> None:
    with FarEnd() as far, InTerminal(far, [sys.executable, script(tmp_path, ending)]) as it:
        it.shows("pid")
        it.process.wait(20)
        it.is_put_back()


def test_terminal_is_restored_after_ctrl_c(tmp_path: Path) -> None:
    with FarEnd() as far, InTerminal(far, [sys.executable, script(tmp_path)]) as it:
        it.shows("pid")
        assert far.raw
        far.type("\x03")
        it.process.wait(20)
        it.shows("KeyboardInterrupt")
        it.is_put_back()


def test_closed_window_ends_the_program(tmp_path: Path) -> None:
    with FarEnd() as far, InTerminal(far, [sys.executable, script(tmp_path)]) as it:
        it.shows("pid")
        far.hang_up()
        it.process.wait(20)
        it.is_released()


class Shell(InTerminal):
    """Bash, which restores the terminal's settings when a program is stopped or killed."""

    def __init__(self, far: FarEnd) -> None:
        super().__init__(far, ["bash", "--norc", "-i"])
        self.shows("$ ")
        far.type("stty -g | sed s/^/settings=/\n")
        self.settings = self.tells(r"settings=([0-9a-f:]{20,})\r")

    def has_given_it_to(self, pid: int) -> None:
        """Wait until a program is in the foreground and has taken the terminal over."""
        wait_for(lambda: os.tcgetpgrp(self.far.master) == pid and self.far.raw, "taking the terminal over")

    def has_its_settings(self, mark: str) -> None:
        """Wait until a command runs with the settings from before."""
        self.far.type(f"\x15stty -g | sed s/^/{mark}=/\n")  # Ctrl-U: a key may have reached the shell
        self.shows(f"{mark}={self.settings}")


needs_bash = pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash: sudo apt install bash")


@needs_bash
def test_ctrl_z_gives_the_terminal_back_until_fg_and_a_killed_program_too(tmp_path: Path) -> None:
    with FarEnd() as far, Shell(far) as it:
        far.type(f"{sys.executable} {script(tmp_path)}\n")
        pid = int(it.tells(r"pid (\d+) keys"))
        for turn in (1, 2):
            it.has_given_it_to(pid)
            far.type("\x1a")
            wait_for(lambda: state(pid) == "T", "standing still")
            it.has_its_settings(f"stopped{turn}")
            far.type("fg\n")
        it.has_given_it_to(pid)
        os.kill(pid, signal.SIGKILL)
        it.shows("Killed")
        it.has_its_settings("killed")


def state(pid: int) -> str:
    """Return the state of a process: R, S, T and so on."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]


@needs_bash
def test_program_in_the_background_leaves_the_terminal_alone(tmp_path: Path) -> None:
    with FarEnd() as far, Shell(far) as it:
        far.type(f"{sys.executable} {script(tmp_path)} &\n")
        pid = int(it.tells(r"pid (\d+) keys of this terminal, once the program is in the foreground"))
        it.has_its_settings("background")
        far.type("fg\n")
        it.has_given_it_to(pid)
        far.type("\x03")
        it.shows("KeyboardInterrupt")
        it.has_its_settings("ended")
