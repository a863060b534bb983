"""An emulated UFACTORY arm with the unmodified xarm-python-sdk: in a program of its own, and behind hal.open."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import Any

import pytest
from waiting import wait_until

import hal

from .network_kit import XArmEmulator, check_same_poses, kill_app
from .test_ur_faults import recover, wait_code
from .test_ur_rig import find_children

pytestmark = [pytest.mark.slow, pytest.mark.pair]


@pytest.fixture
def emulator() -> Iterator[XArmEmulator]:
    emulator = XArmEmulator()
    yield emulator
    emulator.close()


def test_a_program_of_its_own_moves_the_arm_with_the_sdk(emulator: XArmEmulator) -> None:
    command = [sys.executable, str(Path(__file__).with_name("xarm_client.py")), emulator.host]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr
    done: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
    assert done["arm"] == [7, [2, 5, 0]]
    assert [done["not enabled"], done["wrong mode"]] == [9, 10], "not ready; not possible in this mode"
    assert done["start"] == [0, 0, 0, 2]
    assert done["move"] == [0]
    assert done["moved"] == pytest.approx([0, 0, 0, 0, 0, 0, 0.4], abs=1e-3)
    assert done["servo"] == [0, 0, 0, 2]
    assert done["streamed"] == pytest.approx([0, 0, 0, 0, 0, 0.1, 0], abs=1e-3)
    assert done["jump"] == [1, 24, 4]
    assert abs(done["still"]) < 0.01, "it does not follow a jump"
    assert done["clean"] == [0, 0, 0, 0, 0, 2, 0]
    assert done["report"] == [1, 0, [1] * 7]
    assert done["load"] == 0
    assert done["gripper"] == [0, 0, 400, 0, "3.4.3"]


def drive(rig: hal.Rig, emulator: XArmEmulator, act: Any) -> None:
    """Move until the session ends; ``act`` once the arm moves."""
    with pytest.raises(hal.HalError), rig.robots["arm"].control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0, 0, 0, 0.2, 0, 0, 0]))
            if act is not None and max(emulator.status()["dq"]) > 0.15:
                act = act()
            assert tick.elapsed < 10.0


def check_stands(emulator: XArmEmulator) -> None:
    """Check that the arm comes to rest and stays there without an error, with its motors on."""
    rest = emulator.wait_for(lambda status: max(map(abs, status["dq"])) < 1e-3, 0.3)
    time.sleep(0.3)
    status = emulator.status()
    assert status["q"] == pytest.approx(rest["q"], abs=1e-4)
    assert status["q"] == pytest.approx(status["target_q"], abs=1e-4)
    assert [status["error"], status["enabled"]] == [0, True]


def test_the_arm_stands_at_its_last_set_point_when_the_host_is_killed(emulator: XArmEmulator) -> None:
    before = find_children()
    with hal.open(emulator.rig()) as rig:
        (host,) = find_children() - before
        drive(rig, emulator, lambda: os.kill(host, signal.SIGKILL))
        check_stands(emulator)
    with hal.open(emulator.rig()) as rig:  # and it can be driven again
        arm = rig.robots["arm"]
        assert abs(arm.move_to(arm.home, unattended=True, speed=0.3).q - arm.home).max() < 2e-3


def test_the_arm_stands_while_the_host_is_frozen_and_continues_without_a_jump(emulator: XArmEmulator) -> None:
    before = find_children()
    with hal.open(emulator.rig()) as rig:
        (host,) = find_children() - before

        def freeze() -> None:
            os.kill(host, signal.SIGSTOP)
            time.sleep(0.15)
            assert max(map(abs, emulator.status()["dq"])) < 1e-3
            time.sleep(0.15)
            os.kill(host, signal.SIGCONT)

        drive(rig, emulator, freeze)
        check_stands(emulator)
        arm = rig.robots["arm"]
        recover(rig, arm)
        assert abs(arm.move_to(arm.home, unattended=True, speed=0.3).q - arm.home).max() < 2e-3
    assert not any("error" in event for event in emulator.status()["events"])


def test_the_arm_stands_when_the_app_is_killed(emulator: XArmEmulator) -> None:
    kill_app(emulator)
    emulator.wait_for(lambda status: status["state"] == 4, 20.0)
    check_stands(emulator)


def test_the_same_program_ends_at_the_same_poses_on_the_arm_and_in_simulation(emulator: XArmEmulator) -> None:
    check_same_poses(emulator, [0.2, -0.1, 0.1, 0.1, 0, 0.3, 0], [-0.2, 0.1, -0.2, 0.2, 0.1, 0, 0.3])


def test_the_gripper_holds_names_its_faults_and_moves_again(emulator: XArmEmulator) -> None:
    rig, control = emulator.rig(), emulator.control
    rig["robots"]["arm"]["gripper"] = {"model": "xarm_gripper"}
    with hal.open(rig) as opened:
        arm = opened.robots["arm"]
        gripper = arm.gripper
        assert gripper is not None
        control.send("object 0.03")
        assert gripper.grasp(0.03)
        control.send("object none")
        assert gripper.move(0.05).width == pytest.approx(0.05, abs=2e-3)
        control.send("gripper block")
        with pytest.raises(hal.RobotFault, match="Position Deviation") as failed:
            gripper.move(0.0)
        assert "gripper.home()" in failed.value.remedy
        control.send("gripper on")
        gripper.home()
        assert gripper.move(0.07).width == pytest.approx(0.07, abs=2e-3)
        control.send("gripper off")
        with pytest.raises(hal.ConnectionLost, match="does not answer through the control box"):
            wait_until(lambda: gripper.state() is None, "it is named")
        wait_code(arm, "C19")
        control.send("gripper on")
        recover(opened, arm)
        wait_until(lambda: gripper.state(max_age=inf).fault is None, "it answers again")
        assert gripper.move(0.02).width == pytest.approx(0.02, abs=2e-3)


def test_a_gripper_hears_a_stop_that_came_while_it_did_not_answer(emulator: XArmEmulator) -> None:
    rig, control = emulator.rig(), emulator.control
    rig["robots"]["arm"]["gripper"] = {"model": "xarm_gripper"}
    with hal.open(rig) as opened:
        arm = opened.robots["arm"]
        gripper = arm.gripper
        assert gripper is not None

        def stop_unheard() -> None:
            control.send("gripper off")
            wait_until(lambda: gripper.trouble, "it is lost")
            opened.stop()
            wait_code(arm, "C19")

        def answer() -> None:
            control.send("gripper on")
            opened.rearm()
            recover(opened, arm)
            wait_until(lambda: not gripper._mail.get().lost, "it answers")
            width = -1.0
            while width != (width := emulator.status()["width"]):
                opened.clock.sleep(0.6)

        gripper.start(0.0, speed=0.008)
        wait_until(lambda: gripper.state().width < 0.084, "it moves")
        stop_unheard()
        answer()
        assert emulator.status()["width"] > 0.02
        control.send("object 0.03")
        assert gripper.grasp(0.03)
        stop_unheard()
        answer()
        control.send("object none")
        emulator.wait_for(lambda status: status["width"] < 0.01)  # it still presses


def test_another_arm_is_driven_by_its_model() -> None:
    other = XArmEmulator("--robot", "lite6", model="lite6")
    try:
        with hal.open(other.rig()) as rig:
            arm = rig.robots["arm"]
            goal = arm.home + 0.1
            assert arm.move_to(goal, unattended=True).q == pytest.approx(goal, abs=2e-3)
        assert other.status()["error"] == 0
    finally:
        other.close()


def test_a_model_of_another_arm_is_refused() -> None:
    other = XArmEmulator("--robot", "xarm6")
    try:
        with pytest.raises(hal.ConnectionLost) as refused:
            hal.open(other.rig())
        assert refused.value.code == "WRONG_ARM"
    finally:
        other.close()
