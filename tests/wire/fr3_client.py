"""Scenarios of an FR3's client: pylibfranka as it comes, and plain trajectories. One per process; prints a report.

python fr3_client.py SCENARIO HOST '{"argument": value}'
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import pylibfranka as franka

from hal.drivers.franka.emulator.control import EmulatorControl
from hal.drivers.franka.flags import FLAGS

Report = dict[str, Any]


KINDS = {"position": franka.JointPositions, "velocity": franka.JointVelocities, "torque": franka.Torques}


def connect(host: str) -> franka.Robot:
    return franka.Robot(host, franka.RealtimeConfig.kIgnore)


def raised(errors: franka.Errors) -> list[str]:
    """Names of the flags that are up."""
    return [name for name in FLAGS if getattr(errors, name)]


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


def cosine(t: float, duration: float, way: float) -> tuple[float, float]:
    """Distance and speed on a way that begins and ends at rest."""
    if t >= duration:
        return way, 0.0
    phase = math.pi * t / duration
    return way * (1.0 - math.cos(phase)) / 2.0, way * math.pi / duration * math.sin(phase) / 2.0


def move(
    robot: franka.Robot,
    kind: str = "position",
    duration: float = 0.5,
    way: float = 0.1,
    at: float = 0.25,
    disturb: Callable[[list[float]], None] | None = None,
) -> Report:
    """Move joints 1 and 4; ``disturb`` is called once at time ``at`` with the values that are about to be sent."""
    start = {
        "position": lambda: robot.start_joint_position_control(franka.ControllerMode.JointImpedance),
        "velocity": lambda: robot.start_joint_velocity_control(franka.ControllerMode.JointImpedance),
        "torque": robot.start_torque_control,
    }[kind]
    control = start()
    t, cycles, error, states = 0.0, 0, "", hashlib.sha256()
    q0: list[float] = []
    state = None
    began = time.monotonic()
    try:
        while True:
            state, step = control.readOnce()
            q0 = q0 or list(state.q_d)
            t += step.to_sec()
            cycles += 1
            states.update(fingerprint(state, step))
            distance, speed = cosine(t, duration, way)
            moved = [distance if k in (0, 3) else 0.0 for k in range(7)]
            if kind == "position":
                values = [a + b for a, b in zip(q0, moved, strict=True)]
            elif kind == "velocity":
                values = [speed if k in (0, 3) else 0.0 for k in range(7)]
            else:
                values = [2.0 * math.sin(math.pi * min(t / duration, 1.0)), *[0.0] * 6]
            if disturb is not None and t >= at:
                disturb(values)
                disturb = None
            command = KINDS[kind](values)
            if t >= duration:
                command.motion_finished = True
                control.writeOnce(command)
                break
            control.writeOnce(command)
    except Exception as problem:
        error = f"{type(problem).__name__}: {problem}"
    blocked = time.monotonic() - began
    del control
    return {
        "error": error,
        "t": t,
        "cycles": cycles,
        "wall": blocked,
        "rate": state.control_command_success_rate if state is not None else None,
        "states": states.hexdigest(),
        "q0": q0,
    }


def after(robot: franka.Robot) -> Report:
    """What the robot says afterwards."""
    state = robot.read_once()
    return {
        "mode": str(state.robot_mode).split(".")[-1],
        "q": list(state.q),
        "q_d": list(state.q_d),
        "errors": raised(state.current_errors),
        "last_errors": raised(state.last_motion_errors),
    }


def read(host: str) -> Report:
    robot = connect(host)
    state = robot.read_once()
    model = robot.load_model()
    return {
        **after(robot),
        "O_T_EE": list(state.O_T_EE),
        "F_T_EE": list(state.F_T_EE),
        "NE_T_EE": list(state.NE_T_EE),
        "m_ee": state.m_ee,
        "tau": list(state.tau_J),
        "gravity": list(model.gravity(state)),
        "elbow": list(state.elbow),
        "seconds": state.time.to_sec(),
        "next": robot.read_once().time.to_sec(),
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


def smooth(host: str, share: float, anchored: bool, jerk: float, duration: float = 3.0) -> Report:
    """Back and forth within limits of its own, while commands get lost; anchored: goes on from what the robot took."""
    import ruckig

    robot = connect(host)
    online = ruckig.Ruckig(7, 0.001)
    given, made = ruckig.InputParameter(7), ruckig.OutputParameter(7)
    given.max_velocity, given.max_acceleration, given.max_jerk = [1.0] * 7, [6.0] * 7, [jerk] * 7
    control = robot.start_joint_position_control(franka.ControllerMode.JointImpedance)
    state, _ = control.readOnce()
    home = list(state.q_d)
    given.current_position, given.current_velocity, given.current_acceleration = home, [0.0] * 7, [0.0] * 7
    anchors, cycles, error = 0, 0, ""
    with EmulatorControl(host) as faults:
        faults.send("lose-commands", share)
    try:
        while True:
            side = 0.2 if cycles // 300 % 2 == 0 and cycles < 1000 * duration else 0.0
            given.target_position = [home[0] + side, *home[1:]]
            outcome = online.update(given, made)
            made.pass_to_input(given)
            sent = list(made.new_position)
            command = franka.JointPositions(sent)
            if cycles >= 1000 * duration and outcome == ruckig.Result.Finished:
                command.motion_finished = True
                control.writeOnce(command)
                break
            control.writeOnce(command)
            state, _ = control.readOnce()
            cycles += 1
            if anchored and max(abs(a - b) for a, b in zip(state.q_d, sent, strict=True)) > 4e-7:
                anchors += 1
                given.current_position, given.current_velocity = list(state.q_d), list(state.dq_d)
                given.current_acceleration = [max(-6.0, min(6.0, value)) for value in state.ddq_d]
    except Exception as problem:
        error = f"{type(problem).__name__}: {problem}"
    del control
    return {"error": error, "cycles": cycles, "anchors": anchors, **after(robot)}


def jump(host: str, by: float = 0.05, **arguments: Any) -> Report:
    """A position that is off by so much, rad."""
    robot = connect(host)

    def disturb(values: list[float]) -> None:
        values[0] += by

    return {**move(robot, disturb=disturb, **arguments), **after(robot)}


def dropped(host: str) -> Report:
    """The handle of a running motion goes out of scope."""
    robot = connect(host)

    def leave(values: list[float]) -> None:
        raise KeyError("gone")

    report = move(robot, disturb=leave)
    wait_mode(robot, franka.RobotMode.Idle)
    return {"first": report["error"], **move(robot), **after(robot)}


def recovery(host: str, flag: str) -> Report:
    """A reflex, a motion that is refused, recovery, a motion."""
    robot = connect(host)
    with EmulatorControl(host) as control:
        first = move(robot, disturb=lambda values: control.send("reflex", flag) and None)
    told = after(robot)
    refused = attempt(lambda: move(robot))
    recovered = attempt(robot.automatic_error_recovery)
    if recovered:
        return {"first": first["error"], "told": told, "refused": refused, "recovered": recovered, **after(robot)}
    wait_mode(robot, franka.RobotMode.Idle)
    again = {**move(robot), **after(robot)}
    return {"first": first["error"], "told": told, "refused": refused, "recovered": recovered, **again}


def all_flags(host: str) -> Report:
    """What the client names each flag that the robot raises."""
    robot = connect(host)
    names = []
    with EmulatorControl(host) as control:
        for index in range(len(FLAGS)):
            control.send("reflex", index)
            wait_mode(robot, franka.RobotMode.Reflex)
            state = robot.read_once()
            names.append((raised(state.current_errors), raised(state.last_motion_errors)))
            control.send("guiding on")
            control.send("guiding off")
            robot.automatic_error_recovery()
            wait_mode(robot, franka.RobotMode.Idle)
    return {"names": names}


def stops(host: str, button: str) -> Report:
    """A stop is pressed in a motion; what is possible while it is pressed, and after."""
    robot = connect(host)
    with EmulatorControl(host) as control:
        first = move(robot, disturb=lambda values: control.send(button, "on") and None)
        told = after(robot)
        refused = attempt(lambda: move(robot))
        recovery = attempt(robot.automatic_error_recovery)
        control.send(button, "off")
    wait_mode(robot, franka.RobotMode.Idle)
    again = {**move(robot), **after(robot)}
    return {"first": first["error"], "told": told, "refused": refused, "recovery": recovery, **again}


def setters(host: str) -> Report:
    robot = connect(host)
    before = list(robot.read_once().O_T_EE)
    identity = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    good = [
        lambda: robot.set_collision_behavior([20.0] * 7, [21.0] * 7, [22.0] * 6, [23.0] * 6),
        lambda: robot.set_joint_impedance([3000.0] * 4 + [2500.0, 2500.0, 2000.0]),
        lambda: robot.set_cartesian_impedance([100.0] * 3 + [10.0] * 3),
        lambda: robot.set_EE([*identity[:12], 0.0, 0.0, 0.1, 1.0]),
        lambda: robot.set_K([*identity[:12], 0.0, 0.0, 0.02, 1.0]),
        lambda: robot.set_load(0.5, [0.0, 0.0, 0.05], [0.001, 0, 0, 0, 0.001, 0, 0, 0, 0.001]),
    ]
    bad = [
        lambda: robot.set_collision_behavior([-1.0] * 7, [21.0] * 7, [22.0] * 6, [23.0] * 6),
        lambda: robot.set_collision_behavior([30.0] * 7, [21.0] * 7, [22.0] * 6, [23.0] * 6),
        lambda: robot.set_joint_impedance([20000.0] * 7),
        lambda: robot.set_cartesian_impedance([1.0] * 6),
        lambda: robot.set_load(-0.5, [0.0, 0.0, 0.05], [0.001, 0, 0, 0, 0.001, 0, 0, 0, 0.001]),
        lambda: robot.set_load(0.5, [0.0, 0.0, math.nan], [0.001, 0, 0, 0, 0.001, 0, 0, 0, 0.001]),
    ]
    report: Report = {"good": [attempt(action) for action in good], "bad": [attempt(action) for action in bad]}
    robot.read_once()
    state = robot.read_once()
    moved = {"before": before, "after": list(state.O_T_EE)}
    return {**report, **moved, "m_load": state.m_load, "EE_T_K": list(state.EE_T_K)}


def cartesian(host: str) -> Report:
    robot = connect(host)
    text = attempt(lambda: robot.start_cartesian_pose_control(franka.ControllerMode.JointImpedance))
    return {"error": text, **after(robot)}


def asynchronous(host: str) -> Report:
    """The library's handler of targets that come at 50 Hz."""
    robot = connect(host)
    handler = franka.AsyncPositionControlHandler
    configuration = handler.Configuration(maximum_joint_velocities=[0.6] * 7, goal_tolerance=0.01)
    made = handler.configure(robot, configuration)
    goal = list(robot.read_once().q)
    goal[3] += 0.1
    errors = [made.error_message]
    began = time.monotonic()
    while time.monotonic() - began < 0.8:
        errors.append(made.handler.get_target_feedback().error_message)
        target = handler.JointPositionTarget(joint_positions=goal)
        errors.append(made.handler.set_joint_position_target(target).error_message)
        time.sleep(0.02)
    made.handler.stop_control()
    wait_mode(robot, franka.RobotMode.Idle)
    return {"errors": [text for text in errors if text], "goal": goal, **after(robot)}


