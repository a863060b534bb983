"""A user who may not read the pad is told what to do, and need not restart anything."""

from __future__ import annotations

import glob
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

from bench import Bench
from kit import Measured, eventually

from hal.drivers.evdev.pad import EvdevPad
from hal.specs import PadSpec

_NOBODY = 65534


@contextmanager
def _unprivileged() -> Iterator[None]:
    os.setresuid(_NOBODY, _NOBODY, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)


def check_no_permission(bench: Bench, spec: PadSpec, measured: Measured) -> None:
    """The note names the command; the pad connects, and is trusted, when its devices may be read one by one."""
    bench.plug("dualshock4_bluetooth")
    eventually(lambda: len(EvdevPad.list_plugged().pads) == 1, "the pad is there")
    (node,) = EvdevPad.list_plugged().devices
    others = [path for path in glob.glob("/dev/input/event*") if path != node]
    driver = EvdevPad(spec)

    def connected() -> bool:
        with _unprivileged():
            return driver.poll(time.monotonic(), 0.005).connected

    with _unprivileged():
        driver.open()
        plugged = EvdevPad.list_plugged()
    try:
        assert not connected()
        for notes in (driver.notes, plugged.notes):
            assert any("sudo usermod -aG input $USER" in note for note in notes)
        assert not plugged.pads
        os.chmod(node, 0o666)
        t = time.monotonic()
        took = eventually(connected, "it connects when it may be read") - t
        assert not driver.proves_liveness, "its motion sensor may not be read yet"
        for path in others:
            os.chmod(path, 0o666)
        eventually(lambda: connected() and driver.proves_liveness, "its motion sensor is heard")
    finally:
        driver.close()
    measured(f"connected {1e3 * took:.0f} ms after the permission was given")
