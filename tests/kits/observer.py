"""Watches an app and its host from outside: whatever happens to the app, the arm's set-points can still be read.

The app runs under a terminal of its own, so that Ctrl-C, Ctrl-Z and a closed window are the real things. It tells the
descriptor of the memory that it shares with its host; mapping that through /proc keeps it readable after the app's end.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hal.host.process import SharedMemory
from hal.host.records import GroupMemory, ServoRecord
from hal.types import GripperOutcome

APP = """
import json, os, sys, time
import hal

rig = hal.open({config!r}, sim=True, clock="real_time", overrides={overrides!r}, pad="none")
arm = rig.robots["panda"]
host = rig._hosts[0]
children = [host.child.process.pid] + ([rig._pictures._child.process.pid] if rig._pictures else [])
velocity = [0.4, 0.0, 0.0, 0.0, 0.4, 0.0, 0.4]
with rig, arm.control(rate_hz={rate_hz}) as control:
    for turn, tick in enumerate(rig.clock.rate(50)):
        control.send(hal.JointVelocity(velocity), grip=1.0)
        if turn == 20:
            names = [[r.name, len(r.joints)] for r in host.spec.robots]
            told = {{"pid": os.getpid(), "children": children, "fd": host.shared.fd, "joints": names}}
            told["grippers"] = [g.name for g in host.spec.grippers]
            print(json.dumps(told), flush=True)
        if {ending!r} == "exception" and turn == 40:
            raise RuntimeError("a mistake in user code")
        if {ending!r} == "commands stop" and turn == 40:
            time.sleep(60)
        if {ending!r} == "interpreter blocked" and turn == 40:
            while True:
                pass
"""


SLOW_FINGERS = "robots.panda.gripper.speed=0.02"
"""They close for 4 s."""

SHELL = """
import os, signal, subprocess, sys

signal.signal(signal.SIGTTOU, signal.SIG_IGN)
app = subprocess.Popen([sys.executable, sys.argv[1]], preexec_fn=lambda: os.setpgid(0, 0))
os.tcsetpgrp(0, app.pid)
sys.exit(app.wait())
"""
# An interactive shell in short: a process group that is not orphaned, without which Ctrl-Z does nothing.


class Watched:
    """An app in motion."""

    def __init__(
        self,
        folder: Path,
        ending: str = "",
        config: str = "panda_table",
        overrides: list[str] | None = None,
        rate_hz: float = 50.0,
    ) -> None:
        """Start it; it sends 50 commands a second, and has to send ``rate_hz``."""
        program = APP.format(
            config=config, overrides=overrides or ["cameras={}", SLOW_FINGERS], ending=ending, rate_hz=rate_hz
        )
        script = folder / "app.py"
        script.write_text(program)
        self.terminal, slave = pty.openpty()

        def own_terminal() -> None:
            fcntl.ioctl(slave, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            [sys.executable, "-c", SHELL, str(script)],
            stdin=slave,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=own_terminal,
            text=True,
        )
        os.close(slave)
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the app ended with {self.process.wait(5)} before it moved")
        told: dict[str, Any] = json.loads(line)
        self.pid: int = told["pid"]
        self.children: list[int] = told["children"]
        descriptor = os.open(f"/proc/{told['pid']}/fd/{told['fd']}", os.O_RDWR)
        joints = [(name, n) for name, n in told["joints"]]
        self.memory = GroupMemory(SharedMemory(fd=descriptor).buffer, joints, told["grippers"])

    def servo(self) -> ServoRecord:
        """Return the newest report of the servo."""
        return self.memory.robots["panda"].peek()

    def speed(self) -> float:
        """Greatest joint speed of the set-point, rad/s."""
        return max(abs(value) for value in self.servo().dq_set)

    def end(self, how: str) -> float:
        """End or stop the app in this way; return when, on the monotonic clock."""
        when = time.monotonic()
        signals = {"kill -9": signal.SIGKILL, "SIGSTOP": signal.SIGSTOP, "SIGTERM": signal.SIGTERM}
        keys = {"Ctrl-C": b"\x03", "Ctrl-Z": b"\x1a"}
        if how in signals:
            os.kill(self.pid, signals[how])
        elif how in keys:
            os.write(self.terminal, keys[how])
        elif how == "closed terminal":
            os.close(self.terminal)
            self.terminal = -1
        return when

    def wait_for(self, condition: Callable[[], bool], timeout: float = 30.0) -> float:
        """Return when the condition first held; TimeoutError if it did not within ``timeout`` s."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"did not happen within {timeout:g} s; servo: {self.servo()}")
            time.sleep(0.0005)
        return time.monotonic()

    def at_rest(self) -> bool:
        """Whether the set-point stands still."""
        return self.speed() < 1e-9

    def fingers_stopped(self) -> bool:
        """Whether the fingers were stopped on their way."""
        found = self.memory.grippers["panda.gripper"].get()
        return found is not None and found.state.outcome is GripperOutcome.STOPPED

    def nobody_left(self) -> bool:
        """Whether all processes of the rig have ended."""
        self.process.poll()
        return not any(_runs(pid) for pid in self.children)

    def close(self) -> None:
        """End what is left of it."""
        if self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
            self.process.wait(5)
        if self.terminal >= 0:
            os.close(self.terminal)
        with contextlib.suppress(TimeoutError):
            self.wait_for(self.nobody_left, 5.0)


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
