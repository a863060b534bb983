"""The kernel's buffer is full, and events are lost (SYN_DROPPED)."""

from __future__ import annotations

import time

import evdev
import pytest
from bench import Bench
from evdev import ecodes
from kinds import KINDS, Kind
from kit import Measured, eventually, node_of

from hal.drivers.evdev.pad import EvdevPad

_REPORTS = 200
_TWO = [kind for kind in KINDS if kind.make in ("dualshock4", "xbox360")]  # the buffer is not the pad's


@pytest.mark.parametrize("kind", _TWO, ids=str)
def check_overflow(kind: Kind, bench: Bench, driver: EvdevPad, measured: Measured) -> None:
    """Nobody reads while much happens: what is shown afterwards is how the pad is held."""
    bench.plug(kind.make)
    last = driver.poll(time.monotonic(), 0.0)

    def poll() -> bool:
        nonlocal last
        last = driver.poll(time.monotonic(), 0.0)
        return last.connected

    eventually(poll, "the pad connects")
    bench.show({"l2": 1.0}, ("north",))
    eventually(lambda: poll() and last.axes["l2"] == 1.0 and "north" in last.buttons, "its controls are seen")
    witness = evdev.InputDevice(node_of(driver))  # has a buffer of its own, which overflows like the driver's
    held = {"left_y": 1.0, "dpad_x": 1.0}
    bench.storm(_REPORTS, held, ("east",))
    eventually(lambda: witness.absinfo(ecodes.ABS_HAT0X).value == 1, "the storm is over")
    kept = [(event.type, event.code) for event in witness.read()]
    witness.close()
    assert (ecodes.EV_SYN, ecodes.SYN_DROPPED) in kept, "the kernel dropped events"
    eventually(lambda: poll() and last.buttons == {"east"}, "what is pressed is seen, and what was let go of")
    wrong = {name: value for name, value in last.axes.items() if abs(value - held.get(name, 0.0)) > 0.02}
    assert not wrong
    bench.show()
    eventually(lambda: poll() and not last.buttons, "it goes on")
    measured(f"{_REPORTS} reports while nobody read; SYN_DROPPED, and {len(kept) - 1} events after it")
