"""What a dead-man relies on: a pad that falls silent or loses its cable is noticed."""

from __future__ import annotations

import time

import pytest
from bench import Bench
from kinds import Kind
from kit import Measured, eventually, settle

from hal.deadman import Deadman
from hal.drivers.evdev.pad import EvdevPad
from hal.errors import NotSupported
from hal.gamepad import Gamepad

_GRIP = {"l2": 1.0, "left_x": 1.0}, ("south",)


def check_liveness(kind: Kind, bench: Bench, pad: Gamepad, driver: EvdevPad, measured: Measured) -> None:
    """It is trusted as a dead-man, for its motion sensor or its cable would tell."""
    deadman = pad.hold("l2")
    with pytest.raises(NotSupported):
        deadman.check_trust()  # nothing is plugged in
    bench.plug(kind.make)
    settle(bench, pad)
    eventually(lambda: driver.proves_liveness, "its liveness is proven")
    deadman.check_trust()
    before = deadman.record.t_alive
    eventually(lambda: deadman.record.t_alive > before + 0.3, "it is alive while nobody touches it")
    if not kind.sony:
        measured("by its cable")
        return
    bench.freeze()
    t = time.monotonic()
    silent = eventually(lambda: _age(deadman) > 0.15, "a silent pad is noticed") - t
    time.sleep(0.3)
    assert _age(deadman) > 0.4, "nothing but its own voice shows that it is alive"
    assert pad.state().connected
    bench.freeze(False)
    t = time.monotonic()
    again = eventually(lambda: _age(deadman) < 0.1, "it is heard again") - t
    measured(
        f"by its motion sensor: silent for 150 ms {1e3 * silent:.0f} ms later, heard again in {1e3 * again:.0f} ms"
    )


def _age(deadman: Deadman) -> float:
    return time.monotonic() - deadman.record.t_alive


def check_unplugged_while_held(kind: Kind, bench: Bench, pad: Gamepad, measured: Measured) -> None:
    """The dead-man is released at once; the pad comes back, and counts when it was let go of."""
    deadman = pad.hold("l2")
    bench.plug(kind.make)
    settle(bench, pad)
    eventually(lambda: deadman.connected and not deadman.held, "the dead-man is seen released")
    bench.show(*_GRIP)
    eventually(lambda: deadman.held, "the dead-man is held")
    eventually(lambda: pad.state().axis("left_x") > 0.9 and pad.state().pressed("south"), "its other controls count")

    t = bench.unplug()
    released = eventually(lambda: not deadman.held, "the dead-man is released", 1.0) - t
    gone = eventually(lambda: not pad.state().connected, "it is gone", 1.0) - t
    assert not deadman.connected
    assert not any(pad.state().axes.values())
    assert not pad.state().buttons

    t = bench.plug(kind.make, *_GRIP)
    back = eventually(lambda: pad.state().connected, "it is back", 3.0) - t
    _held_all_the_time(bench, pad, deadman)
    settle(bench, pad)
    assert deadman.record.presses == 1
    bench.show(*_GRIP)
    eventually(lambda: deadman.held and pad.state().axis("left_x") > 0.9, "let go of and pressed again, it counts")
    times = f"dead-man released {1e3 * released:.0f} ms, gone {1e3 * gone:.0f} ms after the cable was pulled"
    measured(f"{times}; back {1e3 * back:.0f} ms after it was plugged in")


def check_plugged_in_while_held(kind: Kind, bench: Bench, pad: Gamepad) -> None:
    """Before a pad's first report the kernel may show it at rest, or its sticks to the left: neither is true."""
    deadman = pad.hold("l2")
    bench.plug(kind.make, *_GRIP, frozen=True)
    eventually(lambda: pad.state().connected, "it is there")
    time.sleep(0.05)
    assert not any(pad.state().axes.values()), "what nobody has said moves nothing"
    bench.freeze(False)
    _held_all_the_time(bench, pad, deadman)
    settle(bench, pad)
    bench.show(*_GRIP)
    eventually(lambda: deadman.held and pad.state().axis("left_x") > 0.9, "let go of and pressed, it counts")


def _held_all_the_time(bench: Bench, pad: Gamepad, deadman: Deadman) -> None:
    """Neither the dead-man nor anything else counts."""
    for _ in range(30):
        bench.show(*_GRIP)  # a hand trembles: a pad that tells of changes soon says how it is held
        assert not deadman.held, "a dead-man that was held all the time does not count"
        assert not any(pad.state().axes.values()), "what was held all the time moves nothing"
        assert not pad.state().buttons
        time.sleep(0.01)
    assert {"l2", "left_x"} <= set(pad.waiting_for)
