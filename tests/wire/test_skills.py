"""The skills' own code on the emulated FR3 and Franka Hand: phases, and failures of fingers; 20 times with HAL_SOAK=1.

tests/unit/skills has every failure, in lock-step.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from waiting import wait_until

import hal
from hal.skills import SkillProgress, gentle_grasp, grasp, object_from_points, push, push_to

from .franka_kit import Emulator
from .rig_kit import arm_of, rig_of

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

DOWN = [1.0, 0.0, 0.0, 0.0]
POSE = hal.Pose([0.40, 0.03, 0.35], DOWN)
"""Near home, so that the arm is there soon."""
WIDTH = 0.03
OPTIONS: dict[str, Any] = {"approach": 0.03, "lift": 0.03, "speed": 0.3, "unattended": True}
FENCE = "{name: fence, position: [-0.2, 0.42, 0.95], size: [0.2, 0.16, 0.2]}"
"""A box in the world that the arm must not touch, far from all other ways."""
GRASP = ["open", "approach", "descend", "close", "lift", "hold"]
PUSH = ["close", "approach", "descend", "push", "back_off", "lift"]
GENTLE = ["open", "approach", "descend", "touch", "centre", "close", "lift", "hold"]


@pytest.fixture(scope="module")
def robot() -> Iterator[Emulator]:
    # It waits for a set-point that is late: a busy machine must not look like a fault of the arm.
    with Emulator("--lockstep", hand=True) as emulator:
        yield emulator


@pytest.fixture(scope="module")
def rig(robot: Emulator) -> Iterator[hal.Rig]:
    more = "robots.arm.gripper.enabled=true", f"collisions.boxes=[{FENCE}]"
    with rig_of(robot.host, "fr3", *more) as rig:
        yield rig


@pytest.fixture(autouse=True, params=range(20 if os.environ.get("HAL_SOAK") == "1" else 1))
def _again(robot: Emulator, rig: hal.Rig) -> None:
    """Repeat every test, with an empty hand; a fault of one of them is recovered."""
    arm = arm_of(rig)
    if arm.state().fault is not None:
        arm.recover()
    robot.control.send("hand object none")
    gripper = arm.gripper
    assert gripper is not None
    wait_until(lambda: not gripper.state().grasped, "empty")


def at(phase: str, call: Callable[[], Any]) -> Callable[[SkillProgress], None]:
    """Return a ``progress`` function that makes a call when a phase begins."""

    def progress(now: SkillProgress) -> None:
        if now.phase == phase:
            call()

    return progress


CASES: list[tuple[str, list[str], str, str, dict[str, Any]]] = [
    # reason, phases, when the hand is told, what it is told, options
    ("", GRASP, "open", "object 0.03", {}),
    ("", GRASP, "open", "object 0.03", {"width": WIDTH, "hold": 0.5}),
    ("missed", GRASP[:4], "open", "object none", {"width": WIDTH}),
    ("wrong_width", GRASP[:4], "open", "object 0.06", {"width": WIDTH}),
    ("dropped", GRASP[:5], "lift", "object none", {"width": WIDTH}),
    ("dropped", GRASP, "hold", "object none", {"width": WIDTH, "hold": 1.5}),
    ("collision", GRASP[:2], "", "", {"pose": hal.Pose([0.35, 0.42, 0.35], DOWN)}),
]


@pytest.mark.parametrize(("reason", "phases", "when", "words", "options"), CASES)
def test_a_grasp(
    robot: Emulator, rig: hal.Rig, reason: str, phases: list[str], when: str, words: str, options: dict[str, Any]
) -> None:
    arm, options = arm_of(rig), dict(options)
    if reason == "dropped":
        robot.control.send(f"hand object {WIDTH}")
    pose = options.pop("pose", POSE)
    tell = at(when, lambda: robot.control.send(f"hand {words}"))
    result = grasp(arm, pose, **OPTIONS | options, progress=tell)
    assert (result.reason, [phase.name for phase in result.phases]) == (reason, phases), result.message
    if reason in ("missed", "wrong_width"):
        assert result.width == pytest.approx(0.08, abs=2e-3), "the fingers are open again"


@pytest.mark.parametrize(
    ("reason", "phases", "words"),
    [
        ("", GENTLE, "object 0.03"),
        ("not_centred", GENTLE[:5], "object 0.05"),
    ],
)
def test_a_gentle_grasp(robot: Emulator, rig: hal.Rig, reason: str, phases: list[str], words: str) -> None:
    tell = at("touch", lambda: robot.control.send(f"hand {words}"))
    result = gentle_grasp(arm_of(rig), POSE, WIDTH, touch_speed=0.05, **OPTIONS, progress=tell)
    assert (result.reason, [phase.name for phase in result.phases]) == (reason, phases), result.message


@pytest.mark.parametrize(
    ("reason", "phases", "between"), [("", PUSH, "none"), ("fingers_blocked", PUSH[:1], f"{WIDTH}")]
)
def test_a_push(robot: Emulator, rig: hal.Rig, reason: str, phases: list[str], between: str) -> None:
    arm = arm_of(rig)
    assert arm.gripper is not None
    arm.gripper.open()
    robot.control.send(f"hand object {between}")
    end = hal.Pose(POSE.position + [0.04, 0.0, 0.0], DOWN)
    result = push(arm, [POSE, end], approach=0.03, speed=0.3, unattended=True)
    assert (result.reason, [phase.name for phase in result.phases]) == (reason, phases), result.message


@pytest.mark.parametrize(
    ("reason", "seen", "phases"),
    [("not_seen", False, ["locate"]), ("off_goal", True, ["locate", "push", "locate"])],
)
def test_a_push_to_a_goal(rig: hal.Rig, reason: str, seen: bool, phases: list[str]) -> None:
    """The object that is seen does not move: there is none."""
    arm = arm_of(rig)
    corners = POSE.position + 0.02 * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    found = object_from_points(corners) if seen else None
    goal = POSE.position[:2] + [0.04, 0.0]
    result = push_to(arm, lambda: found, goal, tries=1, approach=0.03, speed=0.3, unattended=True)
    assert (result.reason, [phase.name for phase in result.phases]) == (reason, phases), result.message


def test_faults_and_stops_are_exceptions(robot: Emulator, rig: hal.Rig) -> None:
    arm = arm_of(rig)
    robot.control.send("hand object 0.03")
    with pytest.raises(hal.RobotFault):
        grasp(arm, POSE, **OPTIONS, progress=at("close", lambda: robot.control.send("hand fail 1")))
    with pytest.raises(hal.MotionStopped):
        grasp(arm, POSE, **OPTIONS, progress=at("approach", rig.stop))
    rig.rearm()
    with pytest.raises(hal.RobotFault):
        grasp(arm, POSE, **OPTIONS, progress=at("lift", lambda: robot.control.send("reflex joint_reflex")))
    arm.recover()
