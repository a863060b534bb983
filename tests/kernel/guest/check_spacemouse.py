"""A cap that moves in six ways, in both kinds that its maker sells."""

from __future__ import annotations

import time
from functools import partial

import pytest
from bench import Bench
from kit import Measured, eventually, kernel_driver, node_of, settle, shows

from hal.gamepad import Gamepad
from hal.types import CAP_AXES


@pytest.mark.parametrize("kind", ["relative", "absolute"])
def check_spacemouse(kind: str, bench: Bench, pad: Gamepad, measured: Measured) -> None:
    """Every axis with its sign, a steady push, letting go, both buttons, and the cable."""
    bench.plug(f"spacemouse_{kind}")
    bench.show({"push_x": 0.2})  # touched once
    settle(bench, pad)
    assert "SpaceMouse" in pad.describe()
    assert kernel_driver(node_of(pad)) == "hid-generic"
    assert pad.mapping == "spacemouse"
    slowest = 0.0
    for axes in [{name: sign} for name in CAP_AXES for sign in (1.0, -1.0)]:
        bench.show(axes)
        eventually(partial(shows, pad, axes), f"{axes}", 2.0)
        t = time.monotonic()
        bench.show()
        slowest = max(slowest, eventually(lambda: shows(pad, {}), "letting go is seen", 2.0) - t)
    for button in ("l1", "r1"):
        bench.show({}, (button,))
        eventually(partial(shows, pad, {}, (button,)), button, 2.0)
        bench.show()
        eventually(lambda: shows(pad, {}), "letting go is seen", 2.0)
    bench.show({"push_z": 1.0})
    eventually(lambda: shows(pad, {"push_z": 1.0}), "a push", 2.0)
    end = time.monotonic() + 0.4
    while time.monotonic() < end:
        assert shows(pad, {"push_z": 1.0}), "a steady push is no release"
        time.sleep(0.005)
    t = bench.unplug()
    gone = eventually(lambda: not pad.state().connected, "it is gone") - t
    assert not any(pad.state().axes.values())
    measured(
        f"12 pushes and turns; at rest within {1e3 * slowest:.0f} ms of letting go, gone after {1e3 * gone:.0f} ms"
    )
