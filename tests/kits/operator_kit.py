"""A person who collects a demonstration."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

import pytest

import hal


class Operator(io.StringIO):
    """The program's output, and a person who reads it with a pad in the hands."""

    pad: Any = None

    def __init__(self) -> None:
        super().__init__()
        self.at_home = threading.Event()

    def write(self, text: str) -> int:
        act = {"then hold it until": self.hold, "place the objects": self.start, "RECORDING": self.drive}
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

    def drive(self) -> None:
        self.pad.press("l2")
        self.pad.stick("dpad_y", 1.0)
        time.sleep(1.0)
        self.pad.press("l1")
        time.sleep(1.0)
        self.pad.set(axes={"dpad_y": 0.0}, buttons=("l2",))
        time.sleep(0.5)
        self.pad.release("l2")
        self.tap("home")

    @contextmanager
    def operate(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        """Read what a program prints, and hold the mock pad of the rig that it opens."""
        opened = hal.open

        def open_rig(**options: Any) -> hal.Rig:
            rig = opened(**options)
            self.pad = rig.driver("pad")
            return rig

        with redirect_stdout(self), monkeypatch.context() as patched:
            patched.setattr(hal, "open", open_rig)
            yield
