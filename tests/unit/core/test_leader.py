"""A leader drives an arm: mapping, engaging, losing it, takeover; with mock devices, in lock-step."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

import hal
from hal.config import load
from hal.errors import NotSupported
from hal.leader import Angles, LeaderDriver
from hal.leading import make_teleop
from hal.learning.policy import PolicyRunner
from hal.learning.takeover import Takeover
from hal.rig import check_opening
from hal.types import RobotStatus, Trip

POSE = np.array([0.5, -0.4, 0.3, 0.9, -1.0])
WAY = np.array([0.2, 0.1, -0.1, -0.2, 0.2])
PERIOD = 1.6
"""Time of a takeover and the policy after it, s."""
TAKEOVERS = 1_000 if os.environ.get("HAL_SOAK") == "1" else 6


def ramp(t: float) -> float:
    """Return 0 before t is 0, and 1 from 1 on."""
    return max(0.0, min(1.0, t))


def config(*models: str, pad: bool = True, **leader: Any) -> dict[str, Any]:
    arms = {f"arm{k}": {"model": model, "base": {"position": [0, k, 0]}} for k, model in enumerate(models)}
    leaders = {f"lead{k}": {"model": "so101_leader", "drives": name, **leader} for k, name in enumerate(arms)}
    return {"robots": arms, "leaders": leaders, "gamepads": {"pad": {"sim": True}} if pad else {}}


@contextmanager
def bench(*models: str, **leader: Any) -> Iterator[hal.Rig]:
    with hal.open(config(*models, **leader), driver="mock") as rig:
        yield rig


def drive(rig: hal.Rig, seconds: float, turn: Callable[[float], object] = lambda t: None) -> np.ndarray[Any, Any]:
    """Drive every arm for some time; return the first one's set-point 50 times in a second (k, n)."""
    arms, seen, end = list(rig.robots.values()), [], rig.clock.now() + seconds
    session = hal.TeleopSession(rig, arms)

    def until(_: hal.PadState) -> str:
        turn(seconds - (end - rig.clock.now()))
        if seconds - (end - rig.clock.now()) > 0.02 * len(seen) - 1e-6:
            seen.append(arms[0].state().q_set)
        return "over" if rig.clock.now() > end else ""

    session.run(until)
    return np.array(seen)


def test_engaging_never_moves_the_arm_which_then_follows_what_the_leader_moves() -> None:
    with bench("so101") as rig:
        leader, pad, home = rig.driver("lead0"), rig.driver("pad"), rig.robots["arm0"].state().q_set
        rig.gamepads["lead0"].hold("l2")
        rig.clock.sleep(0.1)
        pad.press("l2")
        rig.clock.sleep(0.1)
        q = drive(rig, 1.0, lambda t: leader.move(POSE * ramp(t)))
        assert np.ptp(q, axis=0).max() == 0.0, "held since before the session: nothing moves"

        def lead(t: float) -> None:
            if t < 0.1:
                pad.release("l2")
            elif t < 1.5:
                pad.press("l2")
                leader.move(POSE + WAY * ramp(t - 0.3))
            elif t < 2.0:
                pad.release("l2")
                leader.move(-POSE)
            else:
                pad.press("l2")

        q = drive(rig, 3.0, lead)
        assert q[int(1.45 * 50)] - home == pytest.approx(WAY, abs=2e-3)
        assert np.ptp(q[int(2.0 * 50) :], axis=0).max() == 0.0, "engaged again elsewhere, and no step"


def test_an_arm_that_approaches_comes_to_the_leader_at_its_own_speed() -> None:
    with bench("so101", engage="approach") as rig:
        leader, pad, arm = rig.driver("lead0"), rig.driver("pad"), rig.robots["arm0"]
        leader.move(POSE)
        drive(rig, 0.3)
        q = drive(rig, 8.0, lambda t: pad.press("l2") if t > 0.1 else None)
        assert q[-1] == pytest.approx(POSE, abs=1e-3)
        fastest = np.abs(q[25:] - q[:-25]).max(axis=0) / 0.5 / arm.limits.velocity
        assert fastest.max() < 1.05 * arm.spec.move_speed


def test_an_arm_of_another_kind_is_led_by_the_pose_of_the_leaders_tcp() -> None:
    with bench("panda", pose_scale=1.5) as rig:
        leader, pad, arm = rig.driver("lead0"), rig.driver("pad"), rig.robots["arm0"]
        teleop = make_teleop(arm, rig.gamepads["lead0"], "leader")
        start, end = POSE, POSE + [0.1, 0.1, -0.05, 0.1, 0.1]
        leader.move(start)
        drive(rig, 0.3)
        tcp = arm.state().tcp_set
        drive(rig, 0.5, lambda t: pad.press("l2") if t > 0.1 else None)
        assert arm.state().tcp_set.distance(tcp)[0] < 1e-9
        pad.release("l2")
        drive(rig, 0.1)
        drive(rig, 4.0, lambda t: (pad.press("l2"), leader.move(end if t > 0.3 else start)))
        from_, to = (teleop._kinematics.pose(q) for q in (start, end))
        assert arm.state().tcp_set.position - tcp.position == pytest.approx(
            1.5 * (to.position - from_.position), abs=2e-3
        )
        assert arm.state().tcp_set.distance(tcp)[1] == pytest.approx(from_.distance(to)[1], abs=0.01)


