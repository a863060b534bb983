"""Read the pad that is plugged in with the evdev driver and print its readings, for the tests under umockdev-run.

    python read_pad.py EVENTS

Ends after EVENTS events, or after 20 s. The recording starts to play before this program is up, so events arrive
together; they are passed to the driver report by report, so that every report is a reading.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import yaml

from hal.drivers.evdev.finder import EvdevNode, Event, LinuxInput
from hal.drivers.evdev.pad import EvdevPad
from hal.pads.codes import EV_SYN
from hal.specs import PadSpec


class ReportByReport(EvdevNode):
    """Gives one report per call, and nothing at the first call."""

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
    """The input devices of this machine, or those that umockdev shows."""

    node: ReportByReport

    def open(self, path: str) -> ReportByReport:
        self.node = ReportByReport(path)
        return self.node


def main(expected: int) -> None:
    """Print the pad that was found, then one JSON object for each reading that differs from the one before."""
    folder = Path(__file__).parents[3] / "sensors" / "gamepads"
    models = tuple(yaml.safe_load(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.yaml")))
    system = System()
    pad = EvdevPad(PadSpec("pad", "evdev", None, models), system=system)
    plugged = EvdevPad.list_plugged()
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
