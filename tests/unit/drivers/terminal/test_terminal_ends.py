"""The terminal is restored however the program ends or is stopped."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from itertools import product
from pathlib import Path

import pytest
from terminal_kit import FarEnd, InTerminal, wait_for

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")

PROGRAM = """
import os, signal, sys, time
from hal.drivers.terminal.pad import TerminalPad
from hal.gamepad import Gamepad
from hal.specs import PadSpec

pad = Gamepad(TerminalPad(PadSpec(name="pad", driver="terminal", model=None)))
try:
    pad.open(time.monotonic())
    pad.start_thread(time.monotonic)
    print("ready", flush=True)
    {ending}
    for _ in range(6000):
        time.sleep(0.01)
finally:
    pad.close()
"""


QUESTION = b"\x1b[?u\x1b[c"
"""The first query to a terminal."""


def program(far: FarEnd, folder: Path, ending: str = "") -> InTerminal:
    script = folder / "program.py"
    script.write_text(PROGRAM.format(ending=ending))
    return InTerminal(far, [sys.executable, str(script)])


SIGTERM, SIGKILL = (f"os.kill(os.getpid(), signal.{name})" for name in ("SIGTERM", "SIGKILL"))
CRASHES = ["raise RuntimeError('a mistake')", "os.abort()"]
MORE_CRASHES = ["sys.exit(3)", "os._exit(4)", SIGTERM]


@pytest.mark.parametrize(
    ("ending", "kitty"),
    [
        *((ending, True) for ending in CRASHES),
        *(pytest.param(ending, True, marks=pytest.mark.slow) for ending in MORE_CRASHES),
        *product(["pad.close()", SIGKILL], [False, True]),
    ],
)
def test_terminal_is_restored_when_the_program_ends(tmp_path: Path, ending: str, kitty: bool) -> None:
    with FarEnd(kitty=kitty) as far, program(far, tmp_path, f"{ending}; sys.exit()") as it:
        it.shows("ready")
        it.process.wait(20)
        it.is_put_back()


@pytest.mark.parametrize("kitty", [False, True])
def test_terminal_is_restored_after_ctrl_c(tmp_path: Path, kitty: bool) -> None:
    with FarEnd(kitty=kitty) as far, program(far, tmp_path) as it:
        it.shows("ready")
        far.type("\x1b[99;5u" if kitty else "\x03")
        it.process.wait(20)
        it.shows("KeyboardInterrupt")
        it.is_put_back()


class HastyUser(FarEnd):
    """Presses Ctrl-C as soon as keys are reported, before the terminal answers any more queries."""

    def _obey(self, mark: str, numbers: list[int], final: str) -> str:
        answer = super()._obey(mark, numbers, final)
        if (mark, final) == (">", "u"):
            self.type("\x1b[99;5u")
        return answer


def test_ctrl_c_counts_while_the_terminal_is_queried(tmp_path: Path) -> None:
    with HastyUser(kitty=True) as far, program(far, tmp_path) as it:
        it.process.wait(20)
        assert b"ready" not in far.screen
        it.is_put_back()


def test_terminal_is_restored_when_a_suspended_program_is_killed(tmp_path: Path) -> None:
    with FarEnd(kitty=True) as far, program(far, tmp_path) as it:
        it.shows("ready")
        it.process.send_signal(signal.SIGSTOP)
        it.process.kill()
        it.process.wait(20)
        it.is_put_back()


def test_settings_that_a_shell_changed_are_left_alone(tmp_path: Path) -> None:
    with FarEnd() as far, program(far, tmp_path) as it:
        it.shows("ready")
        it.process.send_signal(signal.SIGSTOP)
        wait_for(lambda: far.raw, "being raw")
        attributes = far.settings
        attributes[0] |= 1  # IGNBRK: any change will do
        far.settings = attributes
        it.process.kill()
        it.process.wait(20)
        it.is_released()
        assert far.settings == attributes


def test_closed_window_ends_the_program_and_the_guardian(tmp_path: Path) -> None:
    with FarEnd(kitty=True) as far, program(far, tmp_path) as it:
        it.shows("ready")
        far.hang_up()
        it.process.wait(20)
        it.is_released()


@pytest.mark.parametrize(("shell", "kitty"), [("bash --norc -i", True), ("dash -i", False)])
def test_ctrl_z_gives_the_terminal_back_until_fg(tmp_path: Path, shell: str, kitty: bool) -> None:
    name = shell.split()[0]
    if shutil.which(name) is None:
        pytest.skip(f"needs {name}: sudo apt install {name}")
    script = tmp_path / "program.py"
    script.write_text(PROGRAM.format(ending="print('pid', os.getpid(), flush=True)"))
    with FarEnd(kitty=kitty) as far, InTerminal(far, shell.split()) as it:
        it.shows("$ ")
        far.type("stty -g | sed s/^/settings=/\n")
        settings = it.tells(r"settings=([0-9a-f:]{20,})\r")
        far.type(f"{sys.executable} {script}\n")
        pid = int(it.tells(r"pid (\d+)\D"))
        for turn in (1, 2, 3):
            wait_for(lambda turn=turn: far.screen.count(QUESTION) == turn, "taking the terminal over")
            wait_for(lambda: far.flags[-1] == (15 if kitty else 0), "reporting keys")
            assert far.raw
            if turn == 3:
                break
            far.type("\x1b[122;5u" if kitty else "\x1a")
            wait_for(lambda: state(pid) == "T", "standing still")
            assert far.flags == [0]
            assert not far.focus
            far.type(f"stty -g | sed s/^/now{turn}=/\n")
            it.shows(f"now{turn}={settings}")
            far.type("fg\n")
        far.type("\x1b[99;5u" if kitty else "\x03")
        it.shows("KeyboardInterrupt")
        wait_for(lambda: far.flags == [0], "giving the terminal back")
        far.type("echo $((20 + 3))\n")
        it.shows("23")


def state(pid: int) -> str:
    """Return the state of a process: R, S, T and so on."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]


def test_program_in_the_background_leaves_the_terminal_alone(tmp_path: Path) -> None:
    if shutil.which("bash") is None:
        pytest.skip("needs bash: sudo apt install bash")
    script = tmp_path / "program.py"
    script.write_text(PROGRAM.format(ending="print('pid', os.getpid(), pad.describe(), flush=True)"))
    with FarEnd(kitty=True) as far, InTerminal(far, ["bash", "--norc", "-i"]) as it:
        it.shows("$ ")
        far.type(f"{sys.executable} {script} &\n")
        it.shows("once the program is in the foreground")
        assert far.flags == [0]
        far.type("echo $((20 + 3))\n")
        it.shows("23")
        far.type("fg\n")
        wait_for(lambda: far.flags[-1] == 15, "taking the terminal over")
        os.kill(int(it.tells(r"pid (\d+)\D")), signal.SIGKILL)
        wait_for(lambda: far.flags == [0], "giving the terminal back")
        far.type("\x15echo $((20 + 4))\n")  # Ctrl-U: a late reply may have reached the shell
        it.shows("24")
