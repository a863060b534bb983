"""Straightness of motions and stops under a stick, and the distance of one key press in a terminal.

    python benchmarks/steps.py [--presses 10]

The reference of the first part is the straight line itself. The second part runs in real time, with an emulated
terminal.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from pathlib import Path

import hal

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "kits"))
from terminal_kit import FarEnd, wait_for

KEYS = {"arrow up": "\x1b[A", "arrow left": "\x1b[D", "Page Up": "\x1b[5~", "J (a turn)": "j"}


def pushes(speed: float, count: int = 10) -> None:
    """Push to and fro for half a second each, with half a second between; print the deviation in height and tilt."""
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        arm = rig.robots["panda"]
        start, first = arm.state().tcp_set, None
        with arm.control(rate_hz=50) as control:
            for turn, _ in enumerate(rig.clock.rate(50)):
                push, phase = divmod(turn, 50)
                if phase == 0 and push == 1:
                    first = arm.state().tcp_set
                if push == count:
                    break
                control.send(hal.Twist([speed * (-1) ** push if phase < 25 else 0.0, 0.0, 0.0]))
        assert first is not None
        for name, pose in (("1 push", first), (f"{count} pushes", arm.state().tcp_set)):
            lost, tilt = 1e3 * (pose.position - start.position)[2], math.degrees(pose.distance(start)[1])
            print(f"  {speed:g} m/s, {name:10s} height {lost:+.2f} mm, tilt {tilt:.3f} degrees")


def keys(presses: int) -> None:
    """Press a terminal's key repeatedly, and reset the world after each press."""
    with FarEnd() as far:
        pad = {"driver": "terminal", "options": {"tty": far.path, "mode": "step"}}
        overrides = ["cameras={}", f"gamepads.pad={pad}".replace("'", '"')]
        with hal.open("panda_table", sim=True, clock="real_time", overrides=overrides) as rig:
            arm = rig.robots["panda"]
            for name, key in KEYS.items():
                found = [_step(rig, arm, far, key, turn) for turn in range(presses)]
                moved = [1e3 * distance for distance, _ in found]
                turned = [math.degrees(angle) for _, angle in found]
                for values, unit in ((moved, "mm"), (turned, "degrees")):
                    spread = f"{min(values):5.1f} / {statistics.median(values):5.1f} / {max(values):5.1f}"
                    print(f"  {name:12s} {spread} {unit}")


def _step(rig: hal.Rig, arm: hal.Robot, far: FarEnd, key: str, turn: int) -> tuple[float, float]:
    rig.world.reset("panda")
    teleop, pad = hal.Teleop(arm), rig.gamepads["pad"]
    with arm.control(deadman=pad.hold("l2"), rate_hz=50) as control:
        wait_for(lambda: pad.state().connected and not pad.waiting_for, "the pad at rest")
        start, pressed, end = arm.state(max_age=2.0).tcp_set, False, time.monotonic() + 1.0
        for tick in rig.clock.rate(50):
            control.send(teleop.step(pad.state(), tick.dt)[0])
            if not pressed and tick.elapsed > 0.2:
                time.sleep(0.0037 * turn % 0.018)  # not in step with the loop
                far.type(key)
                pressed = True
            if time.monotonic() > end:
                break
        return arm.state(max_age=2.0).tcp_set.distance(start)


def main() -> None:
    """Print both parts."""
    parser = argparse.ArgumentParser(description="how straight pushes are, how long a terminal's steps are")
    parser.add_argument("--presses", type=int, default=10, help="of each key (%(default)s)")
    presses = parser.parse_args().presses
    print("pushes along x and stops, from the straight line")
    for speed in (0.2, 0.05):
        pushes(speed)
    print(f"one key of a terminal, {presses} presses, min / median / max")
    keys(presses)


if __name__ == "__main__":
    main()
