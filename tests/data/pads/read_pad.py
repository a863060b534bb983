"""Reads the pad that is plugged in with the evdev driver and prints what it says, for the tests under umockdev-run.

    python read_pad.py EVENTS

Ends when EVENTS events came, or after 20 s. The recording starts to play before this program is up, so events arrive
together; they are handed to the driver report by report, for every one of them to be seen.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import yaml

from hal.drivers.evdev.node import EvdevNode, Event
from hal.drivers.evdev.pad import EvdevPad
from hal.drivers.evdev.system import LinuxInput
from hal.pads.codes import EV_SYN
from hal.specs import PadSpec


class ReportByReport(EvdevNode):
    """Hands out one report per call, and nothing at the first call."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.waiting: list[Event] = []
        self.calls = 0

    def read(self) -> Sequence[Event]:
        self.calls += 1
        if self.calls == 1:
            return ()
        self.waiting += super().read()
        ends = [place for place, event in enumerate(self.waiting) if event.kind == EV_SYN]
        end = ends[0] + 1 if ends else 0
        report, self.waiting = self.waiting[:end], self.waiting[end:]
        return report


class System(LinuxInput):
    """This machine's input devices, or what umockdev shows of them."""

    node: ReportByReport

    def open(self, path: str) -> ReportByReport:
        self.node = ReportByReport(path)
        return self.node


def main(expected: int) -> None:
    """One JSON object per reading that differs from the one before; first of all, what was found."""
    folder = Path(__file__).parents[3] / "sensors" / "gamepads"
    models = tuple(yaml.safe_load(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.yaml")))
    system = System()
    pad = EvdevPad(PadSpec("pad", "evdev", None, models), system=system)
    plugged = EvdevPad.plugged()
    pad.open()
    reading = pad.poll(time.monotonic(), 0.0)
    found = {"describe": pad.describe(), "plugged": plugged.pads, "notes": pad.notes, "flat": dict(pad.flat)}
    print(json.dumps({**found, "trusted": pad.proves_liveness, "unknown": sorted(reading.unknown)}))
    end = time.monotonic() + 20.0
    while reading.seq < expected and time.monotonic() < end:
        last, reading = reading, pad.poll(time.monotonic(), 0.0 if system.node.waiting else 0.05)
        if (reading.axes, reading.buttons) != (last.axes, last.buttons):
            print(json.dumps({"axes": dict(reading.axes), "buttons": sorted(reading.buttons)}))
    print(json.dumps({"events": reading.seq, "connected": reading.connected, "unknown": sorted(reading.unknown)}))
    pad.close()


if __name__ == "__main__":
    main(int(sys.argv[1]))
