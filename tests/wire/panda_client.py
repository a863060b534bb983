"""Scenarios of a Panda's client: ``panda_py.libfranka`` as it comes, and plain trajectories. One per process.

python panda_client.py SCENARIO HOST '{"argument": value}'
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

from panda_py import libfranka as franka

from hal.drivers.franka.emulator.control import EmulatorControl
from hal.drivers.franka.flags import FLAGS

Report = dict[str, Any]
NAMED = FLAGS[:37]
"""This library knows no more."""


def connect(host: str) -> franka.Robot:
    return franka.Robot(host, franka.RealtimeConfig.kIgnore)


def raised(errors: franka.Errors) -> list[str]:
    """Names of the flags that are up."""
    return [name for name in NAMED if getattr(errors, name)]


def wait_mode(robot: franka.Robot, mode: franka.RobotMode) -> None:
    """Read until the robot is in that mode."""
    for _ in range(500):
        if robot.read_once().robot_mode == mode:
            return
    raise TimeoutError(f"the mode is {robot.read_once().robot_mode}")


def attempt(action: Callable[[], object]) -> str:
    """The text of the exception, or nothing."""
    try:
        action()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def fingerprint(state: franka.RobotState, step: franka.Duration) -> bytes:
    """What two runs must have in common to the last bit."""
    return repr((step.to_sec(), list(state.q), list(state.q_d), list(state.dq_d), list(state.tau_J))).encode()


def move(
    robot: franka.Robot,
    kind: str = "position",
    duration: float = 0.5,
    way: float = 0.1,
    at: float = 0.25,
    disturb: Callable[[list[float]], None] | None = None,
) -> Report:
    """Move joints 1 and 4 out of a callback; the library neither limits nor filters."""
    t, cycles = 0.0, 0
    q0: list[float] = []
    states = hashlib.sha256()

    def callback(state: franka.RobotState, step: franka.Duration) -> Any:
        nonlocal t, cycles, q0, disturb
        q0 = q0 or list(state.q_d)
        t += step.to_sec()
        cycles += 1
        states.update(fingerprint(state, step))
        phase = math.pi * min(t / duration, 1.0)
        if kind == "position":
            values = [a + (way * (1.0 - math.cos(phase)) / 2.0 if k in (0, 3) else 0.0) for k, a in enumerate(q0)]
        elif kind == "velocity":
            values = [way * math.pi / duration * math.sin(phase) / 2.0 if k in (0, 3) else 0.0 for k in range(7)]
        else:
            values = [2.0 * math.sin(phase), *[0.0] * 6]
        if disturb is not None and t >= at:
            disturb(values)
            disturb = None
        kinds = {"position": franka.JointPositions, "velocity": franka.JointVelocities, "torque": franka.Torques}
        command = kinds[kind](values)
        command.motion_finished = t >= duration
        return command

    began = time.monotonic()
    impedance = franka.ControllerMode.kJointImpedance
    run = {
        "position": lambda: robot.control_joint_position(callback, impedance, False, 1000.0),
        "velocity": lambda: robot.control_joint_velocity(callback, impedance, False, 1000.0),
        "torque": lambda: robot.control(callback, False, 1000.0),
    }[kind]
    error = attempt(run)
    return {
        "error": error,
        "t": t,
        "cycles": cycles,
        "wall": time.monotonic() - began,
        "states": states.hexdigest(),
        "q0": q0,
    }


def after(robot: franka.Robot) -> Report:
    """What the robot says afterwards."""
    state = robot.read_once()
    return {
        "mode": str(state.robot_mode).split(".k")[-1],
        "q": list(state.q),
        "q_d": list(state.q_d),
        "errors": raised(state.current_errors),
        "last_errors": raised(state.last_motion_errors),
    }


def read(host: str) -> Report:
    robot = connect(host)
    state = robot.read_once()
    return {
        **after(robot),
        "version": robot.server_version(),
        "O_T_EE": list(state.O_T_EE),
        "F_T_EE": list(state.F_T_EE),
        "tau": list(state.tau_J),
        "m_ee": state.m_ee,
        "model": attempt(robot.load_model),
    }


def motion(host: str, times: int = 1, commands: list[str] | None = None, **arguments: Any) -> Report:
    """One motion or several, in the middle of which fault commands are given."""
    robot = connect(host)
    with EmulatorControl(host) as control:

        def disturb(values: list[float]) -> None:
            for command in commands or []:
                control.send(command)

        runs = [move(robot, disturb=disturb, **arguments) for _ in range(times)]
    return {"runs": runs, **runs[-1], **after(robot)} if "Timeout" not in runs[-1]["error"] else runs[-1]


def jump(host: str, by: float = 0.05, **arguments: Any) -> Report:
    """A position that is off by so much, rad."""
    robot = connect(host)

    def disturb(values: list[float]) -> None:
        values[0] += by

    return {**move(robot, disturb=disturb, **arguments), **after(robot)}


def thrown(host: str) -> Report:
    """The callback raises: the library cancels the motion. Then another one."""
    robot = connect(host)

    def leave(values: list[float]) -> None:
        raise KeyError("gone")

    first = move(robot, disturb=leave)
    wait_mode(robot, franka.RobotMode.kIdle)
    return {"first": first["error"], **move(robot), **after(robot)}


def recovery(host: str, flag: str) -> Report:
    """A reflex, a motion that is refused, recovery, a motion."""
    robot = connect(host)
    with EmulatorControl(host) as control:
        first = move(robot, disturb=lambda values: control.send("reflex", flag) and None)
    told = after(robot)
    refused = move(robot)["error"]
    recovered = attempt(robot.automatic_error_recovery)
    wait_mode(robot, franka.RobotMode.kIdle)
    again = {**move(robot), **after(robot)}
    return {"first": first["error"], "told": told, "refused": refused, "recovered": recovered, **again}


def all_flags(host: str) -> Report:
    """What the client names each flag that the robot raises."""
    robot = connect(host)
    names = []
    with EmulatorControl(host) as control:
        for index in range(len(FLAGS)):
            control.send("reflex", index)
            wait_mode(robot, franka.RobotMode.kReflex)
            state = robot.read_once()
            names.append((raised(state.current_errors), raised(state.last_motion_errors)))
            control.send("guiding on")
            control.send("guiding off")
            robot.automatic_error_recovery()
            wait_mode(robot, franka.RobotMode.kIdle)
    return {"names": names}


def setters(host: str) -> Report:
    robot = connect(host)
    identity = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    good = [
        lambda: robot.set_collision_behavior([20.0] * 7, [20.0] * 7, [20.0] * 6, [20.0] * 6),
        lambda: robot.set_joint_impedance([3000.0] * 4 + [2500.0, 2500.0, 2000.0]),
        lambda: robot.set_ee([*identity[:12], 0.0, 0.0, 0.1, 1.0]),
        lambda: robot.set_load(0.5, [0.0, 0.0, 0.05], [0.001, 0, 0, 0, 0.001, 0, 0, 0, 0.001]),
    ]
    bad = [
        lambda: robot.set_joint_impedance([20000.0] * 7),
        lambda: robot.set_load(-0.5, [0.0, 0.0, 0.05], [0.001, 0, 0, 0, 0.001, 0, 0, 0, 0.001]),
    ]
    report: Report = {"good": [attempt(action) for action in good], "bad": [attempt(action) for action in bad]}
    robot.read_once()
    return {**report, "m_load": robot.read_once().m_load}


def refused(host: str) -> Report:
    """A connection that does not come about."""
    return {"error": attempt(lambda: connect(host))}


def truncated(host: str) -> Report:
    robot = connect(host)
    with EmulatorControl(host) as control:
        control.send("truncate on")
        texts = [attempt(robot.read_once) for _ in range(20)]
    return {"error": next((text for text in texts if text), "")}


def main() -> None:
    scenario, host, arguments = sys.argv[1:]
    report = globals()[scenario](host, **json.loads(arguments))
    print(json.dumps(report), flush=True)


if __name__ == "__main__":
    main()
