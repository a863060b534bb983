"""Torques through the real drivers: the emulated arm floats, is driven, braked and held, and no limit is broken."""

from __future__ import annotations

import numpy as np
import pytest

import hal
from hal.types import RobotStatus

from .franka_kit import Emulator
from .rig_kit import arm_of, rig_of

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")


@pytest.mark.parametrize(("robot", "losses"), [("fr3", "lose-commands 0"), ("panda", "lose-commands 0.05")])
def test_an_arm_on_torques(emulator: Emulator, robot: str, losses: str) -> None:
    with rig_of(emulator.host, robot, lock_step=True) as rig:
        arm = arm_of(rig)
        emulator.control.send(losses)
        home = arm.state().q
        goal = home.copy()
        goal[6] += 0.1

        def spring(control: hal.Control, seconds: float) -> None:
            start = rig.clock.now()
            for tick in rig.clock.rate(200):
                state = arm.state()
                control.send(hal.JointTorque(8.0 * (goal - state.q) - 2.0 * state.dq))
                if tick.t - start > seconds:
                    return

        with arm.control(rate_hz=200, unattended=True) as control:
            spring(control, 1.5)
            there = arm.state().q
            assert there[6] - home[6] > 0.05, "the spring turned the wrist"
            rig.stop()
            rig.clock.sleep(0.5)
            assert np.abs(arm.state().dq).max() < 1e-3
            assert arm.state().status is RobotStatus.TRIPPED
            held = arm.state().q
            rig.clock.sleep(0.5)
            assert np.abs(arm.state().q - held).max() < 1e-3, "positions hold it"
            rig.rearm()
            control.rearm()
            for _ in zip(range(50), rig.clock.rate(50), strict=False):
                control.send(hal.JointTarget(held))
            assert arm.state().status is RobotStatus.FOLLOWING
    assert not emulator.events("reflex")
    kinds = [event["text"] for event in emulator.events("motion started")]
    assert any("external" in text or "torque" in text for text in kinds), kinds
    assert "success" in emulator.events("motion ended")[-1]["text"]
