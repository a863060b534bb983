"""Benches of a Robotiq gripper on both kinds of line, against an emulator in real time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from robotiq_kit import emulated_robotiq

from hal.testing import GripperBench

__all__ = ["robotiq_gripper"]


@contextmanager
def robotiq_gripper(line: str) -> Iterator[GripperBench]:
    """A 2F-85 on a ``serial`` line, or on the ``text`` port; activated, and open."""
    with emulated_robotiq(line) as far:
        yield GripperBench(
            driver=far.driver,
            dt=0.01,
            real_time=True,
            patience=0.5,
            lose=lambda: far.execute("unplug on") and None,
            restore=lambda: far.execute("unplug off") and None,
            put_object=lambda width: far.execute(f"object {width}") and None,
        )
