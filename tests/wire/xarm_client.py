"""A program of its own with the unmodified xarm-python-sdk, as its users write it: python xarm_client.py HOST."""

from __future__ import annotations

import json
import os
import sys
import time

from xarm.wrapper import XArmAPI

arm, done = XArmAPI(sys.argv[1], is_radian=True), {}
done["arm"] = [arm.axis, arm.version_number]
done["not enabled"] = arm.set_servo_angle_j([0.0] * 7)


def start(mode: int) -> list[int]:
    return [arm.motion_enable(True), arm.set_mode(mode), arm.set_state(0), arm.get_state()[1]]


done["start"] = start(0)
q = list(arm.get_servo_angle()[1])
goal = [*q[:6], q[6] + 0.4]
done["move"] = [arm.set_servo_angle(angle=goal, speed=1.0, mvacc=5.0, wait=True)]
time.sleep(0.2)
done["moved"] = [b - a for a, b in zip(q, arm.get_servo_angle()[1], strict=True)]
done["wrong mode"] = arm.set_servo_angle_j(goal)
done["servo"] = start(1)
for k in range(200):
    arm.set_servo_angle_j([*goal[:5], goal[5] + 0.1 * (k + 1) / 200, goal[6]])
    time.sleep(0.004)
time.sleep(0.2)
done["streamed"] = [b - a for a, b in zip(goal, arm.get_servo_angle()[1], strict=True)]
goal = list(arm.get_servo_angle()[1])
jump = [goal[0] + 0.5, *goal[1:]]  # 0.5 rad away is no path
done["jump"] = [arm.set_servo_angle_j(jump), arm.get_err_warn_code()[1][0], arm.get_state()[1]]
time.sleep(0.3)
done["still"] = arm.get_servo_angle()[1][0] - goal[0]
done["clean"] = [arm.clean_error(), arm.get_err_warn_code()[1][0], *start(1), arm.set_servo_angle_j(goal)]
time.sleep(0.5)  # a report of port 30002
done["report"] = [arm.mode, arm.error_code, arm.motor_enable_states[:7]]
done["load"] = arm.set_tcp_load(0.8, [0, 0, 50])
done["gripper"] = [arm.set_gripper_position(400, wait=True, speed=5000, auto_enable=True), *arm.get_gripper_position()]
done["gripper"] += [arm.get_gripper_err_code()[1], arm.get_gripper_version()[1]]
arm.disconnect()
print(json.dumps(done), flush=True)
os._exit(0)
