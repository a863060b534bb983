"""The state of a gripper on the pages; it may run in another process than its arm."""

from __future__ import annotations

import pytest

from hal.driver import GripperReading, Reading
from hal.drivers.web.telemetry import Telemetry
from hal.host.records import GroupMemory, ServoRecord
from hal.types import Limited, RobotStatus, Trip

ARM = {"name": "arm", "rate_hz": 240.0, "joints": [["arm", 3]], "grippers": [], "gripper_of": {"arm": "arm.gripper"}}
HAND = {"name": "arm.gripper", "rate_hz": 100.0, "joints": [], "grippers": ["arm.gripper"], "gripper_of": {}}


def test_a_gripper_of_another_process_is_shown_with_its_arm_until_it_is_silent() -> None:
    memories = [
        memoryview(bytearray(GroupMemory.size([("arm", 3)]))),
        memoryview(bytearray(GroupMemory.size([], ["arm.gripper"]))),
    ]
    arm = GroupMemory(memories[0], [("arm", 3)]).robots["arm"]
    hand = GroupMemory(memories[1], [], ["arm.gripper"]).grippers["arm.gripper"]
    telemetry = Telemetry([ARM, HAND], memories)

    def gripper(now: float) -> object:
        zero = (0.0, 0.0, 0.0)
        servo = ServoRecord(RobotStatus.IDLE, Trip.NONE, Limited.NONE, 0, 0, False, 0, now, now, zero, zero)
        tcp = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        arm.put_state(Reading(now, now, 1, zero, zero), servo, tcp, tcp, (0.0,) * 6)
        return telemetry.snapshot(now)["robots"]["arm"]["gripper"]

    assert gripper(1.0) is None
    hand.put(GripperReading(1.0, 1.0, 1, 0.03, 0.0, False, True))
    shown = {"width": 0.03, "width_target": 0.0, "moving": False, "grasped": True}
    assert gripper(1.1) == shown
    assert gripper(1.4) == shown
    assert gripper(1.6) is None


@pytest.mark.parametrize("order", [1, -1])
def test_the_order_of_the_processes_does_not_matter(order: int) -> None:
    memories = [memoryview(bytearray(GroupMemory.size([("arm", 3)], ["arm.gripper"]))) for _ in range(2)]
    telemetry = Telemetry([ARM, HAND][::order], memories)
    assert set(telemetry.snapshot(0.0)["hosts"]) == {"arm", "arm.gripper"}
