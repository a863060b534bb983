"""A whole laboratory with one command: every arm of a rig emulated, driven by ``hal.open``, with faults by name."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

import hal

from .franka_kit import free_host

START = 60.0


class Lab:
    """The running command, and what it prints."""

    def __init__(self, config: Path) -> None:
        words = [sys.executable, "-m", "hal_emulators", "--config", str(config)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        self.process = subprocess.Popen(words, text=True, **pipes)  # type: ignore[call-overload]
        self.lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self.lines.put(line)

    def wait_line(self, wanted: Callable[[str], bool]) -> str:
        """Return the first line of the next ones that is wanted."""
        limit = time.monotonic() + START
        while True:
            line = self.lines.get(timeout=max(0.01, limit - time.monotonic()))
            if wanted(line):
                return line

    def type(self, line: str) -> None:
        """Type a line at the prompt."""
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A rig of an FR3 and a YAM at addresses of this test's own."""
    channel = f"239.74.{128 + os.getpid() // 250 % 100}.{1 + os.getpid() % 250}"
    rig = {
        "sim": False,
        "robots": {
            "left": {"model": "fr3", "base": {"position": [0, 0.5, 0]}, "real": {"host": free_host()}},
            "right": {
                "model": "yam",
                "base": {"position": [0, -0.5, 0]},
                "real": {"interface": "udp_multicast", "channel": channel},
            },
        },
    }
    path = tmp_path / "lab.yaml"
    path.write_text(yaml.safe_dump(rig), encoding="utf-8")
    return path


@pytest.fixture
def lab(config: Path) -> Iterator[Lab]:
    """The laboratory, ready."""
    lab = Lab(config)
    ready = set()
    while ready != {"left", "can"}:
        ready.add(lab.wait_line(lambda line: "ready:" in line).partition(":")[0])
    yield lab
    lab.process.kill()
    lab.process.wait(10.0)


def test_a_rig_is_driven_as_in_simulation_and_stopped_by_a_fault_that_was_typed(lab: Lab, config: Path) -> None:
    for sim in (True, False):
        with hal.open(config, sim=sim) as rig:
            for name in ("left", "right"):
                robot = rig.robots[name]
                goal = [q + 0.05 for q in robot.spec.home]
                robot.move_to(goal, unattended=True)
                assert robot.state().q == pytest.approx(goal, abs=0.01)
            if not sim:
                lab.type("left user-stop on")
                with pytest.raises(hal.HalError, match="user stop"):
                    rig.robots["left"].move_to(rig.robots["left"].spec.home, unattended=True)
    lab.type("middle help")
    assert "left, can" in lab.wait_line(lambda line: "begin with the name" in line)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_emulator_outlives_it(lab: Lab, config: Path, number: int) -> None:
    children = Path(f"/proc/{lab.process.pid}/task/{lab.process.pid}/children").read_text().split()
    assert len(children) == 2
    for _ in range(3):  # as impatient people do
        lab.process.send_signal(number)
    lab.process.wait(15.0)
    limit = time.monotonic() + 15.0
    while any(Path(f"/proc/{child}").exists() for child in children) and time.monotonic() < limit:
        time.sleep(0.02)
    assert not any(Path(f"/proc/{child}").exists() for child in children)
