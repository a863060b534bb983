"""Jogging one joint from the console's page, played in lock-step from the page's own messages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal.drivers.web.messages import Outbox
from hal.drivers.web.pad import PadQueue, WebPad, pad_reading
from hal.drivers.web.session import WebSession, make_app_queue
from hal.gamepad import Gamepad
from hal.learning.replay import RecordedTrajectory, TrajectoryPlayer
from hal.recording import Dataset, Recorder
from hal.specs import PadSpec
from hal.types import BUTTONS, PAGE_AXES

RIG = {"robots": {"arm": {"model": "panda"}}}
SPEED = 0.8
"""rad/s of a jog: the default mapping's speed of turning."""
PLAY = [
    (0.5, 1.5, "joint_4", 1.0),
    (1.5, 2.0, "dpad_y", 1.0),  # Cartesian, without letting go in between
    (2.0, 3.0, "joint_1", -0.5),
    (3.0, 7.0, "joint_7", 1.0),  # up to its limit
    (7.0, 7.5, "joint_7", -1.0),
    (7.5, 9.0, "joint_4", -1.0),
]
"""From when, to when, which axis is pushed how far; the dead-man is held from 0.2 to 8 s."""


class Page:
    """A page in control, connected to a pad by the rules of the console's process."""

    driver = "page 1"
    stop_count = 0

    def __init__(self) -> None:
        self.now = 0.0
        self.queue = PadQueue()
        self.to_app: Outbox[dict[str, Any]] = make_app_queue()
        rig = {"drivable": True, "driven_by": None, "demo": False, "cameras": [], "robots": [{"name": "arm"}]}
        self.session = WebSession(rig, self.to_app, self.flush, lambda: self.now)
        self.page = self.session.open_page(lambda: None)

    def subscribe(self, hand: str) -> PadQueue:
        return self.queue

    def flush(self) -> None:
        while (message := self.to_app.pop()) is not None:
            if "pad" in message:
                self.queue.put(pad_reading(message["pad"]))

    def send(self, now: float, axes: dict[str, float]) -> None:
        """Send what is pushed and held, as pad.js does."""
        seen, self.now = self.now, now
        buttons = 1 << BUTTONS.index("l2") if axes.get("l2") else 0
        pad = {"type": "pad", "seen": seen, "since": 1000.0 * (now - seen), "buttons": buttons, "hands": {}}
        self.session.receive(self.page, json.dumps({**pad, "axes": [axes.get(name, 0.0) for name in PAGE_AXES]}))


def test_a_joint_is_jogged_alone_recorded_and_replayed(tmp_path: Path) -> None:
    page = Page()
    times, points, speeds = [], [], []
    with hal.open(RIG, sim=True, clock="lock_step", pad="none") as rig, Recorder(rig, tmp_path, fps=50) as recorder:
        arm = rig.robots["arm"]
        pad = Gamepad(WebPad(PadSpec("pad", "web", None), page))
        pad.open(rig.clock.now())
        start = page.now = rig.clock.now()
        page.session.receive(page.page, '{"type": "lease", "take": true}')

        def poll() -> None:
            t = rig.clock.now() - start
            held = {"l2": 1.0} if 0.2 <= t < 8.0 else {}
            page.send(rig.clock.now(), held | {axis: share for first, last, axis, share in PLAY if first <= t < last})
            pad.poll_once(rig.clock.now())
            state = arm.state()
            times.append(t)
            points.append(state.q_set)
            speeds.append(state.dq_set)

        session = hal.TeleopSession(rig, [arm], [pad], on_tick=poll)
        labels = session.teleop.labels(actions=("jog",))["controls"]
        assert labels["joint_7"] == [f"jog {arm.joints[6]} -", f"jog {arm.joints[6]} +"]
        assert "joint_8" not in labels
        recorder.start()
        assert session.run(lambda _: "over" if rig.clock.now() - start > 9.0 else "") == "over"
        recorder.save(wait=True)
        upper = arm.limits.upper[6]
    q, dq = np.array(points), np.array(speeds)

    def at(t: float) -> int:
        return int(np.searchsorted(times, t))

    jogged = q[at(1.45)] - q[at(0.45)]
    assert 0.4 < jogged[3] < SPEED, "the servo keeps the tcp below 0.25 m/s"
    assert abs(np.delete(jogged, 3)).max() < 1e-6, "no other joint moves"
    assert abs(dq[at(0.45) : at(1.45)]).max() < SPEED + 1e-6
    forwards = q[at(1.95)] - q[at(1.55)]
    assert abs(forwards[1]) > 0.01, "the d-pad drives the tcp again"
    assert abs(np.diff(q, axis=0)).max() < 1.1 * SPEED * 0.02, "and no change of the control is a jump"
    slow = q[at(2.95)] - q[at(2.5)]
    assert -0.45 * SPEED * 0.5 * 1.1 < slow[0] < -0.45 * SPEED * 0.5 * 0.9, "a share of the way is a share of the speed"
    assert upper - 0.1 < q[at(6.9)][6] <= upper, "it stops at the limit"
    assert q[at(7.45)][6] < q[at(6.9)][6] - 0.2, "and comes back from there"
    assert dq[at(7.9)][3] < -0.3
    assert abs(dq[at(8.6)]).max() < 1e-6, "the dead-man is released, the button is not"
    assert abs(q[at(8.6)] - q[-1]).max() < 1e-6
    (episode,) = Dataset(tmp_path).episodes
    with hal.open(RIG, sim=True, clock="lock_step", pad="none") as rig:
        arm = rig.robots["arm"]
        player = TrajectoryPlayer(rig, arm, RecordedTrajectory.from_episode(episode, arm))
        player.approach()
        player.play()
        assert abs(arm.state().tcp.position - player.trajectory.tcp[-1]).max() < 2e-3