def test_a_hand_leads_an_arm_from_where_both_are_when_it_is_squeezed() -> None:
    with hal.open({"robots": {"arm": {"model": "panda"}}, "gamepads": {"pad": {"sim": True}}}, driver="mock") as rig:
        pad, arm, hand = rig.driver("pad"), rig.robots["arm"], np.array([1.0, 2.0, 0.5, 0.0, 0.0, 0.6, 0.8])
        poll = pad.poll

        def poll_hand(now: float, timeout: float) -> Any:
            found = poll(now, timeout)
            return found._replace(pose=tuple(hand) if "l2" in found.buttons else ())

        pad.poll = poll_hand
        tcp, way = arm.state().tcp_set, np.array([0.05, -0.04, 0.06])

        def lead(t: float) -> None:
            (pad.press if t > 0.1 else pad.release)("l2")
            hand[:3] = [1.0, 2.0, 0.5] + way * ramp(t - 0.4)
            hand[5:] = math.sin(0.6435 + 0.1 * ramp(t - 0.4)), math.cos(0.6435 + 0.1 * ramp(t - 0.4))

        drive(rig, 2.0, lead)
        assert arm.state().tcp_set.position - tcp.position == pytest.approx(way, abs=2e-3)
        assert arm.state().tcp_set.distance(tcp)[1] == pytest.approx(0.2, abs=0.01)
        hand[:3], tcp = 0.0, arm.state().tcp_set
        drive(rig, 1.0, lambda t: (pad.press if t > 0.1 else pad.release)("l2"))
        assert rig.gamepads["pad"].hold("l2").held
        assert arm.state().tcp_set.distance(tcp)[0] < 1e-9, "squeezed again elsewhere, and no step"


def test_one_pad_is_the_dead_man_of_two_leaders_that_drive_two_arms() -> None:
    with bench("so101", "so101") as rig:
        leaders, pad = [rig.driver("lead0"), rig.driver("lead1")], rig.driver("pad")

        def lead(t: float) -> None:
            if t > 0.1:
                pad.press("l2")
            for k, leader in enumerate(leaders):
                leader.move((1 - 1.5 * k) * WAY * ramp(t - 0.5))

        homes = [arm.state().q_set for arm in rig.robots.values()]
        drive(rig, 2.5, lead)
        moved = [arm.state().q_set - home for arm, home in zip(rig.robots.values(), homes, strict=True)]
        assert moved[0] == pytest.approx(WAY, abs=2e-3)
        assert moved[1] == pytest.approx(-WAY / 2, abs=2e-3)


@pytest.mark.parametrize(("fault", "trip"), [("freeze", Trip.DEADMAN_SILENT), ("disconnect", Trip.DEADMAN_LOST)])
def test_a_leader_that_is_lost_while_the_pad_is_held_stops_the_arm_within_150_ms(fault: str, trip: Trip) -> None:
    with bench("so101") as rig:
        leader, pad, arm = rig.driver("lead0"), rig.driver("pad"), rig.robots["arm0"]
        deadman = rig.gamepads["lead0"].hold("l2")
        rig.clock.sleep(0.1)
        pad.press("l2")
        rig.clock.sleep(0.1)
        with arm.control(deadman=deadman, rate_hz=50) as control, pytest.raises(hal.errors.MotionStopped):
            lost = math.inf
            for tick in rig.clock.rate(200):
                if tick.elapsed > 0.5 and lost == math.inf:
                    assert arm.state().status is RobotStatus.FOLLOWING
                    leader.inject(**{fault: True})
                    lost = tick.t
                if arm.state().trip is not Trip.NONE:
                    assert arm.state().trip is trip
                    assert tick.t - lost <= 0.15
                assert tick.t - lost < 0.3
                control.send(hal.JointVelocity(np.full(5, 0.05)))
                if tick.elapsed < 0.1:
                    pad.release("l2")
                else:
                    pad.press("l2")


class Turning(LeaderDriver):
    """A leader whose motors count turns."""

    angles: Sequence[float] = ()

    def read_angles(self, now: float) -> Angles:
        return Angles(now, self.angles, 0.0)


