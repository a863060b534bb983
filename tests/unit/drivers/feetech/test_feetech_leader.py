"""A leader on a servo bus: what it reads, what it refuses, and that it never writes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from time import monotonic
from unittest.mock import patch

import numpy as np
import pytest
from feetech_kit import SteppedFeetech, so101_leader

from hal.driver import PadReading
from hal.drivers.feetech import bus
from hal.drivers.feetech.leader import FeetechLeader
from hal.leader import Leader
from hal.lock import DeviceLock

Q = [0.3, -0.4, 0.5, 0.2, -1.0]


@pytest.fixture
def far() -> Iterator[SteppedFeetech]:
    with SteppedFeetech() as emulator:
        emulator.arm.place(Q)
        yield emulator


@pytest.fixture
def leader(far: SteppedFeetech) -> Iterator[FeetechLeader]:
    with closing(so101_leader(far)) as driver:
        driver.open()
        yield driver


def poll(leader: FeetechLeader) -> PadReading:
    return leader.poll(monotonic(), 0.0)


def test_it_reads_joints_and_lever_and_writes_nothing(far: SteppedFeetech, leader: FeetechLeader) -> None:
    before = {id: bytes(servo.registers[:56]) for id, servo in far.arm.servos.items()}
    assert poll(leader).joints == pytest.approx(Q, abs=0.001)
    far.execute("hand 0.1 0 0 0.1 0 0 1")
    far.advance(0.2)
    reading = poll(leader)
    assert reading.joints == pytest.approx([0, 0, 0.1, 0, 0], abs=0.001)
    assert reading.axes["r2"] == pytest.approx(1.0, abs=0.01)
    leader.close()
    assert {id: bytes(servo.registers[:56]) for id, servo in far.arm.servos.items()} == before


@pytest.mark.parametrize(
    ("command", "cause"),
    [
        ("register 2 40 1", "shoulder_lift (motor 2) has torque"),
        ("register 3 3 1234", "elbow_flex (motor 3): is of the model 1234"),
        ("register 6 11 4095", "the lever (motor 6): its range is"),
        ("silent 4 on", "no answer from wrist_flex (motor 4)"),
        ("unplug on", "No such file"),
    ],
)
def test_what_is_no_leader_is_refused_by_name(
    command: str, cause: str, far: SteppedFeetech, leader: FeetechLeader
) -> None:
    far.execute(command)
    far.advance(0.01)
    assert not poll(leader).connected
    assert cause in leader.describe()
    assert leader.notes == (f"lead: {leader.describe().partition(': ')[2]}",)


def test_a_port_that_another_program_uses_is_left_to_it(far: SteppedFeetech, leader: FeetechLeader) -> None:
    lock = DeviceLock(f"feetech-{os.path.realpath(far.arm.port)}", "the servo bus", 0.1)
    with patch.object(bus, "_PATIENCE", 0.0):
        assert not poll(leader).connected
    assert "in use" in leader.describe()
    lock.release()
    assert leader.poll(monotonic() + 1.0, 0.0).connected


def test_an_emulated_leader_may_not_lead_a_real_arm(leader: FeetechLeader) -> None:
    assert "no person holds it" in str(Leader(leader).distrust())


def test_the_hand_moves_motors_without_torque_only(far: SteppedFeetech) -> None:
    far.execute("register 1 40 1")
    with pytest.raises(ValueError, match="have torque"):
        far.execute("hand 1 0 0 0 0 0")
    far.execute("register 1 40 0")
    far.execute("hand 0.2 0 0 0 0 0")
    far.execute("hand 0.2 0.1 0 0 0 0 0.5")
    far.advance(0.2)
    assert far.arm.plant.q == pytest.approx(np.zeros(5), abs=1e-3)
    far.advance(0.2)
    assert far.arm.plant.q == pytest.approx([0.1, 0, 0, 0, 0], abs=1e-3)
