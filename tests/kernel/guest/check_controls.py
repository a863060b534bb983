"""The right model is chosen, and every control is where it should be."""

from __future__ import annotations

import time
from functools import partial

from bench import Bench
from kinds import Kind
from kit import Measured, eventually, kernel_driver, node_of, settle, shows

from hal.drivers.evdev.pad import EvdevPad
from hal.gamepad import Gamepad


def check_controls(kind: Kind, bench: Bench, pad: Gamepad, measured: Measured) -> None:
    """Each axis and button alone, with its sign and all of its travel."""
    bench.plug(kind.make)
    settle(bench, pad)
    assert pad.describe().startswith(kind.description)
    assert kernel_driver(node_of(pad)) == kind.driver
    assert EvdevPad.list_plugged().devices == (node_of(pad),)
    assert not pad.notes
    slowest = 0.0
    for axes, buttons in kind.gestures():
        t = time.monotonic()
        bench.show(axes, buttons)
        slowest = max(slowest, eventually(partial(shows, pad, axes, buttons), f"{axes} {buttons}", 2.0) - t)
    bench.show({"left_x": 0.5, "right_y": -0.5})
    eventually(lambda: 0.3 < pad.state().axis("left_x") < 0.5, "a stick half way is half way")
    eventually(lambda: -0.5 < pad.state().axis("right_y") < -0.3, "a stick half way is half way")
    measured(f"{len(kind.gestures())} positions of controls, each shown within {1e3 * slowest:.0f} ms")
