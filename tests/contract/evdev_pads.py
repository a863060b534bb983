"""Pads recorded from the real kernel drivers, played to the evdev driver through devices on pipes.

The identity of a pad is in its ``.umockdev`` description, its ranges in the head of its ``.jsonl``, its events in the
lines below. umockdev itself plays them in ``tests/unit/drivers/evdev/test_evdev.py``; it cannot unplug anything.
"""

from __future__ import annotations

import errno
import json
import os
import re
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from hal.drivers.evdev.finder import Event, NodeInfo
from hal.drivers.evdev.pad import EvdevPad
from hal.pads.codes import ABS, EV_ABS, EV_KEY, EV_MSC, EV_SYN, KEY, SYN_REPORT
from hal.pads.mapper import AxisRange
from hal.pads.model import Identity
from hal.testing import PadBench, pad_spec

__all__ = ["recorded_pad"]

ROOT = Path(__file__).parents[2]
PADS = ROOT / "tests" / "data" / "pads"
MODELS = tuple(yaml.safe_load(path.read_text()) for path in sorted((ROOT / "sensors" / "gamepads").glob("*.yaml")))
MOTION = " Motion Sensors"
SOUTH = KEY["BTN_SOUTH"]
STICKS = {ABS[name] for name in ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY")}
DRIVERS = {"ds4": ("sony", 0), "dualsense": ("playstation", 128)}
"""Kernel driver, and its value of the sticks before the first report: hid-sony, full left and up."""


class PipeNode:
    """An input device whose events come through a pipe, so that waiting for it and losing it are real."""

    rels: frozenset[int] = frozenset()
    can_rumble = False

    def __init__(self, path: str, axes: dict[int, AxisRange], keys: Sequence[int] = (), shown: int = 0) -> None:
        """``shown`` is the kernel's value of the sticks before the first report."""
        self.path, self.axes, self.keys, self.shown = path, axes, frozenset(keys), shown
        self.held: list[int] = []
        """Buttons that are pressed when it is plugged in."""
        self._waiting: list[Event] = []
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._gone = False

    def send(self, *events: tuple[int, int, int]) -> None:
        """Send one report."""
        t = time.monotonic()
        self._waiting += [Event(*event, t, t) for event in (*events, (EV_SYN, SYN_REPORT, 0))]
        os.write(self._writer, b".")

    def unplug(self) -> None:
        """Hang up."""
        self._gone = True
        os.close(self._writer)

    def fileno(self) -> int:
        return self._reader

    def read(self) -> Sequence[Event]:
        if self._gone:
            raise OSError(errno.ENODEV, "No such device")
        events, self._waiting = self._waiting, []
        if events:
            os.read(self._reader, 65536)
        return events

    def snapshot(self) -> tuple[dict[int, int], list[int]]:
        return {code: self.shown if code in STICKS else 0 for code in self.axes}, list(self.held)

    def claim(self) -> bool:
        return True

    def close(self) -> None:
        """Nothing: the bench closes the pipe."""

    def dispose(self) -> None:
        for fd in (self._reader,) if self._gone else (self._reader, self._writer):
            os.close(fd)


def _event(line: dict[str, Any]) -> tuple[int, int, int]:
    kind, code = (EV_ABS, ABS[line["code"]]) if line["type"] == "abs" else (EV_KEY, KEY[line["code"]])
    return kind, code, line["value"]


class RecordedPad:
    """A pad with its motion sensor that can be unplugged: the input system of the driver."""

    def __init__(self, name: str, motion: bool) -> None:
        head, *lines = [json.loads(line) for line in (PADS / f"{name}.jsonl").read_text().splitlines()]
        about = (PADS / f"{name}.umockdev").read_text()
        bus, vendor, product = (int(number, 16) for number in re.findall(r"PRODUCT=(\w+)/(\w+)/(\w+)/", about)[0])
        title, uniq = re.findall(r'NAME="(.+?)"', about)[0], re.findall(r'UNIQ="(.+?)"', about)[0]
        driver, self._shown = DRIVERS[name]
        identity = Identity(title, vendor, product, bus, driver)
        self._axes = {ABS[axis]: AxisRange(*numbers) for axis, numbers in head["ranges"].items()}
        self._keys = sorted({KEY[line["code"]] for line in lines if line["type"] == "key"})
        self._events = [_event(line) for line in lines]
        self._coming: deque[tuple[int, int, int]] = deque()
        self._pad = NodeInfo("/dev/input/event3", identity, uniq, "", True)
        self._motion = NodeInfo("/dev/input/event4", identity._replace(name=title + MOTION), uniq, "", False)
        self._has_motion = motion
        self.beats = True
        self._down = False
        self._plugged: dict[str, tuple[NodeInfo, PipeNode]] = {}
        self._made: list[PipeNode] = []
        self._changes = 0
        self.plug()

    # The user.

    def press(self) -> None:
        """Play the recording from the beginning until south is down, report by report."""
        at = self._events.index((EV_KEY, SOUTH, 1)) + 1
        self._coming, self._down = deque(self._events[:at]), True

    def release(self) -> None:
        """Play the rest of the recording until south is up."""
        at = self._events.index((EV_KEY, SOUTH, 1)) + 1
        end = self._events.index((EV_KEY, SOUTH, 0)) + 1
        self._coming, self._down = deque(self._events[at:end]), False

    def play_cycle(self) -> None:
        """Send the next report, and one of the motion sensor, which streams all the time."""
        if self._coming and self._plugged:
            self._plugged[self._pad.path][1].send(self._coming.popleft())
        if self._motion.path in self._plugged and self.beats:
            self._plugged[self._motion.path][1].send((EV_MSC, 5, 1))

    def plug(self) -> None:
        """Plug it in, with the buttons that are pressed now."""
        node = PipeNode(self._pad.path, self._axes, self._keys, self._shown)
        node.held = [SOUTH] if self._down else []
        self._plugged = {node.path: (self._pad, node)}
        if self._has_motion:
            motion = PipeNode(self._motion.path, {ABS["ABS_RX"]: AxisRange(-32768, 32767)})
            self._plugged[motion.path] = self._motion, motion
        self._made += [node for _, node in self._plugged.values()]
        self._changes += 1

    def unplug(self) -> None:
        for _, node in self._plugged.values():
            node.unplug()
        self._plugged = {}
        self._changes += 1

    def dispose(self) -> None:
        for node in self._made:
            node.dispose()

    # The driver's input system.

    def nodes(self) -> list[NodeInfo]:
        return [info for info, _ in self._plugged.values()]

    def fingerprint(self) -> object:
        return self._changes

    def open(self, path: str) -> PipeNode:
        if path not in self._plugged:
            raise OSError(errno.ENODEV, "No such device")
        return self._plugged[path][1]


@contextmanager
def recorded_pad(name: str, *, motion: bool) -> Iterator[PadBench]:
    pad = RecordedPad(name, motion)
    driver = EvdevPad(pad_spec(driver="evdev", models=MODELS), system=pad)
    bench = PadBench(
        driver=driver,
        real_time=True,
        patience=5.0,
        advance=pad.play_cycle,
        press=pad.press,
        release=pad.release,
        lose=pad.unplug,
        restore=pad.plug,
    )
    if motion:
        bench.freeze = lambda: setattr(pad, "beats", False)
    yield bench
    driver.close()
    pad.dispose()
