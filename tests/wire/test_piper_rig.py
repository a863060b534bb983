"""A PiPER as a program opens it, in real time: its emulator in another process, over UDP multicast."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from typing import Any

import pytest
from can_kit import EmulatorProcess
from waiting import wait_until

import hal
from hal.errors import ControlTaken, HalError

GOAL = [0.3, 1.2, -1.0, 0.2, 0.8, 0.1]
MORE = ["gamepads={}"]
HOLDER = """
import json, sys, time, hal
if __name__ == "__main__":
    with hal.open("piper", sim=False, overrides=json.loads(sys.argv[1])) as rig:
        arm = rig.robots["arm"]
        with arm.control(rate_hz=50, unattended=True) as control:
            print("ready", flush=True)
            for tick in rig.clock.rate(50):
                control.send(hal.JointVelocity([0.2, 0, 0, 0, 0, 0]))
"""


def state_of(emulator: EmulatorProcess) -> dict[str, Any]:
    """Return the emulated arm's state."""
    return emulator.execute("state")


def opened(emulator: EmulatorProcess) -> Any:
    """Open the rig on an emulator."""
    return hal.open("piper", sim=False, overrides=[*emulator.overrides, *MORE])


def test_a_program_drives_the_arm_and_its_gripper_and_leaves_them_holding() -> None:
    with EmulatorProcess("piper") as emulator:
        with opened(emulator) as rig:
            arm = rig.robots["arm"]
            assert not any(state_of(emulator)["enabled"])  # opening switches nothing on
            arm.move_to(GOAL, unattended=True, speed=0.5)
            arm.gripper.move(0.02)
            assert arm.gripper.state().width == pytest.approx(0.02, abs=2e-3)
            wait_until(lambda: arm.state(max_age=1.0).q == pytest.approx(GOAL, abs=2e-3), "there")
            with pytest.raises(ControlTaken):
                opened(emulator)
            figures = rig.statistics()["arm"]["robots"]["arm"]["driver"]
            assert figures["bus"]["unexpected"] == figures["bus"]["error_frames"] == figures["faults"] == 0
        left = state_of(emulator)
        assert all(left["enabled"])
        assert left["target"] == pytest.approx(GOAL, abs=2e-3)
        with opened(emulator) as rig:  # it is where it was, and moves on from there
            arm = rig.robots["arm"]
            assert arm.state().q == pytest.approx(GOAL, abs=2e-3)
            arm.move_to([0.2, *GOAL[1:]], unattended=True, speed=0.5)


def test_a_bus_that_is_cut_stops_the_program_and_comes_back() -> None:
    with EmulatorProcess("piper") as emulator, opened(emulator) as rig:
        arm = rig.robots["arm"]
        with arm.control(rate_hz=10, unattended=True) as control:  # the program's own lateness is no reason to stop
            with pytest.raises(HalError) as caught:
                for tick in rig.clock.rate(50):
                    control.send(hal.JointVelocity([0.2, 0.0, 0.0, 0.0, 0.0, 0.0]))
                    if tick.elapsed > 0.5:
                        emulator.execute("cut on")
                    assert tick.elapsed < 20.0, "nothing was noticed"
            assert caught.value.code in ("device_lost", "connection_lost", "silent")
        wait_until(lambda: not answers(arm), "lost")
        emulator.execute("cut off")
        wait_until(lambda: answers(arm), "answers again")
        before = state_of(emulator)
        arm.move_to(GOAL, unattended=True, speed=0.5)
        assert before["target"][0] == pytest.approx(before["q"][0], abs=0.02)


def answers(arm: hal.Robot) -> bool:
    """Whether the arm's state can be read."""
    try:
        return bool(arm.state().q.size)
    except HalError:
        return False


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_an_arm_whose_program_ends_holds(number: int) -> None:
    with EmulatorProcess("piper") as emulator:
        overrides = json.dumps([*emulator.overrides, *MORE])
        program = subprocess.Popen([sys.executable, "-c", HOLDER, overrides], stdout=subprocess.PIPE, text=True)
        assert program.stdout is not None
        assert program.stdout.readline() == "ready\n"
        time.sleep(0.7)
        os.kill(program.pid, number)
        program.wait(10.0)
        program.stdout.close()
        time.sleep(1.0)
        first = state_of(emulator)
        time.sleep(1.0)
        last = state_of(emulator)
        assert all(last["enabled"])
        assert last["target"] == first["target"]
        assert first["q"] == pytest.approx(last["q"], abs=1e-3)
