"""Plays the pads, in a process of its own: whoever uploads a rumble effect holds Python's lock until the pad answers.

Takes requests as lines of JSON, and answers each with one. See ``bench.py`` for the other side.
"""

from __future__ import annotations

import json
import select
import sys
import time
from typing import Any

from gesture import Device, Gesture, Make
from others import SpaceMouse, UnknownPad
from sony import DualSense, DualShock4
from xbox import Xbox360, XboxOne

MAKES: dict[str, Make] = {
    "dualshock4": DualShock4(),
    "dualshock4_bluetooth": DualShock4(bluetooth=True),
    "dualsense": DualSense(),
    "dualsense_bluetooth": DualSense(bluetooth=True),
    "xbox360": Xbox360(),
    "xbox_one": XboxOne(),
    "spacemouse_relative": SpaceMouse(relative=True),
    "spacemouse_absolute": SpaceMouse(relative=False),
    "unknown": UnknownPad(),
}


class Pad:
    """A pad that is plugged in, and what a hand does to it."""

    def __init__(self, make: Make, number: int, gesture: Gesture, frozen: bool) -> None:
        self.make = make
        self.gesture = gesture
        self.frozen = frozen
        """Still plugged in, but silent."""
        self.device: Device = make.plug(number)
        self.count = 0
        self.due = time.monotonic()

    def report(self) -> None:
        """Say what the hand does."""
        self.count += 1
        for report in self.make.reports(self.gesture, self.count):
            self.device.send(report)

    def beat(self, now: float) -> None:
        """A pad that speaks all the time: say it again when the time has come."""
        period = self.period
        if period is not None and now >= self.due and self.device.listening and not self.frozen:
            self.due = now + period
            self.report()

    @property
    def period(self) -> float | None:
        """s between two reports; None while it speaks only when something changes."""
        return self.make.period(self.gesture)


class Server:
    """Serves one pad at a time."""

    def __init__(self) -> None:
        self.pad: Pad | None = None
        self.plugged = 0

    def run(self) -> None:
        """Until nobody asks any more."""
        while True:
            pad = self.pad
            wanted: list[Any] = [sys.stdin] if pad is None else [sys.stdin, pad.device]
            timeout = None if pad is None or pad.period is None else pad.period / 2
            ready, _, _ = select.select(wanted, [], [], timeout)
            if pad is not None and pad.device in ready:
                try:
                    pad.device.serve()
                except (EOFError, OSError):  # the kernel let go of it
                    self.pad = None
            elif sys.stdin in ready:
                line = sys.stdin.readline()
                if not line:
                    return
                print(json.dumps(self.answer(json.loads(line))), flush=True)
            if self.pad is not None:
                self.pad.beat(time.monotonic())

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what is asked for."""
        what = request["do"]
        gesture = Gesture(request.get("axes", {}), frozenset(request.get("buttons", ())))
        if what == "plug":
            self.plugged += 1
            self.pad = Pad(MAKES[request["make"]], self.plugged, gesture, request["frozen"])
            return {"t": self.pad.device.t_plugged}
        pad = self.pad
        if pad is None:
            return {"error": "no pad is plugged in"}
        if what == "show":
            pad.gesture = gesture
            pad.report()
        elif what == "freeze":
            pad.frozen = bool(request["frozen"])
        elif what == "storm":
            for turn in range(request["reports"]):
                pad.gesture = Gesture({"left_x": -1.0 if turn % 2 else 1.0, "right_y": 1.0 if turn % 2 else -1.0})
                pad.report()
            pad.gesture = gesture
            pad.report()
        elif what == "motors":
            found = ((output.t, pad.make.motors(output.data)) for output in pad.device.outputs)
            return {"motors": [(t, *motors) for t, motors in found if motors is not None]}
        elif what == "unplug":
            self.pad = None
            return {"t": pad.device.unplug()}
        else:
            return {"error": f"nobody knows how to {what}"}
        return {}


if __name__ == "__main__":
    Server().run()
