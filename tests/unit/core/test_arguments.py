"""Wrong arguments: each is an error of the tree whose message says what to pass instead (wording on purpose)."""

from __future__ import annotations

import math
from collections.abc import Iterator

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


WRONG = {
    "arm.control(deadman=pad)": "pad.hold('l2')",
    "arm.control(deadman=True)": "pad.hold('l2')",
    "arm.control(rate_hz='fast')": "rate_hz must be a positive number",
    "arm.control(rate_hz=HUGE)": "rate_hz must be a positive number",
    "arm.control(speed=[0.1])": "speed must be a positive number",
    "arm.move_to(arm.home, deadman=pad)": "pad.hold('l2')",
    "arm.move_to(arm.home, timeout=NAN)": "timeout must be",
    "arm.move_to(arm.home, timeout=-1)": "timeout must be",
    "arm.move_to(arm.home, patience=NAN)": "patience must be",
    "arm.move_to(arm.home, speed=NAN)": "speed must be",
    "arm.move_to(None)": "target",
    "arm.move_to('home')": "target",
    "arm.move_to([HUGE] * 7)": "target",
    "hal.Teleop(arm).step(pad, 0.02)": "pad.state()",
    "hal.Teleop(arm).home_pressed(pad)": "pad.state()",
    "hal.Teleop(arm, speed='x')": "speed must be",
    "hal.Teleop(arm, speed=0.0)": "speed must be",
    "hal.Teleop(arm, speed=1.5)": "speed must be",
    "hal.Teleop(arm, mapping=5)": "mapping",
    "arm.ik('x')": "hal.Pose",
    "arm.ik([0.4, 0, 0.4])": "hal.Pose",
    "arm.ik(arm.state().tcp, q_seed=[0] * 6)": "q_seed must have shape (7,)",
    "arm.ik(arm.state().tcp, q_seed='x')": "q_seed must be numbers",
    "arm.fk([0.0] * 6)": "q must have shape (7,)",
    "arm.fk(None)": "q must",
    "arm.fk([NAN] * 7)": "finite",
    "arm.fk([HUGE] * 7)": "q must be numbers",
    "rig.clock.rate(math.inf)": "a rate must be",
    "rig.clock.rate(NAN)": "a rate must be",
    "rig.clock.rate('x')": "a rate must be",
    "rig.clock.rate(0)": "a rate must be",
    "rig.clock.sleep(NAN)": "seconds must be",
    "rig.clock.sleep(math.inf)": "seconds must be",
    "rig.clock.sleep_until(math.inf)": "t must be",
    "rig.clock.call_every(NAN, print)": "must be",
    "rig.observe(after=rig.clock.now() + 100)": "in the future",
    "rig.observe(after=NAN)": "after must be",
    "rig.observe(timeout=NAN)": "timeout must be",
    "rig.observe(history=1.5)": "history must be",
    "rig.observe(history=0)": "history must be",
    "rig.observe(cameras='scene')": "cameras=['scene']",
    "arm.state(max_age=NAN)": "max_age must be",
    "arm.gripper.start(NAN)": "width must be",
    "arm.gripper.start('x')": "width must be",
    "arm.gripper.start(-0.01)": "width must be",
    "arm.gripper.start(0.09)": "width must be",
    "arm.gripper.start(np.array([0.05]))": "width must be",
    "arm.gripper.start(0.05, force=HUGE)": "force must be",
    "arm.gripper.start(0.05, force=71.0)": "force must be",
    "arm.gripper.grip(1.5)": "grip",
    "arm.gripper.grip('x')": "grip",
    "arm.gripper.state(NAN)": "max_age must be",
    "hal.JointTarget([HUGE] * 7)": "q must be numbers",
    "hal.JointChunk([0.0], [[HUGE] * 7])": "q must be numbers",
    "hal.Twist([HUGE, 0, 0])": "linear must be numbers",
    "hal.Pose([HUGE, 0, 0], [0, 0, 0, 1])": "position must be numbers",
    "hal.Pose('x', [0, 0, 0, 1])": "position must be numbers",
    "hal.Pose([NAN, 0, 0], [0, 0, 0, 1])": "finite",
    "hal.Pose([0, 0], [0, 0, 0, 1])": "position must have shape (3,)",
    "hal.Pose([0, 0, 0], [0, 0, 0, 0])": "quaternion",
}
"""Call -> a part of the message."""


@pytest.mark.parametrize("call", WRONG)
def test_a_wrong_argument_says_what_to_pass_instead(call: str, rig: hal.Rig) -> None:
    names = {"rig": rig, "arm": rig.robots["panda"], "pad": rig.gamepads["pad"], "hal": hal, "math": math, "np": np}
    before = rig.clock.now()
    with pytest.raises(HalError) as caught:
        eval(call, names | {"HUGE": HUGE, "NAN": NAN})
    assert WRONG[call] in str(caught.value)
    assert len(str(caught.value)) < 300
    assert rig.clock.now() == before, "no time passed on the way to the error"


def test_valid_arguments_of_many_types_pass(rig: hal.Rig) -> None:
    arm, pad = rig.robots["panda"], rig.gamepads["pad"]
    assert arm.fk(arm.home.tolist()) == arm.fk(arm.home)
    assert arm.ik(arm.fk(arm.home), q_seed=list(arm.home)).shape == (7,)
    assert arm.state(max_age=math.inf).stamp.t > 0.0
    assert rig.observe(after=rig.clock.now(), timeout=np.float32(1.0), history=np.int64(2)).history
    assert hal.Teleop(arm).step(pad.state(), 0.02)
    assert next(rig.clock.rate(np.float64(50.0))).missed == 0
    assert arm.move_to(arm.home, timeout=30, patience=math.inf).stamp.t > 0.0
