"""Robotiq grippers on the wire: the emulator and an independent client, faults of the line, and whole rigs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest
from app_kit import run_here, write_pad
from robotiq_kit import FarGripper, emulated_robotiq, robotiq_overrides
from waiting import wait_until

import hal
from hal.apps.calibrate import main as calibrate
from hal.apps.check import main as check
from hal.apps.replay import main as replay
from hal.recording import Recorder
from hal.skills import grasp, grasp_pose, locate_by_truth
from hal_emulators.control import EmulatorControl

from .franka_kit import Emulator, free_host

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

LINES = pytest.mark.parametrize("line", ["serial", "text"])
LOST = 0.15
"""Time within which a line that is gone must be known, s."""
DOWN = [1.0, 0.0, 0.0, 0.0]
OPTIONS: dict[str, Any] = {"approach": 0.03, "lift": 0.03, "speed": 0.3, "unattended": True}


def test_an_independent_client_activates_and_moves_the_emulated_gripper() -> None:
    pymodbus = pytest.importorskip("pymodbus.client", reason="pip install pymodbus pyserial")
    with emulated_robotiq(active=False) as far:
        client = pymodbus.ModbusSerialClient(str(far.driver.settings.port), baudrate=115200, timeout=1)
        assert client.connect()
        client.write_registers(0x03E8, [0x0000, 0, 0], device_id=9)
        client.write_registers(0x03E8, [0x0100, 0, 0], device_id=9)

        def status() -> list[int]:
            registers: list[int] = client.read_holding_registers(0x07D0, count=3, device_id=9).registers
            return registers

        wait_until(lambda: status()[0] >> 8 == 0x31, "activated")
        far.execute("object 0.03")
        client.write_registers(0x03E8, [0x0900, 0x00FF, 0xFFFF], device_id=9)
        wait_until(lambda: status()[0] >> 8 == 0xB9, "it holds the object")
        assert status()[1] == 0x00FF
        assert client.read_input_registers(0x07D0, count=3, device_id=9).registers == status()
        client.close()
        far.driver.open()
        assert far.run(0.05).width == pytest.approx(0.03, abs=1e-3)


@pytest.mark.pair
@LINES
@pytest.mark.parametrize("fault", ["unplug on", "silent on", "power on", "late 0.5", "lose 1"])
def test_a_line_that_is_gone_is_known_soon_and_comes_back(line: str, fault: str) -> None:
    with emulated_robotiq(line) as far:
        far.driver.open()
        far.execute("object 0.03")
        far.driver.move(0.0, 0.1, 60.0)
        assert far.run(1.2).grasped
        newest_t = monotonic()
        far.execute(fault.replace("power on", "power 0.5"))
        with pytest.raises(hal.ConnectionLost):
            while True:
                newest_t = far.run(0.01).t
        assert monotonic() - newest_t < LOST
        with pytest.raises(hal.ConnectionLost):
            far.driver.move(0.05, 0.1, 60.0)
        if not fault.startswith("power"):
            far.execute("unplug off")
            far.execute("reset")
        reading = wait_for_reading(far)
        if fault.startswith("power"):
            assert reading.fault is not None
            assert reading.fault.code == "not_activated"
        else:
            assert (reading.grasped, reading.fault) == (True, None)
        assert reading.width == pytest.approx(0.03, abs=1e-3), "nothing moved"


def wait_for_reading(far: FarGripper) -> Any:
    """Return the first reading of a line that has come back."""
    found: list[Any] = []

    def read() -> bool:
        try:
            found.append(far.run(0.01))
        except hal.ConnectionLost:
            return False
        return True

    wait_until(read, "it answers again")
    return found[-1]


@pytest.mark.parametrize("fault", ["lose next 1", "garble 1", "late 0.03", "late 0.06"])
def test_a_disturbed_serial_line_is_asked_again(fault: str) -> None:
    with emulated_robotiq() as far:
        far.driver.open()
        far.run(0.05)
        far.execute(fault)
        far.driver.move(0.05, 0.1, 60.0)
        reading = far.run(1.5)
        assert reading.width == pytest.approx(0.05, abs=1e-3)
        assert not reading.moving


def test_an_answer_that_comes_late_is_stamped_as_old() -> None:
    with emulated_robotiq() as far:
        far.driver.open()
        far.execute("late 0.06")
        far.run(0.3)
        ages: dict[int, float] = {}
        for _ in range(30):
            reading = far.run(0.01)
            ages.setdefault(reading.seq, monotonic() - reading.t)
        assert min(ages.values()) > 0.06
        assert len(ages) > 2


def test_the_gripper_keeps_its_grip_when_its_process_is_killed() -> None:
    """The arm is simulated: only the gripper is behind the wire."""
    overrides = [*robotiq_overrides(), "cameras={}", "robots.arm.sim=true", "robots.arm.gripper.sim=false"]
    with emulated_robotiq() as far:
        far.execute("object 0.03")
        with hal.open("franka_robotiq", sim=False, pad="none", clock="real_time", overrides=overrides) as rig:
            gripper = rig.robots["arm"].gripper
            assert gripper is not None
            assert gripper.grasp(0.03, force=100.0)
            host = next(host for host in rig._hosts if host.spec.grippers)
            os.kill(host.child.process.pid, signal.SIGKILL)  # type: ignore[attr-defined]
            with pytest.raises(hal.ConnectionLost):
                wait_until(lambda: gripper.state() is None, "the app knows")
            sleep(0.3)
            assert far.execute("state")["force"] == pytest.approx(100.0, abs=1.0)
        with hal.open("franka_robotiq", sim=False, pad="none", clock="real_time", overrides=overrides) as rig:
            state = rig.robots["arm"].gripper.state()  # type: ignore[union-attr]
            assert (state.grasped, state.fault) == (True, None)


def test_the_command_line_activates_a_gripper_while_the_deadman_is_held(tmp_path: Path) -> None:
    """The arm is simulated: only the gripper is behind the wire."""
    overrides = [*robotiq_overrides(), "robots.arm.sim=true", "robots.arm.gripper.sim=false"]
    words = [word for value in overrides for word in ("--set", value)]
    with emulated_robotiq(active=False) as far:
        pad = write_pad(tmp_path, until=60.0, held=(1.0, 50.0))
        shown = run_here(calibrate, "gripper", "--config", "franka_robotiq", "--real", *words, "--pad", pad)
        assert shown.returncode == 0, shown.stdout + shown.stderr
        assert "ready, 85 mm open" in shown.stdout
        assert far.execute("state")["STA"] == 3


class RobotiqProgram:
    """A running ``python -m hal_emulators.robotiq``."""

    def __init__(self, *words: str) -> None:
        command = [sys.executable, "-m", "hal_emulators.robotiq", "--config", "franka_robotiq", *words]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        ready = self.process.stdout.readline()
        self.control = EmulatorControl("127.0.0.1", int(ready.split("control port ")[1].split(";")[0]))

    def close(self) -> None:
        """End it."""
        self.control.close()
        self.process.terminate()
        assert self.process.wait(10) == 0


@pytest.fixture
def droid() -> Iterator[list[str]]:
    """What names the emulators of an FR3 and of a 2F-85, which run, in their rig."""
    for library in ("pylibfranka", "pyarrow", "av"):
        pytest.importorskip(library, reason="pip install 'robot-hal[franka,record]'")
    overrides = [*robotiq_overrides(), f"robots.arm.real.host={(host := free_host())}"]
    # Without a GPU two cameras at 30 Hz are too much for two processors beside the arm, its emulator and a program.
    overrides += [f"cameras.{name}.capture={{width: 640, height: 480, rate_hz: 6}}" for name in ("scene", "wrist")]
    # It waits for a set-point that is late: a busy machine must not look like a fault of the arm.
    words = [word for value in overrides for word in ("--set", value)]
    with Emulator("--lockstep", "--end-effector", "none", "--config", "franka_robotiq", *words, host=host):
        far = RobotiqProgram(*words)
        yield overrides
        far.close()


@pytest.mark.alone
def test_a_franka_with_a_robotiq_is_checked_activated_grasps_and_replays(droid: list[str], tmp_path: Path) -> None:
    """The rig of DROID, from beginning to end."""
    overrides = droid
    words = ["--config", "franka_robotiq", "--real", *(word for value in overrides for word in ("--set", value))]
    assert "not activated" in run_here(check, *words, "--duration", 0.2).stdout
    with hal.open("franka_robotiq", sim=False, pad="none", clock="real_time", overrides=overrides) as rig:
        arm = rig.robots["arm"]
        assert arm.gripper is not None
        arm.gripper.home()
        arm.move_to(arm.home, speed=0.3, unattended=True)
        found = locate_by_truth(rig, arm, "cube")
        assert found is not None
        low = rig.world.pose("cube").position[2]
        with Recorder(rig, tmp_path / "data", fps=15, task="grasp") as recorder:
            recorder.start()
            done = grasp(arm, grasp_pose(found, arm.gripper), **OPTIONS)
            assert done, done.message
            assert done.width == pytest.approx(0.03, abs=3e-3), "the cube of the world that the cameras show"
            wait_until(lambda: rig.world.pose("cube").position[2] - low > 0.02, "lifted")  # the world may be late
            recorder.save(success=True, wait=True)
        arm.gripper.open()
        wait_until(lambda: rig.world.pose("cube").position[2] - low < 5e-3, "it falls")
    shown = run_here(replay, str(tmp_path / "data"), "--unattended", *words)
    assert shown.returncode == 0, shown.stdout + shown.stderr
    with hal.open("franka_robotiq", sim=False, pad="none", clock="real_time", overrides=overrides) as rig:
        wait_until(lambda: rig.world.pose("cube").position[2] - low > 0.02, "lifted by the replay, and held since")


def test_the_same_rig_grasps_in_simulation() -> None:
    with hal.open("franka_robotiq", sim=True, pad="none", clock="lock_step", overrides=["cameras={}"]) as rig:
        arm = rig.robots["arm"]
        found = locate_by_truth(rig, arm, "cube")
        assert found is not None
        assert arm.gripper is not None
        done = grasp(arm, grasp_pose(found, arm.gripper), **OPTIONS)
        assert done, done.message
