"""The emulator of CAN arms as a program: its prompt, its control port, its end."""

from __future__ import annotations

import time

import pytest
from can_kit import EmulatorProcess
from waiting import wait_until

import hal
from hal_emulators.can.__main__ import main


def test_commands_are_typed_at_the_prompt_or_sent_to_the_control_port() -> None:
    with EmulatorProcess("yam") as emulator:
        emulator.type("status 3 A")
        deadline = time.monotonic() + 5.0
        while emulator.execute("state")["motors"]["3"]["status"] != "A" and time.monotonic() < deadline:
            time.sleep(0.01)
        assert emulator.execute("state")["motors"]["3"]["status"] == "A"
        emulator.type("frobnicate")
        while not any("no command" in line for line in emulator.lines) and time.monotonic() < deadline:
            time.sleep(0.01)
        assert any("no command" in line for line in emulator.lines)
        with pytest.raises(ValueError, match="usage"):
            emulator.execute("lose")
        assert emulator.execute("kill") == {}
        assert emulator.process.wait(5.0) != 0


@pytest.mark.parametrize("name", ["yam", "piper"])
def test_a_program_is_warned_of_lost_frames_at_its_end(name: str) -> None:
    with (
        EmulatorProcess(name) as emulator,
        pytest.warns(RuntimeWarning, match="frames on .* were lost"),
        hal.open(name, sim=False, pad="none", overrides=emulator.overrides) as rig,
    ):
        emulator.execute("lose 0.05")
        (group,) = rig.statistics()
        wait_until(lambda: rig.statistics()[group]["robots"]["arm"]["driver"]["warnings"], "lost")


def test_a_rig_without_a_can_arm_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--config", "franka_emulator"]) == 1
    assert "no arm on a CAN bus" in capsys.readouterr().err


def test_a_motor_that_the_rig_gives_twice_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--config", "yam", "--set", "robots.arm.gripper.real.motor.id=3", "--set", "cameras={}"]) == 1
    assert "motor" in capsys.readouterr().err