def test_joints_are_by_sign_scale_and_offset_in_the_usual_turn_and_without_leaps() -> None:
    values = {"signs": [1, -1, 1, 1, -1], "offsets": [0, 1.0, 0, 0, 3.0], "scales": [1, 1, 2, 1, 0.5]}
    spec = load(config("so101", **values), driver="mock").resolve().pads[-1]
    leader = Turning(spec)
    leader.open()
    leader.angles = [0.1 + 2 * math.pi, 0.5 - 4 * math.pi, 0.2, 3.1, 2.0]
    assert leader.poll(0.0, 0.0).joints == pytest.approx([0.1, 0.5, 0.4, 3.1, 0.5])
    leader.angles = [0.2 + 2 * math.pi, 0.4 - 4 * math.pi, 0.3, -3.1, 1.8]  # the fourth one passes its half turn
    assert leader.poll(0.1, 0.0).joints == pytest.approx([0.2, 0.6, 0.6, 2 * math.pi - 3.1, 0.6])


def test_a_leader_without_a_dead_man_drives_a_simulated_arm_while_it_moves() -> None:
    with bench("so101", pad=False) as rig:
        leader, home = rig.driver("lead0"), rig.robots["arm0"].state().q_set
        q = drive(rig, 3.0, lambda t: leader.move(WAY * ramp(t - 0.5)))
        assert q[-1] - home == pytest.approx(WAY, abs=0.03)
        assert not rig.gamepads["lead0"].hold().held, "it rests"


def test_it_does_not_drive_a_real_arm() -> None:
    rig = config("panda", pad=False, port="/dev/leader")
    rig["robots"]["arm0"]["real"] = {"host": "172.16.0.2"}
    with pytest.raises(NotSupported, match="leaders.lead0 has no dead-man"):
        check_opening(load(rig, sim=False).resolve(), None, "none", False)
    rig["leaders"]["lead0"]["lever"] = "deadman"
    check_opening(load(rig, sim=False).resolve(), None, "none", False)


def test_taking_over_from_a_policy_with_a_leader_never_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The set-point stands still from engaging until the leader moves, whether the policy was fast or slow.

    While the policy drives, the leader is to follow the arm; while it leads, it is let go.
    """
    with bench("so101", follow=0.3) as rig:
        leader, pad, arm = rig.driver("lead0"), rig.driver("pad"), rig.robots["arm0"]
        lead = rig.gamepads["lead0"]
        teleop, seen, start = make_teleop(arm, lead, "leader"), [], rig.clock.now()
        takeover, engaged, given = Takeover(teleop, lead), [False], []
        monkeypatch.setattr(leader, "follow", lambda q: given.append((rig.clock.now(), q, arm.state().q_set.tolist())))
        leader.move(POSE)
        rig.clock.sleep(0.1)
        pad.press("l2")

        def policy(observation: hal.Observation) -> hal.JointTarget:
            t = rig.clock.now() - start
            way = 0.03 * np.sin(3.0 * t) if int(t / PERIOD) % 2 else 5e-4 * (t % PERIOD)
            return hal.JointTarget(arm.home + way * np.array([1, 1, 0, 0, 0]))

        def turn(_: float) -> None:
            t = (rig.clock.now() - start) % PERIOD
            (pad.press if 0.3 < t < 1.0 else pad.release)("south")
            leader.move(POSE + [0.0, 0.0, 0.05 * ramp(5.0 * (t - 0.6)), 0.0, 0.0])
            state = arm.state()
            seen.append((t, engaged[-1], *state.q_set, *state.dq_set))
            engaged.append(False)

        def watch(state: hal.PadState, dt: float) -> Any:
            command, grip = follow(state, dt)
            engaged[-1] = isinstance(command, hal.JointTarget)
            return command, grip

        follow = teleop.command
        monkeypatch.setattr(teleop, "command", watch)

        runner = PolicyRunner(
            rig,
            policy,
            rate_hz=50,
            seconds=PERIOD * TAKEOVERS,
            cameras=(),
            deadman=lead.hold("l2"),
            takeover=takeover,
        )
        outcome = runner.run(on_turn=turn)
        assert outcome.ended == "time"
        assert TAKEOVERS <= len(outcome.interventions) <= TAKEOVERS + 1
        t, q, dq = (np.array(seen)[:, part] for part in (0, slice(2, 7), slice(7, 12)))
        waiting = (np.array(seen)[:, 1] > 0) & (t < 0.6)
        assert np.count_nonzero(waiting) > 3 * TAKEOVERS
        still = np.abs(np.diff(q, axis=0))[waiting[1:]].max()
        print(f"{len(outcome.interventions)} takeovers, {still} rad while the leader rests")
        assert still < 1e-12, "engaged, before the leader moves"
        steps = np.abs(np.diff(dq, axis=0)).max()
        assert steps <= 1.01 * max(arm.limits.acceleration) / 50, "no leap of the set-point at any time"
        calls = [((now - start) % PERIOD, q, q_set) for now, q, q_set in given]
        assert all(q == q_set for at, q, q_set in calls if at < 0.3 or at > 1.4)
        assert all(q is None for at, q, _ in calls if 0.35 < at < 1.0)
        assert len(calls) > 0.9 * len(seen)
        led = (t > 0.96) & (t < 1.0)
        assert q[led][:, 2].min() - arm.home[2] == pytest.approx(0.05, abs=0.01), (
            "the elbow, which the policy never moves"
        )
