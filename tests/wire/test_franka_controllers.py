"""Controllers through the vendors' libraries: the emulated arm follows by torques, rests, and no limit is broken."""

from __future__ import annotations

import numpy as np
import pytest

import hal
from hal.types import RobotStatus

from .franka_kit import Emulator
from .rig_kit import arm_of, rig_of

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")

CONTROLLERS = [hal.OperationalSpace(), hal.JointImpedance(stiffness=(200.0,) * 4 + (50.0,) * 3)]


@pytest.mark.parametrize(
    ("robot", "controller"), zip(["fr3", "panda"], CONTROLLERS, strict=True), ids=["task", "joints"]
)
def test_an_arm_rests_at_its_set_point(emulator: Emulator, robot: str, controller: hal.OperationalSpace) -> None:
    with rig_of(emulator.host, robot, lock_step=True) as rig:
        arm = arm_of(rig)
        goal = arm.home + [0.1, 0.05, -0.1, 0.05, 0.1, -0.05, 0.1]
        with arm.control(rate_hz=50, unattended=True, controller=controller) as control:
            begun, still = rig.clock.now(), 0.0
            for tick in rig.clock.rate(50):
                q_set = arm.state().q_set
                control.send(hal.JointTarget(q_set + np.clip(goal - q_set, -0.09, 0.09)))
                still = still + tick.dt if np.abs(goal - q_set).max() < 1e-4 else 0.0
                if still > 1.5:
                    break
                assert tick.t - begun < 6.0, "the set-point does not arrive"
            state = arm.state()
            distance, turn = state.tcp.distance(arm.fk(goal))
            assert distance < 1e-3
            assert turn < 5e-3
            assert state.controller is not hal.ControlMode.POSITION
        rest = arm.state()
        assert rest.status is RobotStatus.IDLE
        assert rest.controller is hal.ControlMode.POSITION
        rig.clock.sleep(0.3)
        assert np.abs(arm.state().q - rest.q).max() < 2e-3
    assert not emulator.events("reflex")
    assert "success" in emulator.events("motion ended")[-1]["text"]


def test_every_session_starts_on_an_arm_that_has_not_settled(fr3: Emulator) -> None:
    with rig_of(fr3.host, "fr3", lock_step=True) as rig:
        arm = arm_of(rig)
        for seed in range(8):
            fr3.control.send(f"unrest {seed}")
            rig.clock.sleep(0.01)
            with arm.control(rate_hz=50, unattended=True, controller=CONTROLLERS[seed % 2]) as control:
                control.send(hal.Twist([0.0, 0.0, 0.05 if seed % 4 < 2 else -0.05]))
                rig.clock.sleep(0.05)
                state = fr3.control.send("state")
                assert (state["controller"], state["mode"]) == ("external", "move"), (
                    f"session {seed}: {fr3.events()[-3:]}"
                )
                assert state["commands"] > 30
                assert arm.state().controller is not hal.ControlMode.POSITION
    assert not fr3.events("reflex")
