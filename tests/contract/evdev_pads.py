"""Pads recorded from the real kernel drivers, played to the evdev driver through a fake input system.

The identity of a pad is in its ``.umockdev`` description, its ranges in the head of its ``.jsonl``, its events in the
lines below. umockdev itself plays them in ``tests/unit/drivers/evdev/test_evdev.py``; it cannot unplug anything.
"""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from evdev_kit import MODELS, ROOT, STICKS, FakeInput, FakeNode

from hal.drivers.evdev.pad import EvdevPad
from hal.pads.codes import ABS, EV_ABS, EV_KEY, EV_MSC, KEY
from hal.pads.mapper import AxisRange
from hal.pads.model import Identity
from hal.testing import PadBench, pad_spec

PADS = ROOT / "tests" / "data" / "pads"
SOUTH = KEY["BTN_SOUTH"]
DRIVERS = {"ds4": ("sony", 0), "dualsense": ("playstation", 128)}
"""Kernel driver, and its value of the sticks before the first report: hid-sony, full left and up."""


def _event(line: dict[str, Any]) -> tuple[int, int, int]:
    kind, code = (EV_ABS, ABS[line["code"]]) if line["type"] == "abs" else (EV_KEY, KEY[line["code"]])
    return kind, code, line["value"]


class RecordedPad(FakeInput):
    """A pad, with its motion sensor if it has one, that can be unplugged."""

    def __init__(self, name: str, motion: bool) -> None:
        super().__init__()
        head, *lines = [json.loads(line) for line in (PADS / f"{name}.jsonl").read_text().splitlines()]
        about = (PADS / f"{name}.umockdev").read_text()
        bus, vendor, product = (int(number, 16) for number in re.findall(r"PRODUCT=(\w+)/(\w+)/(\w+)/", about)[0])
        title, self._uniq = re.findall(r'NAME="(.+?)"', about)[0], re.findall(r'UNIQ="(.+?)"', about)[0]
        driver, self._at_first = DRIVERS[name]
        self._identity = Identity(title, vendor, product, bus, driver)
        self._axes = {ABS[axis]: AxisRange(*numbers) for axis, numbers in head["ranges"].items()}
        self._keys = sorted({KEY[line["code"]] for line in lines if line["type"] == "key"})
        self._events = [_event(line) for line in lines]
        self._coming: deque[tuple[int, int, int]] = deque()
        self._has_motion = motion
        self.beats = True
        self._pressed = False
        self.plug_in()

    def press(self) -> None:
        """Play the recording from the beginning until south is down, report by report."""
        at = self._events.index((EV_KEY, SOUTH, 1)) + 1
        self._coming, self._pressed = deque(self._events[:at]), True

    def release(self) -> None:
        """Play the rest of the recording until south is up."""
        at = self._events.index((EV_KEY, SOUTH, 1)) + 1
        end = self._events.index((EV_KEY, SOUTH, 0)) + 1
        self._coming, self._pressed = deque(self._events[at:end]), False

    def play_cycle(self) -> None:
        """Send the next report, and one of the motion sensor, which streams all the time."""
        pad, *motion = [node for _, node in self.plugged.values()] or [None]
        if self._coming and pad is not None:
            pad.send(self._coming.popleft())
        for node in motion if self.beats else ():
            node.send((EV_MSC, 5, 1))

    def plug_in(self) -> None:
        """Plug it in, with the buttons that are pressed now."""
        sticks = {ABS[name] for name in STICKS}
        pad = FakeNode("/dev/input/event3", self._axes, self._keys)
        pad.shown = {code: self._at_first if code in sticks else 0 for code in self._axes}
        pad.down = [SOUTH] if self._pressed else []
        pad.speaks = False
        self.put(pad, self._identity, uniq=self._uniq)
        if self._has_motion:
            motion = FakeNode("/dev/input/event4", {ABS["ABS_RX"]: AxisRange(-32768, 32767)}, ())
            title = f"{self._identity.name} Motion Sensors"
            self.put(motion, self._identity._replace(name=title), uniq=self._uniq, pad=False)

    def pull_out(self) -> None:
        for _, node in list(self.plugged.values()):
            self.unplug(node)


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
        lose=pad.pull_out,
        restore=pad.plug_in,
    )
    if motion:
        bench.freeze = lambda: setattr(pad, "beats", False)
    yield bench
    driver.close()
    for node in pad.made:
        node.dispose()
