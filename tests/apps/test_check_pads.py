"""``hal check --pads`` as a person starts it, with recorded pads under umockdev, and without any."""

from __future__ import annotations

import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

if sys.platform != "linux":
    pytest.skip("pads are Linux only", allow_module_level=True)
if shutil.which("umockdev-run") is None:
    pytest.skip("needs umockdev: sudo apt install umockdev", allow_module_level=True)
pytest.importorskip("evdev", reason="needs python-evdev: pip install evdev-binary")

ROOT = Path(__file__).resolve().parents[2]
PADS = ROOT / "tests" / "data" / "pads"
CHECK = [sys.executable, str(ROOT / "apps" / "check.py"), "--pads"]
NODE = "/dev/input/event3"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A DualShock 4 that is pressed on South once a second."""
    for ending in ("umockdev", "ioctl"):  # umockdev looks for its files beside each other
        shutil.copy(PADS / f"ds4.{ending}", tmp_path)
    sticks = [f"E: 0.500000 0003 {code:04x} 128" for code in (0, 1, 3, 4)]
    presses = [
        f"E: {second + half:.6f} {event}"
        for second in range(1, 60)
        for half, value in ((0.0, 1), (0.5, 0))
        for event in (f"0001 0130 {value}", "0000 0000 0")
    ]
    lines = ["# EVEMU 1.2", f"# device {NODE}", *sticks, "E: 0.500000 0000 0000 0", *presses]
    (tmp_path / "ds4.events").write_text("\n".join(lines) + "\n")
    return tmp_path


def command(*arguments: str, pad: str | None = "ds4", events: bool = True) -> list[str]:
    """The check with that pad plugged in, and no other device of this machine."""
    found = ["umockdev-run"]
    if pad is not None:
        found += ["-d", f"{pad}.umockdev", "-i", f"{NODE}=ds4.ioctl"]
        found += ["-e", f"{NODE}=ds4.events"] if events else []
    return [*found, "--", *CHECK, *arguments]


def run(folder: Path, *arguments: str, pad: str | None = "ds4") -> subprocess.CompletedProcess[str]:
    wanted = command(*arguments, pad=pad, events=False)
    return subprocess.run(wanted, cwd=folder, capture_output=True, text=True, timeout=60, check=False)


@contextmanager
def running(folder: Path, stdout: int) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command(), cwd=folder, stdout=stdout, stderr=subprocess.PIPE, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def read_until(fd: int, wanted: str, limit: float = 50.0) -> str:
    """What came until it held that."""
    found, end = "", time.monotonic() + limit
    while wanted not in found:
        left = end - time.monotonic()
        assert left > 0.0, f"{wanted!r} never came; this did:\n{found}"
        if select.select([fd], [], [], left)[0]:
            piece = os.read(fd, 65536)
            assert piece, f"it ended:\n{found}"
            found += piece.decode()
    return found


def test_a_pad_is_shown_with_what_a_person_must_know_of_it(folder: Path) -> None:
    done = run(folder, "--duration", "0.3")
    assert (done.returncode, done.stderr) == (0, "")
    lines = {line[:24].strip(): line[25:].strip() for line in done.stdout.splitlines() if line.startswith(" " * 10)}
    assert done.stdout.startswith(f"DualShock 4 (USB, {NODE})\n")
    assert lines["model"] == "dualshock4"
    assert lines["ids"] == "054c:05c4"
    assert lines["kernel driver"] == "sony"
    assert lines["device"] == NODE
    assert lines["mapping"] == "default"
    assert lines["real arm"] == "may be the dead-man"


def test_without_a_terminal_every_change_is_a_line_until_ctrl_c(folder: Path) -> None:
    with running(folder, subprocess.PIPE) as process:
        assert process.stdout is not None
        text = read_until(process.stdout.fileno(), f"{NODE}: [south]\n")
        read_until(process.stdout.fileno(), f"{NODE}: at rest\n")
        process.send_signal(signal.SIGINT)  # umockdev-run passes it on: the check gets one, as from a terminal
        _, errors = process.communicate(timeout=30)
    assert "\x1b" not in text
    assert errors == b""


def test_on_a_terminal_one_line_is_drawn_again_and_again(folder: Path) -> None:
    ours, theirs = pty.openpty()
    try:
        with running(folder, theirs) as process:
            text = read_until(ours, f"{NODE}: [south]")
            text += read_until(ours, f"{NODE}: at rest")
            process.send_signal(signal.SIGINT)
            process.wait(timeout=30)
    finally:
        os.close(ours)
        os.close(theirs)
    assert f"\r\x1b[K{NODE}: at rest" in text
    assert text.count("DualShock 4 (USB") == 1


def test_an_unknown_pad_comes_with_a_profile_to_paste(folder: Path) -> None:
    text = (folder / "ds4.umockdev").read_text()
    (folder / "odd.umockdev").write_text(text.replace("054C", "1234").replace("54c", "1234").replace("01234", "1234"))
    done = run(folder, "--duration", "0.3", pad="odd")
    assert done.returncode == 0, done.stderr
    assert "(guessed)" in done.stdout
    assert "1234:05c4" in done.stdout
    assert "cannot be the dead-man of a real arm" in done.stdout
    for line in ("- vendor: 0x1234", "  product: 0x05c4", "  wireless: true", "  ABS_RX: right_x", "  BTN_TL2: l2"):
        assert f"\n{line}\n" in done.stdout


def test_the_pads_of_a_rig_are_chosen_by_its_options(folder: Path) -> None:
    done = run(folder, "--duration", "0.5", "--set", "gamepads.pad.options.name=computer")
    assert done.returncode == 0, done.stderr
    assert "DualShock 4" in done.stdout
    done = run(folder, "--duration", "0.5", "--set", "gamepads.pad.options.name=nobody")
    assert done.returncode == 2
    assert "Sony Computer Entertainment Wireless Controller" in done.stdout
    assert "DualShock 4" not in done.stdout
    done = run(folder, "--duration", "0.3", "--set", "gamepads.pad.driver=web")
    assert done.returncode == 2
    assert "pad: driver web is not a plugged-in gamepad" in done.stdout


def test_no_pad_is_said_and_is_the_exit_status(folder: Path) -> None:
    done = run(folder, "--duration", "0.3", pad=None)
    assert (done.returncode, done.stderr) == (2, "")
    assert "no gamepad detected; plug one in at any time" in done.stdout
