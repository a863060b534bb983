"""``hal.skills.grasp`` and what its failures are called: in lock-step, with the mock's arm and gripper."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from errors_kit import raises_code

import hal
from hal.skills import SkillProgress, gentle_grasp, grasp

DOWN = [1.0, 0.0, 0.0, 0.0]
POSE = hal.Pose([0.45, 0.1, 0.1], DOWN)
WIDTH = 0.03
PHASES = ["open", "approach", "descend", "close", "lift", "hold"]


@pytest.fixture(scope="module")
def opened() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as opened:
        yield opened


@pytest.fixture
def rig(opened: hal.Rig) -> hal.Rig:
    arm = opened.robots["panda"]
    opened.driver("panda").inject(following_error=0.0)
    opened.driver("panda.gripper").clear()
    opened.driver("panda.gripper").inject(object_width=WIDTH)
    opened.driver("pad").release("l2")
    assert arm.gripper is not None
    arm.gripper.move(0.045)
    arm.move_to(arm.home, speed=1.0)
    return opened


def at(phase: str, call: Callable[[], Any]) -> Callable[[SkillProgress], None]:
    """Return a ``progress`` function that makes a call when a phase begins."""

    def progress(now: SkillProgress) -> None:
        if now.phase == phase:
            call()

    return progress


def test_a_grasp_runs_through_its_phases_and_holds(rig: hal.Rig) -> None:
    arm, seen = rig.robots["panda"], list[SkillProgress]()
    result = grasp(arm, POSE, width=WIDTH, lift=0.08, hold=0.5, speed=1.0, progress=seen.append)
    assert result
    assert (result.reason, result.phase, result.skill) == ("", "hold", "grasp")
    assert [phase.name for phase in result.phases] == [now.phase for now in seen] == PHASES
    assert [now.number for now in seen] == list(range(1, 7))
    assert {now.count for now in seen} == {6}
    assert result.width == pytest.approx(WIDTH, abs=1e-4)
    assert result.tcp.position == pytest.approx(POSE.position + [0.0, 0.0, 0.08], abs=2e-3)
    starts = [phase.start for phase in result.phases]
    assert starts == sorted(starts)
    assert result.duration == pytest.approx(0.5 + starts[-1] - starts[0])


@pytest.mark.parametrize(
    ("reason", "phase", "when", "faults", "options"),
    [
        ("missed", "close", "close", {"object_width": None}, {}),
        ("wrong_width", "close", "close", {"object_width": 0.06}, {}),
        ("wrong_width", "close", "close", {"object_width": 0.01}, {}),
        ("fingers_blocked", "open", "open", {"stuck": True}, {}),
        ("dropped", "lift", "lift", {"object_width": None}, {}),
        ("dropped", "hold", "hold", {"object_width": None}, {"hold": 1.0}),
        ("too_wide", "plan", "open", {}, {"width": 0.09}),
    ],
)
def test_what_goes_wrong_at_the_fingers(
    rig: hal.Rig, reason: str, phase: str, when: str, faults: dict[str, Any], options: dict[str, Any]
) -> None:
    arm, gripper = rig.robots["panda"], rig.driver("panda.gripper")
    if reason == "fingers_blocked":
        assert arm.gripper is not None
        arm.gripper.grip(0.3)
    result = grasp(
        arm,
        POSE,
        **{"width": WIDTH, "speed": 1.0, **options},
        progress=at(when, lambda: gripper.inject(**faults)),
    )
    assert not result
    assert (result.reason, result.phase) == (reason, phase)
    if reason in ("missed", "wrong_width"):
        assert result.width == pytest.approx(0.08, abs=1e-3), "the fingers are open again"
        assert result.tcp.position[2] > 0.19, "and the hand is out of the way"


def test_what_the_fingers_hold_already_is_not_dropped(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    assert arm.gripper is not None
    assert arm.gripper.grasp(WIDTH)
    seen = list[SkillProgress]()
    result = grasp(arm, POSE, width=WIDTH, speed=1.0, progress=seen.append)
    assert (result.reason, result.phase, seen) == ("holding", "plan", [])
    assert arm.gripper.state().grasped
    arm.gripper.move(0.045)
    assert grasp(arm, POSE, width=WIDTH, speed=1.0)


@pytest.mark.parametrize(
    ("reason", "pose"),
    [
        ("unreachable", hal.Pose([0.9, 0.3, 0.3], DOWN)),
        ("outside_limits", hal.Pose([0.45, 0.0, -0.05], DOWN)),
    ],
)
def test_a_plan_that_the_arm_cannot_follow_moves_nothing(rig: hal.Rig, reason: str, pose: hal.Pose) -> None:
    arm = rig.robots["panda"]
    before, t = arm.state().q_set, rig.clock.now()
    result = grasp(arm, pose, lift=0.0)
    assert (result.reason, result.phase, result.phases) == (reason, "plan", ())
    assert (arm.state().q_set == before).all()
    assert rig.clock.now() == t


def test_an_arm_that_is_held_back_is_blocked(rig: hal.Rig) -> None:
    result = grasp(
        rig.robots["panda"],
        POSE,
        speed=1.0,
        progress=at("descend", lambda: rig.driver("panda").inject(following_error=0.03)),
    )
    assert (result.reason, result.phase) == ("blocked", "descend")


def test_the_nearer_of_two_equal_grasps_is_taken(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    turned = hal.Pose.from_rpy(POSE.position, (3.14159, 0.0, 3.0))
    result = grasp(arm, turned, speed=1.0)
    assert result
    assert result.tcp.distance(turned)[1] == pytest.approx(3.14, abs=0.02), "the hand is turned by half a turn"
    arm.move_to(arm.home, speed=1.0)
    assert arm.gripper is not None
    arm.gripper.open()
    assert grasp(arm, turned, speed=1.0, flip=False).tcp.distance(turned)[1] == pytest.approx(0.0, abs=0.02)


def test_stops_and_faults_are_exceptions(rig: hal.Rig) -> None:
    arm, gripper = rig.robots["panda"], rig.driver("panda.gripper")
    with pytest.raises(hal.RobotFault):
        grasp(arm, POSE, speed=1.0, progress=at("close", lambda: gripper.inject(fail="worn out")))
    gripper.inject(fail=None)
    with raises_code(hal.MotionStopped, "rig_stop"):
        grasp(arm, POSE, speed=1.0, progress=at("approach", rig.stop))
    rig.rearm()
    with raises_code(hal.CommandError, "no_orientation"):
        grasp(arm, hal.Pose([0.45, 0.0, 0.1]))
    with raises_code(hal.CommandError, "not_a_deadman"):
        grasp(arm, POSE, deadman=rig.gamepads["pad"])  # type: ignore[arg-type]


def test_a_released_dead_man_pauses_the_arm_and_the_fingers(rig: hal.Rig) -> None:
    pad, deadman = rig.driver("pad"), rig.gamepads["pad"].hold("l2")
    log = rig.driver("panda.gripper").log
    pauses = dict.fromkeys(PHASES, 0)
    rig.robots["panda"].gripper.grip(0.3)  # so that there is something to open
    pad.press("l2")

    def pause(now: SkillProgress) -> None:
        """Release the dead-man soon after the beginning of a phase, and press it again a second later."""
        t = rig.clock.now()

        def tick() -> None:
            elapsed = rig.clock.now() - t
            if 0.08 <= elapsed < 0.13:  # once, at 0.1 s: calls are 0.05 s apart, and a step of 4 ms early or late
                pad.release("l2")
                pauses[now.phase] = len(log)
            elif elapsed >= 1.1:
                pad.press("l2")
                ends.pop()()

        ends = [rig.clock.call_every(0.05, tick)]

    before = len(log)
    result = grasp(rig.robots["panda"], POSE, width=WIDTH, speed=1.0, hold=1.2, deadman=deadman, progress=pause)
    assert result
    assert all(pauses.values())
    assert len(log) - before >= 3, "opened, closed, and closed again after the pause"
    assert result.duration > 5.0

    rig.robots["panda"].gripper.open()
    with raises_code(hal.MotionStopped, "deadman_released"):
        grasp(
            rig.robots["panda"],
            POSE,
            speed=1.0,
            deadman=deadman,
            patience=0.5,
            progress=at("close", lambda: (pad.release("l2"), rig.clock.sleep(0.1))),
        )


@pytest.mark.parametrize("phase", PHASES)
def test_a_skill_ends_after_its_timeout_in_every_phase(rig: hal.Rig, phase: str) -> None:
    """A dead-man that is released for ever pauses the skill until then, however long it may be released."""
    pad, arm = rig.driver("pad"), rig.robots["panda"]
    deadman = rig.gamepads["pad"].hold("l2")  # before it is pressed: a skill begins with a new press
    arm.gripper.grip(0.3)
    pad.press("l2")
    rig.clock.sleep(0.1)
    begun = list[float]()

    def release() -> None:
        begun.append(rig.clock.now())
        pad.release("l2")

    result = grasp(
        arm,
        POSE,
        speed=1.0,
        hold=30.0,
        deadman=deadman,
        patience=math.inf,
        timeout=15.0,
        progress=at(phase, release),
    )
    assert (result.reason, result.phase) == ("timed_out", phase)
    assert result.duration == pytest.approx(15.0, abs=0.2)
    assert rig.clock.now() - begun[0] > 1.0, "it paused"
    t = arm.state().q
    rig.clock.sleep(0.5)
    assert arm.state().q == pytest.approx(t, abs=1e-6), "the arm is at rest"


@pytest.mark.parametrize(
    ("options", "phase"),
    [({"speed": 0.02, "timeout": 2.0}, "approach"), ({"speed": 1.0, "timeout": 8.0, "touch_speed": 0.001}, "touch")],
)
def test_a_timeout_stops_the_arm_and_the_fingers(rig: hal.Rig, options: dict[str, Any], phase: str) -> None:
    arm = rig.robots["panda"]
    assert arm.gripper is not None
    result = gentle_grasp(arm, POSE, WIDTH, **options)
    assert (result.reason, result.phase) == ("timed_out", phase)
    rest = arm.state().q, arm.gripper.state().width
    rig.clock.sleep(1.0)
    assert arm.state().q == pytest.approx(rest[0], abs=1e-3)
    assert arm.gripper.state().width == pytest.approx(rest[1], abs=1e-4)


@pytest.mark.parametrize("wrong", [{"timeout": math.nan}, {"timeout": 0.0}, {"patience": math.nan}])
def test_bounds_that_are_no_bounds_are_refused(rig: hal.Rig, wrong: dict[str, Any]) -> None:
    with pytest.raises(hal.CommandError):
        grasp(rig.robots["panda"], POSE, **wrong)


@pytest.mark.parametrize(
    ("reason", "phase", "between"),
    [
        ("", "hold", WIDTH),
        ("missed", "touch", None),
        ("wrong_width", "centre", 0.005),
        ("not_centred", "centre", 0.05),
        ("dropped", "hold", WIDTH),
    ],
)
def test_a_gentle_grasp_tells_what_it_touched(rig: hal.Rig, reason: str, phase: str, between: float | None) -> None:
    """The mock's object is always in the middle, so that a wider one seems to move with the arm."""
    gripper = rig.driver("panda.gripper")
    gripper.inject(object_width=between)
    lose = at("hold" if reason == "dropped" else "never", lambda: gripper.inject(object_width=None))
    result = gentle_grasp(rig.robots["panda"], POSE, WIDTH, hold=1.0, speed=1.0, progress=lose)
    assert (result.reason, result.phase, bool(result)) == (reason, phase, not reason)
    closing = [(speed, force) for width, speed, force in gripper.log if width == 0.0]
    assert (0.02, 3.0) in closing, "the touch is slow, and hardly presses"
    if reason in ("missed", "wrong_width", "not_centred"):
        assert result.width == pytest.approx(0.08, abs=1e-3)


def test_a_misspelt_option_is_an_error(rig: hal.Rig) -> None:
    with pytest.raises(TypeError, match="spead"):
        grasp(rig.robots["panda"], POSE, spead=0.1)  # type: ignore[call-arg]
