"""Arguments that are no arguments: each is one error of the tree that says what to pass instead."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import hal
from hal.errors import HalError

HUGE = 10**400
NAN = math.nan


@pytest.fixture(scope="module")
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock") as rig:
        rig.clock.sleep(0.5)
        yield rig


Call = Callable[[Any, Any, Any], object]
WRONG: dict[str, tuple[Call, str]] = {
    "control(deadman=pad)": (lambda rig, arm, pad: arm.control(deadman=pad), "pad.hold('l2')"),
    "control(deadman=True)": (lambda rig, arm, pad: arm.control(deadman=True), "pad.hold('l2')"),
    "control(rate_hz='fast')": (lambda rig, arm, pad: arm.control(rate_hz="fast"), "rate_hz must be a positive number"),
    "control(rate_hz=huge)": (lambda rig, arm, pad: arm.control(rate_hz=HUGE), "rate_hz must be a positive number"),
    "control(speed=[0.1])": (lambda rig, arm, pad: arm.control(speed=[0.1]), "speed must be a positive number"),
    "move_to(deadman=pad)": (lambda rig, arm, pad: arm.move_to(arm.home, deadman=pad), "pad.hold('l2')"),
    "move_to(timeout=nan)": (lambda rig, arm, pad: arm.move_to(arm.home, timeout=NAN), "timeout must be"),
    "move_to(timeout=-1)": (lambda rig, arm, pad: arm.move_to(arm.home, timeout=-1), "timeout must be"),
    "move_to(patience=nan)": (lambda rig, arm, pad: arm.move_to(arm.home, patience=NAN), "patience must be"),
    "move_to(speed=nan)": (lambda rig, arm, pad: arm.move_to(arm.home, speed=NAN), "speed must be"),
    "move_to(None)": (lambda rig, arm, pad: arm.move_to(None), "target"),
    "move_to('home')": (lambda rig, arm, pad: arm.move_to("home"), "target"),
    "move_to(huge)": (lambda rig, arm, pad: arm.move_to([HUGE] * 7), "target"),
    "teleop.step(pad)": (lambda rig, arm, pad: hal.Teleop(arm).step(pad, 0.02), "pad.state()"),
    "teleop.home_pressed(pad)": (lambda rig, arm, pad: hal.Teleop(arm).home_pressed(pad), "pad.state()"),
    "Teleop(speed='x')": (lambda rig, arm, pad: hal.Teleop(arm, speed="x"), "speed must be"),
    "Teleop(mapping=5)": (lambda rig, arm, pad: hal.Teleop(arm, mapping=5), "mapping"),
    "ik('x')": (lambda rig, arm, pad: arm.ik("x"), "hal.Pose"),
    "ik(position)": (lambda rig, arm, pad: arm.ik([0.4, 0, 0.4]), "hal.Pose"),
    "ik(seed of six)": (lambda rig, arm, pad: arm.ik(arm.state().tcp, q_seed=[0] * 6), "q_seed must have shape (7,)"),
    "ik(seed 'x')": (lambda rig, arm, pad: arm.ik(arm.state().tcp, q_seed="x"), "q_seed must be numbers"),
    "fk(six)": (lambda rig, arm, pad: arm.fk([0.0] * 6), "q must have shape (7,)"),
    "fk(None)": (lambda rig, arm, pad: arm.fk(None), "q must"),
    "fk(nan)": (lambda rig, arm, pad: arm.fk([NAN] * 7), "finite"),
    "fk(huge)": (lambda rig, arm, pad: arm.fk([HUGE] * 7), "q must be numbers"),
    "rate(inf)": (lambda rig, arm, pad: rig.clock.rate(math.inf), "a rate must be"),
    "rate(nan)": (lambda rig, arm, pad: rig.clock.rate(NAN), "a rate must be"),
    "rate('x')": (lambda rig, arm, pad: rig.clock.rate("x"), "a rate must be"),
    "rate(0)": (lambda rig, arm, pad: rig.clock.rate(0), "a rate must be"),
    "sleep(nan)": (lambda rig, arm, pad: rig.clock.sleep(NAN), "seconds must be"),
    "sleep(inf)": (lambda rig, arm, pad: rig.clock.sleep(math.inf), "seconds must be"),
    "sleep_until(inf)": (lambda rig, arm, pad: rig.clock.sleep_until(math.inf), "t must be"),
    "every(nan)": (lambda rig, arm, pad: rig.clock.every(NAN, print), "must be"),
    "observe(after=far)": (lambda rig, arm, pad: rig.observe(after=rig.clock.now() + 100), "in the future"),
    "observe(after=nan)": (lambda rig, arm, pad: rig.observe(after=NAN), "after must be"),
    "observe(timeout=nan)": (lambda rig, arm, pad: rig.observe(timeout=NAN), "timeout must be"),
    "observe(history=1.5)": (lambda rig, arm, pad: rig.observe(history=1.5), "history must be"),
    "observe(history=0)": (lambda rig, arm, pad: rig.observe(history=0), "history must be"),
    "observe(cameras='scene')": (lambda rig, arm, pad: rig.observe(cameras="scene"), "cameras=['scene']"),
    "state(max_age=nan)": (lambda rig, arm, pad: arm.state(max_age=NAN), "max_age must be"),
    "gripper.start(nan)": (lambda rig, arm, pad: arm.gripper.start(NAN), "width must be"),
    "gripper.start('x')": (lambda rig, arm, pad: arm.gripper.start("x"), "width must be"),
    "gripper.start(array)": (lambda rig, arm, pad: arm.gripper.start(np.array([0.05])), "width must be"),
    "gripper.start(force=huge)": (lambda rig, arm, pad: arm.gripper.start(0.05, force=HUGE), "force must be"),
    "gripper.grip(1.5)": (lambda rig, arm, pad: arm.gripper.grip(1.5), "grip"),
    "gripper.grip('x')": (lambda rig, arm, pad: arm.gripper.grip("x"), "grip"),
    "gripper.state(nan)": (lambda rig, arm, pad: arm.gripper.state(NAN), "max_age must be"),
    "JointTarget(huge)": (lambda rig, arm, pad: hal.JointTarget([HUGE] * 7), "q must be numbers"),
    "JointChunk(huge)": (lambda rig, arm, pad: hal.JointChunk([0.0], [[HUGE] * 7]), "q must be numbers"),
    "Twist(huge)": (lambda rig, arm, pad: hal.Twist([HUGE, 0, 0]), "linear must be numbers"),
    "Pose(huge)": (lambda rig, arm, pad: hal.Pose([HUGE, 0, 0], [0, 0, 0, 1]), "position must be numbers"),
    "Pose('x')": (lambda rig, arm, pad: hal.Pose("x", [0, 0, 0, 1]), "position must be numbers"),
    "Pose(nan)": (lambda rig, arm, pad: hal.Pose([NAN, 0, 0], [0, 0, 0, 1]), "finite"),
    "Pose(two)": (lambda rig, arm, pad: hal.Pose([0, 0], [0, 0, 0, 1]), "position must have shape (3,)"),
    "Pose(zero)": (lambda rig, arm, pad: hal.Pose([0, 0, 0], [0, 0, 0, 0]), "quaternion"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_argument_says_what_to_pass_instead(name: str, rig: hal.Rig) -> None:
    call, words = WRONG[name]
    arm, pad = rig.robots["panda"], rig.gamepads["pad"]
    before = rig.clock.now()
    with pytest.raises(HalError) as caught:
        call(rig, arm, pad)
    assert words in str(caught.value)
    assert len(str(caught.value)) < 300
    assert rig.clock.now() == before, "nothing happened on the way to the error"


def test_what_is_right_still_passes(rig: hal.Rig) -> None:
    arm, pad = rig.robots["panda"], rig.gamepads["pad"]
    assert arm.fk(arm.home.tolist()) == arm.fk(arm.home)
    assert arm.ik(arm.fk(arm.home), q_seed=list(arm.home)).shape == (7,)
    assert arm.state(max_age=math.inf).stamp.t > 0.0
    assert rig.observe(after=rig.clock.now(), timeout=np.float32(1.0), history=np.int64(2)).history
    assert hal.Teleop(arm).step(pad.state(), 0.02)
    assert next(rig.clock.rate(np.float64(50.0))).missed == 0
    assert arm.move_to(arm.home, timeout=30, patience=math.inf).stamp.t > 0.0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the name of the argument changes
@pytest.mark.parametrize("grip", [np.array([0.5]), "closed", NAN, HUGE, True, 1.5, -0.1])
def test_a_wrong_grip_is_not_sent(grip: Any, rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with arm.control(unattended=True) as control:
        width = arm.gripper.state().width_target
        with pytest.raises(HalError, match="grip"):
            control.send(None, gripper=grip)
        rig.clock.sleep(0.05)
        assert arm.gripper.state().width_target == width
