"""Uses a robot through a vendor's library, and prints what that raises, and the fault that it stands for.

``python library_client.py '{"library": "pylibfranka", "host": ..., "tries": {"name": "move", ...}}'``: one connection
per try, in that order.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

from hal.drivers.franka.faults import fault_of_exception, is_connection_lost


def fr3(host: str, action: str) -> None:
    import pylibfranka

    robot = pylibfranka.Robot(host, pylibfranka.RealtimeConfig.kIgnore)
    if action == "recover":
        robot.automatic_error_recovery()
    elif action == "set":
        robot.set_joint_impedance([1000.0] * 7)
    elif action in ("move", "nan", "twice"):
        control = robot.start_joint_position_control(pylibfranka.ControllerMode.JointImpedance)
        if action == "twice":
            robot.start_joint_position_control(pylibfranka.ControllerMode.JointImpedance)
        while True:
            state = control.readOnce()[0]
            control.writeOnce(pylibfranka.JointPositions([float("nan")] * 7 if action == "nan" else state.q_d))


def panda(host: str, action: str) -> None:
    from panda_py import libfranka

    robot = libfranka.Robot(host, libfranka.RealtimeConfig.kIgnore)
    if action == "recover":
        robot.automatic_error_recovery()
    elif action == "set":
        robot.set_joint_impedance([1000.0] * 7)
    elif action in ("move", "nan"):
        robot.control_joint_position(
            lambda state, _: libfranka.JointPositions([float("nan")] * 7 if action == "nan" else list(state.q_d))
        )


LIBRARIES: dict[str, Callable[[str, str], None]] = {"pylibfranka": fr3, "panda_py": panda}


def main() -> None:
    options = json.loads(sys.argv[1])
    for name, action in options["tries"].items():
        told: dict[str, Any] = {"name": name, "raised": None}
        try:
            LIBRARIES[options["library"]](options["host"], action)
        except Exception as error:
            fault = fault_of_exception(error, host=options["host"])
            told |= {
                "raised": type(error).__name__,
                "text": str(error),
                "fault": [fault.code, fault.cause, fault.remedy],
                "lost": is_connection_lost(error),
            }
        print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
