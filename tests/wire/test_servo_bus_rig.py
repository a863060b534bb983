"""Arms on servo buses as a program opens them, in real time: the emulator in another process, on a pseudo terminal."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from servo_bus_kit import ServoBusProcess
from waiting import wait_until

import hal
from hal.errors import ControlTaken, HalError

pytestmark = [pytest.mark.slow, pytest.mark.pair]

POSES = {
    "so101": ([0.3, -0.4, 0.6, 1.0, -1.2], [-0.4, -0.9, 1.1, 1.3, -1.5], [0.0, -0.6, 0.87, 1.3, -1.524]),
    "viperx": ([0.3, -0.4, 0.2, 0.3, -1.0, 0.4], [-0.4, 0.2, -0.5, -0.3, -1.3, -0.4], [0.0, -0.18, -0.36, 0, -1.38, 0]),
}
"""The last one is where the arm starts."""
SOAK = bool(os.environ.get("HAL_SOAK"))
if SOAK:
    POSES["widowx"] = POSES["viperx"]
APP = """
import json, sys, hal
if __name__ == "__main__":
    with hal.open(sys.argv[1], sim=False, overrides=json.loads(sys.argv[2])) as rig:
        arm = rig.robots["arm"]
        with arm.control(rate_hz=50, unattended=True) as control:
            print("ready", flush=True)
            for tick in rig.clock.rate(50):
                control.send(hal.JointVelocity([0.1, *[0] * (len(arm.joints) - 1)]))
"""


@pytest.fixture(params=POSES)
def emulator(request: pytest.FixtureRequest) -> Iterator[ServoBusProcess]:
    with ServoBusProcess(request.param) as emulator:
        yield emulator


def tour(rig: hal.Rig, poses: Sequence[list[float]]) -> list[hal.RobotState]:
    """Go through the poses, and return the states there."""
    arm, found = rig.robots["arm"], []
    for pose in poses:
        arm.move_to(pose, unattended=True, speed=0.3)
        rig.clock.sleep(0.5)
        found.append(arm.state())
    arm.gripper.move(0.025)
    assert arm.gripper.state().width == pytest.approx(0.025, abs=2e-3)
    return found


@pytest.mark.parametrize("emulator", POSES if SOAK else ["so101"], indirect=True)
@pytest.mark.parametrize("run", range(10 if SOAK else 1))
def test_the_tour_ends_at_the_poses_of_the_simulation_and_the_arm_holds_afterwards(
    emulator: ServoBusProcess, run: int
) -> None:
    poses = POSES[emulator.rig]
    with hal.open(emulator.rig, sim=True, clock="lock_step", overrides=emulator.overrides) as rig:
        simulated = tour(rig, poses)
    with hal.open(emulator.rig, sim=False, overrides=emulator.overrides) as rig:
        real = tour(rig, poses)
        with pytest.raises(ControlTaken):
            hal.open(emulator.rig, sim=False, overrides=emulator.overrides)
        figures = rig.statistics()["arm"]
        assert figures["robots"]["arm"]["driver"]["faults"] == 0
    off = max(float(np.abs(a.q - b.q).max()) for a, b in zip(real, simulated, strict=True))
    apart = max(a.tcp.distance(b.tcp)[0] for a, b in zip(real, simulated, strict=True))
    print(f"run {run}: {1e3 * apart:.2f} mm, {off:.4f} rad, period p50 {figures['period_s']['p50']:.4f} s")
    assert off < 0.01
    assert apart < 0.002
    assert figures["period_s"]["p50"] == pytest.approx(0.01, rel=0.05)
    left = emulator.execute("state")
    assert all(left["on"]), "it holds"
    assert left["q"] == pytest.approx(poses[-1], abs=0.01)


def answers(arm: hal.Robot) -> bool:
    """Whether the arm's state can be read."""
    try:
        return bool(arm.state().q.size)
    except HalError:
        return False


@pytest.mark.parametrize(
    ("emulator", "command"),
    [("so101", one) for one in ("unplug on", "power on", "error 3 32", "late 0.2")]
    + [("viperx", one) for one in ("power on", "error 3 32")],  # what each protocol says in its own way
    indirect=["emulator"],
)
def test_a_fault_of_bus_or_motor_stops_the_program_and_the_arm_moves_again_afterwards(
    emulator: ServoBusProcess, command: str
) -> None:
    with hal.open(emulator.rig, sim=False, overrides=emulator.overrides) as rig:
        arm = rig.robots["arm"]
        still = [0.0] * (len(arm.joints) - 1)
        with arm.control(rate_hz=10, unattended=True) as control, pytest.raises(HalError):
            for tick in rig.clock.rate(50):
                control.send(hal.JointVelocity([0.2, *still]))
                if tick.elapsed > 0.5:
                    emulator.execute(command)
                assert tick.elapsed < 10.0, "nothing was noticed"
        if "error" not in command:
            wait_until(lambda: not answers(arm), "lost")
        emulator.execute("reset")
        wait_until(lambda: answers(arm), "answers again")
        emulator.execute(f"place {' '.join(map(str, POSES[emulator.rig][-1]))}")  # someone lifts and holds it
        wait_until(lambda: answers(arm), "answers")
        arm.recover()
        peak: Any = emulator.execute("reset") or emulator.execute("state")["peak_speed"]
        assert max(peak) < 0.05
        goal = arm.state().q + [0.2, *still]
        assert abs(arm.move_to(goal, unattended=True, speed=0.3).q - goal).max() < 0.03


