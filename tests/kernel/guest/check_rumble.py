"""The motors get what a rumble asks for."""

from __future__ import annotations

import time

from bench import Bench
from gesture import Motors
from kinds import Kind
from kit import Measured, eventually, settle

from hal.gamepad import Gamepad


def check_rumble(kind: Kind, bench: Bench, pad: Gamepad, measured: Measured) -> None:
    """How strong each motor runs, when they start and stop; a cable that is pulled in the middle does no harm."""
    bench.plug(kind.make)
    settle(bench, pad)
    t = time.monotonic()
    assert pad.rumble(strong=1.0, weak=0.5, seconds=0.3)
    eventually(lambda: _running(bench, t), "the motors run")
    eventually(lambda: bench.motors[-1][1] == (0, 0), "the motors are told to stop")
    began, motors = _running(bench, t)[0]
    lasted = bench.motors[-1][0] - began
    assert {other for _, other in _running(bench, t)} == {motors}
    assert 0.4 < motors.weak / motors.strong < 0.6
    assert 0.2 < lasted < 1.0

    again = time.monotonic()
    assert pad.rumble(strong=0.25, weak=0.75, seconds=5.0)
    eventually(lambda: _running(bench, again), "the motors run at other strengths")
    _, other = _running(bench, again)[0]
    assert 0.28 < other.strong / other.weak < 0.39
    bench.unplug()
    eventually(lambda: not pad.state().connected, "it is gone", 1.0)
    assert not pad.rumble()
    back = bench.plug(kind.make)
    settle(bench, pad)
    assert pad.rumble()
    eventually(lambda: _running(bench, back), "the motors run again")
    measured(
        f"motors at {motors.strong} and {motors.weak} of the pad's own, "
        f"{1e3 * (began - t):.0f} ms later, for {1e3 * lasted:.0f} ms of 300"
    )


def _running(bench: Bench, since: float) -> list[tuple[float, Motors]]:
    """When (s, monotonic) the motors were told to run since then, and how."""
    return [(when, motors) for when, motors in bench.motors if when >= since and motors != (0, 0)]