def refused(host: str) -> Report:
    """A connection that does not come about."""
    return {"error": attempt(lambda: connect(host))}


def second(host: str) -> Report:
    """A second client, while one is connected, and afterwards."""
    robot = connect(host)
    text = attempt(lambda: connect(host))
    still = after(robot)["mode"]
    del robot
    return {"error": text, "first": still, "then": attempt(lambda: connect(host).read_once())}


def comeback(host: str, away: float) -> Report:
    """The robot is restarted in a motion; the old object is dead, a new one works."""
    robot = connect(host)
    with EmulatorControl(host) as control:
        first = move(robot, duration=2.0, disturb=lambda values: control.send("restart", away) and None)
    dead = attempt(robot.read_once)
    attempts = 0
    while True:
        attempts += 1
        try:
            fresh = connect(host)
            break
        except franka.FrankaException:
            if attempts > 100:
                raise
            time.sleep(0.05)
    return {"first": first["error"], "dead": dead, **move(fresh), **after(fresh)}


def unanswered(host: str) -> Report:
    """The end of the motion is never told: the library waits for ever."""
    robot = connect(host)
    with EmulatorControl(host) as control:
        control.send("no-move-reply on")
    return move(robot, duration=0.05, at=1.0)


def slow(host: str, seconds: float) -> Report:
    """How long a setter takes."""
    robot = connect(host)
    with EmulatorControl(host) as control:
        control.send("slow-reply", seconds)
    began = time.monotonic()
    robot.set_joint_impedance([3000.0] * 7)
    return {"seconds": time.monotonic() - began}


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
