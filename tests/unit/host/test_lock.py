"""Locks on devices: the error names the program that uses one, or what is left of it."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hal.errors import ControlTaken
from hal.host.process import Child
from hal.lock import DeviceLock

KITS = Path(__file__).parents[2] / "kits"


def refusal(name: str) -> ControlTaken:
    with pytest.raises(ControlTaken) as caught:
        DeviceLock(name, "the arm")
    return caught.value


def test_a_program_that_holds_a_lock_itself_is_named() -> None:
    name = f"test-own-{os.getpid()}"
    lock = DeviceLock(name, "the arm")
    for _ in range(5):
        assert f"process {os.getpid()})" in str(refusal(name)), "also after several attempts"
    lock.release()
    DeviceLock(name, "the arm").release()


def test_long_names_that_differ_at_their_ends_are_two_devices() -> None:
    path = f"test-{os.getpid()}-/dev/serial/by-id/usb-Openlight_Labs_CANable2_b158aa7_github.com_canable2.git_205A"
    locks = [DeviceLock(f"{path}-{k}", "a motor") for k in (1, 2)]
    refusal(f"{path}-2")
    for lock in locks:
        lock.release()


def test_the_program_behind_a_device_process_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(KITS))
    name = f"test-child-{os.getpid()}"
    child = Child("arm", "child_targets:lock_holder", {"name": name})
    child.wait_ready(20.0)
    error = refusal(name)
    assert error.code == ControlTaken("").code
    assert f"process {os.getpid()})" in str(error)
    child.close(timeout=0.0)
    DeviceLock(name, "the arm", patience=5.0).release()


def test_the_rest_of_a_killed_program_is_named_as_such() -> None:
    name = f"test-orphan-{os.getpid()}"
    program = (
        f"import sys, time; sys.path.insert(0, {str(KITS)!r})\n"
        "from hal.host.process import Child\n"
        f"child = Child('arm', 'child_targets:lock_holder', {{'name': {name!r}}})\n"
        "print(child.wait_ready(20.0), flush=True); time.sleep(60.0)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as app:
        assert app.stdout is not None
        orphan = int(app.stdout.readline())
        app.kill()
    try:
        error = refusal(name)
        assert error.code == "still_closing"
        assert f"process {orphan}," in str(error)
    finally:
        os.kill(orphan, signal.SIGKILL)
    DeviceLock(name, "the arm", patience=5.0).release()