def test_an_arm_whose_program_is_killed_holds(emulator: ServoBusProcess) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", APP, emulator.rig, json.dumps(emulator.overrides)], stdout=subprocess.PIPE, text=True
    )
    assert program.stdout is not None
    assert program.stdout.readline() == "ready\n"
    time.sleep(0.7)
    os.kill(program.pid, 9)
    program.wait(10.0)
    program.stdout.close()
    wait_until(lambda: max(map(abs, emulator.execute("state")["dq"])) < 1e-3, "at rest")
    first = emulator.execute("state")
    assert first["q"][0] > 0.03, "it moved"
    time.sleep(1.0)
    last = emulator.execute("state")
    assert all(last["on"][:-1])
    assert last["q"] == pytest.approx(first["q"], abs=1e-3)


def test_feetechs_own_library_drives_the_motors() -> None:
    scs = pytest.importorskip("scservo_sdk", reason="needs feetech-servo-sdk: pip install 'robot-hal[test]'")
    with ServoBusProcess() as emulator:
        port, packets = scs.PortHandler(emulator.port), scs.PacketHandler(0)
        try:
            assert port.openPort()
            assert port.setBaudRate(1_000_000)
            assert packets.ping(port, 1) == (777, scs.COMM_SUCCESS, 0)
            reader = scs.GroupSyncRead(port, packets, 56, 2)
            writer = scs.GroupSyncWrite(port, packets, 42, 2)
            for id in range(1, 7):
                assert reader.addParam(id)
            assert reader.txRxPacket() == scs.COMM_SUCCESS
            first = [reader.getData(id, 56, 2) for id in range(1, 7)]
            goals = [count + 50 for count in first]
            for id, goal in enumerate(goals, 1):
                assert writer.addParam(id, [goal & 255, goal >> 8])
            assert writer.txPacket() == scs.COMM_SUCCESS
            for id in range(1, 7):
                assert packets.write1ByteTxRx(port, id, 40, 1) == (scs.COMM_SUCCESS, 0)
            time.sleep(1.0)
            bad = sum(reader.txRxPacket() != scs.COMM_SUCCESS for _ in range(300))
            last = [reader.getData(id, 56, 2) for id in range(1, 7)]
        finally:
            port.closePort()
    assert bad <= 3  # a busy computer
    assert last == pytest.approx(goals, abs=12), "the weight pulls them off their goals"
    assert all(b - a > 30 for a, b in zip(first, last, strict=True))


def test_robotis_own_library_drives_the_motors() -> None:
    dxl = pytest.importorskip("dynamixel_sdk", reason="needs dynamixel-sdk: pip install 'robot-hal[test]'")
    with ServoBusProcess("viperx") as emulator:
        port, packets = dxl.PortHandler(emulator.port), dxl.PacketHandler(2.0)
        try:
            assert port.openPort()
            assert port.setBaudRate(1_000_000)
            assert packets.ping(port, 8) == (1020, dxl.COMM_SUCCESS, 0)
            found, status = packets.broadcastPing(port)
            assert (sorted(found), status) == (list(range(1, 10)), dxl.COMM_SUCCESS)
            reader = dxl.GroupSyncRead(port, packets, 132, 4)
            writer = dxl.GroupSyncWrite(port, packets, 116, 4)
            ids = range(1, 10)
            assert all(reader.addParam(id) for id in ids)
            assert reader.txRxPacket() == dxl.COMM_SUCCESS
            first = [reader.getData(id, 132, 4) for id in ids]
            goals = [count + 50 for count in first]
            for id, goal in zip(ids, goals, strict=True):
                if id not in (3, 5):  # these have the ids of others as their secondary ones
                    assert writer.addParam(id, goal.to_bytes(4, "little"))
                assert packets.write1ByteTxRx(port, id, 64, 1) == (dxl.COMM_SUCCESS, 0)
            assert writer.txPacket() == dxl.COMM_SUCCESS
            assert packets.write2ByteTxRx(port, 1, 36, 400)[1] == 7, "stored registers are locked by the torque"
            assert packets.write4ByteTxRx(port, 2, 116, 4000)[1] == 6, "outside of its range"
            time.sleep(1.0)
            bad = sum(reader.txRxPacket() != dxl.COMM_SUCCESS for _ in range(300))
            last = [reader.getData(id, 132, 4) for id in ids]
        finally:
            port.closePort()
    assert bad <= 3  # a busy computer
    assert last == pytest.approx(goals, abs=40), "the weight pulls them off their goals"
    assert all(b - a > 8 for a, b in zip(first, last, strict=True))
