"""An emulated robot for tests, in a process of its own, and the commands that it takes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hal.drivers.franka.emulator.control import Control


def address(k: int) -> str:
    """The k-th loopback address that no other test process uses."""
    pid = os.getpid()
    return f"127.{4 + k}.{pid >> 8 & 0xFF}.{pid & 0xFF}"


@contextmanager
def emulator(host: str, *options: str) -> Iterator[Control]:
    """Runs while the block runs; the emulator's own options are passed on."""
    process = subprocess.Popen(
        [sys.executable, "-m", "hal.drivers.franka.emulator", "--host", host, *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert "ready" in line, line
        with Control(host) as control:
            yield control
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
