"""The vendor's piper_sdk, unmodified and in a process of its own, against the emulated PiPER in another one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hal.drivers.can.settings import BusSettings

pytest.importorskip("piper_sdk", reason="needs piper_sdk: pip install 'robot-hal[test]'")

CLIENT = Path(__file__).with_name("piper_client.py")
TARGETS = [12_345, 45_678, -67_891, 23_456, -34_567, 98_765]
"""Those of the client, 0.001 degrees."""


def line_of(process: subprocess.Popen[str], word: str) -> str:
    """Return the rest of the next line that begins with a word."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(word):
            return line.removeprefix(word).strip()
    raise AssertionError(f"the process ended without the line {word!r}")


def test_the_vendors_sdk_drives_the_emulator_and_notices_its_end() -> None:
    channel = f"239.74.{128 + os.getpid() // 250 % 100}.{1 + os.getpid() % 250}"
    bus = {"interface": "udp_multicast", "channel": channel}
    rig = ["--config", "piper", "--set", "sim=false"]
    for key in ("robots.arm.real", "robots.arm.gripper.real"):
        rig += ["--set", f"{key}={json.dumps(bus)}"]
    port = BusSettings(**bus).arguments()["port"]
    environment = os.environ | {"CAN_CONFIG": json.dumps({"port": port, "hop_limit": 0})}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    emulator = subprocess.Popen([sys.executable, "-m", "hal_emulators.can", *rig], **pipes)  # type: ignore[call-overload]
    client: subprocess.Popen[str] | None = None
    try:
        line_of(emulator, "ready")
        client = subprocess.Popen([sys.executable, str(CLIENT), channel], env=environment, **pipes)  # type: ignore[call-overload]
        assert client is not None
        assert client.stdin is not None
        report = json.loads(line_of(client, "ready"))
        assert report["joints"] == pytest.approx(TARGETS, abs=1)
        assert (report["arm_status"], report["ok"]) == (0, True)
        assert report["firmware"].startswith("S-V")
        emulator.kill()
        emulator.wait()
        client.stdin.write("\n")
        client.stdin.flush()
        assert json.loads(line_of(client, "lost"))["seconds"] < 0.5
    finally:
        for process in (client, emulator):
            if process is not None:
                process.kill()
                process.communicate()
