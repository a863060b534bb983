"""The vendor's piper_sdk, unmodified, on a bus of this computer: enable the arm, move six joints, read them back.

``python piper_client.py CHANNEL``: prints a line "ready" when the arm stands at its targets, with what was read, and
when a line comes on its standard input, how long the SDK took to notice that nothing is sent any more.
"""

import json
import sys
import time
from typing import Any

from piper_sdk import C_PiperInterface_V2

TARGETS = (12_345, 45_678, -67_891, 23_456, -34_567, 98_765)
"""Targets of the joints, 0.001 degrees."""
_PATIENCE = 10.0


def wait(condition: Any) -> float:
    """Wait until a condition holds, and return how long it took, s."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > _PATIENCE:
            raise TimeoutError(condition.__name__)
        time.sleep(0.005)
    return time.monotonic() - began


def main(channel: str) -> None:
    """Run the client."""
    piper = C_PiperInterface_V2(channel, judge_flag=False, can_auto_init=False)
    piper.CreateCanBus(channel, bustype="udp_multicast", judge_flag=False)
    piper.ConnectPort()

    def joints() -> list[int]:
        state = piper.GetArmJointMsgs().joint_state
        return [getattr(state, f"joint_{k}") for k in range(1, 7)]

    def at_targets() -> bool:
        piper.MotionCtrl_2(0x01, 0x01, 100, 0x00)
        piper.JointCtrl(*TARGETS)
        return max(abs(a - b) for a, b in zip(joints(), TARGETS, strict=True)) <= 1

    def gripper_there() -> bool:
        piper.GripperCtrl(30_000, 1000, 0x01, 0)
        return abs(piper.GetArmGripperMsgs().gripper_state.grippers_angle - 30_000) <= 10

    def settled() -> bool:
        status = piper.GetArmStatus().arm_status
        return int(status.motion_status) == 0 and int(status.ctrl_mode) == 1

    def firmware_known() -> bool:
        if isinstance(piper.GetPiperFirmwareVersion(), str):  # a number while the answer is not complete
            return True
        piper.SearchPiperFirmwareVersion()
        time.sleep(0.1)  # a new question discards what came of the last answer
        return False

    wait(lambda: any(joints()))
    report: dict[str, Any] = {"enabled_s": wait(piper.EnablePiper)}
    report["moved_s"] = wait(at_targets)
    report["gripper_s"] = wait(gripper_there)
    wait(settled)
    time.sleep(0.2)
    report["joints"] = joints()
    report["arm_status"] = int(piper.GetArmStatus().arm_status.arm_status)
    wait(firmware_known)
    report["firmware"] = piper.GetPiperFirmwareVersion()
    report["ok"] = piper.isOk()
    print("ready " + json.dumps(report), flush=True)
    sys.stdin.readline()
    print("lost " + json.dumps({"seconds": wait(lambda: not piper.isOk())}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
