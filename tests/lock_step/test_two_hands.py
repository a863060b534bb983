"""The hands of a headset, played in lock-step: each drives its own arm, by the console's messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import hal
from hal.drivers.web.pad import PadQueue, WebPad, pad_reading
from hal.gamepad import Gamepad
from hal.learning.replay import RecordedTrajectory, TrajectoryPlayer
from hal.recording import Dataset, Recorder
from hal.specs import PadSpec
from hal.types import PAGE_AXES

RIG = {
    "robots": {
        "left": {"model": "panda", "base": {"position": [0.0, 0.5, 0.0]}},
        "right": {"model": "panda", "base": {"position": [0.0, -0.5, 0.0]}},
    }
}
SIDES = {"left": "any", "right": "right"}
"""Arm -> side of the hand that drives it: the right hand has a pad of its own."""
SPEED = 0.1
"""m/s of every hand, between 1 and 2 s."""


class Page:
    """A page in a headset, which sends what both hands do at a time."""

    driver = "page 1"
    deadman = "l2"
    stop_count = 0

    def __init__(self) -> None:
        self.queues: list[PadQueue] = []

    def subscribe(self, hand: str) -> PadQueue:
        self.queues.append(PadQueue(hand))
        return self.queues[-1]

    def send(self, t: float, hands: dict[str, list[float]]) -> None:
        held = "any" in hands
        axes = [float(held and name == "l2") for name in PAGE_AXES]
        message = {"connected": True, "t": t, "t_alive": t, "axes": axes, "buttons": held << 6, "hands": hands}
        for queue in self.queues:
            queue.put(pad_reading(message, queue.hand, self.deadman))


def play(t: float) -> dict[str, list[float]]:
    """Return what the hands do at ``t``, s: both go from 1 s on, the left lets go at 2 s, the right at 3 s."""
    way = SPEED * max(0.0, t - 1.0)
    ways = {"any": ([5.0 + way, 0.0, 0.0], 2.0), "right": ([0.0, 0.0, -7.0 + way], 3.0)}
    return {side: [*at, 0.0, 0.0, 0.0, 1.0, 0.0] for side, (at, end) in ways.items() if 0.5 <= t < end}


def test_each_hand_drives_its_arm_and_releasing_one_leaves_the_other(tmp_path: Path) -> None:
    page, seen, held = Page(), {}, {}
    with hal.open(RIG, sim=True, clock="lock_step", pad="none") as rig, Recorder(rig, tmp_path, fps=50) as recorder:
        specs = [
            PadSpec(name, "web", None, drives=name, options={} if side == "any" else {"hand": side})
            for name, side in SIDES.items()
        ]
        pads = [Gamepad(WebPad(spec, page)) for spec in specs]
        for pad in pads:
            pad.open(rig.clock.now())
        start = rig.clock.now()

        def poll() -> None:
            now = rig.clock.now()
            page.send(now, play(now - start))
            for pad in pads:
                pad.poll_once(now)
            held[now - start] = [arm.deadman.held for arm in session.arms]
            seen[now - start] = np.array([arm.state().tcp.position for arm in rig.robots.values()])

        session = hal.TeleopSession(rig, list(rig.robots.values()), pads, on_tick=poll)
        recorder.start()
        assert session.run(lambda _: "over" if rig.clock.now() - start > 4.0 else "") == "over"
        recorder.save(wait=True)
    times, ways = np.array(list(seen)), np.array(list(seen.values())) - next(iter(seen.values()))
    holds = [next(both for t, both in held.items() if t >= least) for least in (0.4, 1.5, 2.5, 3.5)]
    assert holds == [[False, False], [True, True], [False, True], [False, False]]
    at = {t: ways[np.searchsorted(times, t)] for t in (1.0, 2.5, 3.9)}
    assert abs(at[1.0]).max() < 1e-4, "a squeeze moves nothing"
    assert abs(at[2.5][0] - [0.1, 0, 0]).max() < 0.015, "the left one braked when its hand let go"
    assert abs(at[2.5][1] - [0, 0, 0.15]).max() < 0.015, "and the right one went on"
    assert abs(at[3.9] - [[0.1, 0, 0], [0, 0, 0.2]]).max() < 0.015
    assert abs(at[3.9][0] - at[2.5][0]).max() < 1e-4
    (episode,) = Dataset(tmp_path).episodes
    with hal.open(RIG, sim=True, clock="lock_step", pad="none") as rig:
        for arm in rig.robots.values():
            player = TrajectoryPlayer(rig, arm, RecordedTrajectory.from_episode(episode, arm))
            player.approach()
            player.play()
            assert abs(arm.state().tcp.position - player.trajectory.tcp[-1]).max() < 2e-3
