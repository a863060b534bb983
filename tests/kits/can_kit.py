"""Emulated arms on a CAN bus for tests: in a thread of the test, or in a process of their own.

with emulated_arm("yam") as bench:                       # `virtual`: only inside this process
    driver = ...                                         # made from bench.spec
    bench.execute("status 3 A")

with EmulatorProcess("yam") as emulator:                 # `udp_multicast`, for a whole rig
    with hal.open("yam", sim=False, pad="none", overrides=emulator.overrides) as rig:
        emulator.execute("cut on")
"""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from hal.config.loader import load
from hal.specs import RobotSpec
from hal_emulators.can.server import CanEmulator, EmulatedArm
from hal_emulators.control import EmulatorControl

_START_LIMIT, _END_LIMIT = 60.0, 15.0
_numbers = itertools.count(1)


def can_overrides(interface: str, arms: tuple[str, ...] = ("arm",)) -> list[str]:
    """Return overrides that put a rig's arms on buses which no other test uses, without cameras."""
    found = ["cameras={}"]
    for name in arms:
        number = next(_numbers)
        block = os.getpid() % 60000
        channel = f"239.{64 + number % 64}.{block // 256}.{block % 256}"
        if interface == "virtual":
            channel = f"test-{os.getpid()}-{number}"
        for device in (name, f"{name}.gripper"):
            found += [f"robots.{device}.real.interface={interface}", f"robots.{device}.real.channel={channel}"]
    return found


@dataclass
class CanBench:
    """An emulator in this process, and the records of the rig that it answers."""

    emulator: CanEmulator
    overrides: list[str]
    """For :func:`hal.open` of the same rig."""
    spec: RobotSpec
    """The rig's first arm."""

    @property
    def arm(self) -> EmulatedArm:
        """The first emulated arm."""
        return self.emulator.arms[self.spec.name]

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of the emulator's console."""
        return self.emulator.execute(line)


@contextlib.contextmanager
def emulated_arm(
    rig: str, *more: str, interface: str = "virtual", arms: tuple[str, ...] = ("arm",)
) -> Iterator[CanBench]:
    """Run an emulator of a rig's arms in threads of this process."""
    overrides = [*can_overrides(interface, arms), *more]
    with CanEmulator(rig, overrides) as emulator:
        spec = load(rig, sim=False, overrides=overrides).resolve().robots[0]
        yield CanBench(emulator, overrides, spec)


class EmulatorProcess:
    """A running ``python -m hal_emulators.can`` on a bus of its own."""

    def __init__(self, rig: str, *more: str, arms: tuple[str, ...] = ("arm",)) -> None:
        """Start it and wait until it is ready. Raises RuntimeError, with its output, if it is not in time."""
        self.overrides = [*can_overrides("udp_multicast", arms), *more]
        """For :func:`hal.open` of the same rig."""
        self.lines: list[str] = []
        """Its output so far."""
        options = [word for value in self.overrides for word in ("--set", value)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "hal_emulators.can", "--config", rig, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._ready = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        ready = self._ready.wait(_START_LIMIT)
        line = next((line for line in self.lines if line.startswith("ready:")), None)
        if not ready or line is None:
            self.process.kill()
            self.process.wait()
            raise RuntimeError("the emulator did not get ready:\n" + "\n".join(self.lines))
        self.control = EmulatorControl("127.0.0.1", int(line.split("control port ")[1].split(";")[0]))

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            if line.startswith("ready:"):
                self._ready.set()
        self._ready.set()

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of the emulator's console."""
        return self.control.send(line)

    def type(self, line: str) -> None:
        """Type a line at its prompt."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def close(self) -> None:
        """End it in any state."""
        self.control.close()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(_END_LIMIT)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._reader.join(_END_LIMIT)
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()

    def __enter__(self) -> EmulatorProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
