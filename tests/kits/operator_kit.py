"""A person who collects a demonstration."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

import pytest

import hal


def drive_forwards(person: Operator) -> None:
    """Drive forwards, then up as well, until the arm is at rest."""
    pad = person.pad
    pad.press("l2")
    pad.stick("dpad_y", 1.0)
    time.sleep(1.0)
    pad.press("l1")
    time.sleep(1.0)
    pad.set(axes={"dpad_y": 0.0}, buttons=("l2",))
    time.sleep(0.5)


class Operator(io.StringIO):
    """The program's output, and a person who reads it with a pad in the hands."""

    def __init__(self, drive: Callable[[Operator], None] = drive_forwards) -> None:
        """``drive`` moves the arm by :attr:`pad`, with its dead-man, while the episode is recorded."""
        super().__init__()
        self.pad: Any = None
        self.drive = drive
        self.at_home = threading.Event()

    def write(self, text: str) -> int:
        act = {"then hold it until": self.hold, "place the objects": self.start, "RECORDING": self.record}
        for words, what in act.items():
            if words in text:
                threading.Thread(target=what).start()
        return super().write(text)

    def hold(self) -> None:
        while not self.at_home.wait(2.0):  # a press that was too early does not count
            self.pad.release("l2")
            time.sleep(0.2)
            self.pad.press("l2")

    def start(self) -> None:
        self.at_home.set()
        self.pad.release("l2")
        self.tap("south")

    def tap(self, button: str) -> None:
        time.sleep(0.2)
        self.pad.press(button)
        time.sleep(0.2)
        self.pad.release(button)

    def record(self) -> None:
        self.drive(self)
        self.pad.release("l2")
        self.tap("home")

    @contextmanager
    def operate(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        """Read what a program prints, and hold the mock pad of the rig that it opens."""
        opened = hal.open

        def open_rig(**options: Any) -> hal.Rig:
            self.rig = opened(**options)
            self.pad = self.rig.driver("pad")
            return self.rig

        with redirect_stdout(self), monkeypatch.context() as patched:
            patched.setattr(hal, "open", open_rig)
            yield
