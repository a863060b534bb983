"""Two simulated arms, two pads and a camera in real time: missed ticks, and which arm stops for which pad.

    python benchmarks/two_arms.py [--seconds N]

Both arms are driven up and down for N seconds by a hal.TeleopSession with independent=True. The dead-man of the left
pad is released a few times, and its pad unplugged once. Printed are the share of missed ticks of the servos, the time
from the release to the begin of the left arm's stop, the same for the unplugged pad, and whether the right arm goes on.
"""

from __future__ import annotations

import argparse
import statistics
import threading
import time
from collections.abc import Callable
from typing import Any

import hal
from hal.types import RobotStatus

RIG: dict[str, Any] = {
    "robots": {
        name: {"model": "panda", "base": {"position": [0, y, 0]}} for name, y in (("left", 0.5), ("right", -0.5))
    },
    "cameras": {
        "scene": {
            "model": "pinhole",
            "look_at": {"target": [0.4, 0, 0.3], "distance": 2.0},
            "field_of_view": {"horizontal_deg": 60},
        }
    },
    "gamepads": {name: {"driver": "mock", "drives": name.removesuffix("_pad")} for name in ("left_pad", "right_pad")},
    "objects": ["floor"],
}
PERIOD = 3.0
"""Time between two changes of direction, s."""


def main() -> None:
    """Drive, release, unplug, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    seconds = parser.parse_args().seconds
    with hal.open(RIG, sim=True) as rig:
        arms = [rig.robots["left"], rig.robots["right"]]
        session = hal.TeleopSession(rig, arms, independent=True, on_event=lambda event: print("  ", event.text))
        hand = threading.Thread(target=operate, args=(rig, seconds, releases := [], unplugged := []))
        hand.start()
        session.run(lambda state: "" if hand.is_alive() else "done")
        ticks = rig.statistics()["simulation"]
        print(f"ticks {ticks['ticks']}, missed {ticks['missed']} ({100 * ticks['missed'] / ticks['ticks']:.3f} %)")
    report("released", releases)
    report("unplugged", unplugged)


def operate(rig: hal.Rig, seconds: float, releases: list[Any], unplugged: list[Any]) -> None:
    """Move both arms up and down; release the left dead-man in every fourth motion, and unplug its pad at the end."""
    left, right = (rig.gamepads[f"{name}_pad"].driver for name in ("left", "right"))
    end, count = time.monotonic() + seconds, 0
    time.sleep(0.5)
    while time.monotonic() < end:
        count += 1
        way = "l1" if count % 2 else "r1"
        for pad in (left, right):
            pad.press("l2", way)
        time.sleep(PERIOD / 2)
        if count % 4 == 1:
            releases.append(watch(rig, lambda: left.release("l2")))
        time.sleep(PERIOD / 2)
        for pad in (left, right):
            pad.release("l2", way)
        time.sleep(0.5)
    for pad in (left, right):
        pad.press("l2", "l1" if count % 2 == 0 else "r1")
    time.sleep(1.0)
    unplugged.append(watch(rig, lambda: left.inject(disconnect=True)))
    right.release("l2")


def watch(rig: hal.Rig, act: Callable[[], object]) -> tuple[float, bool]:
    """Act on the left pad in mid-motion.

    Returns:
        The time until its arm's stop begins, s, and whether the right arm follows its pad all the time.
    """
    began = time.monotonic()
    act()
    time.sleep(0.5)
    left, right = (rig.robots[name].states(after=began) for name in ("left", "right"))
    stop = next((state.stamp.t for state in left if state.status is not RobotStatus.FOLLOWING), float("inf"))
    return stop - began, all(state.status is RobotStatus.FOLLOWING for state in right)


def report(what: str, found: list[tuple[float, bool]]) -> None:
    """Print the median and the greatest delay, and how often the right arm followed its pad all the time."""
    delays = [1e3 * delay for delay, _ in found]
    print(
        f"{what}: {len(found)} times, the left arm's stop begins after {statistics.median(delays):.1f} ms, at most "
        f"{max(delays):.1f} ms; the right arm goes on in {sum(on for _, on in found)} of them"
    )


if __name__ == "__main__":
    main()
