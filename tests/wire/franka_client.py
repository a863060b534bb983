"""Scenarios of a client of a Franka: the vendor's library as it comes, and plain trajectories. One per process.

python franka_client.py pylibfranka|panda_py SCENARIO HOST '{"argument": value}'      # prints a report
"""

from __future__ import annotations

import hashlib
import importlib
import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

from hal.drivers.franka.flags import FLAGS
from hal_emulators.control import EmulatorControl

Report = dict[str, Any]
IDENTITY = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
INERTIA = [0.001, 0, 0, 0, 0.001, 0, 0, 0, 0.001]

LIBRARY = sys.argv[1]
IS_FR3 = LIBRARY == "pylibfranka"
franka = importlib.import_module("pylibfranka" if IS_FR3 else "panda_py.libfranka")
NAMED = FLAGS if IS_FR3 else FLAGS[:37]
"""Flags that the library has a name for."""


def member(enum: Any, name: str) -> Any:
    """Return a member of an enum of the library: panda_py puts a k before the names."""
    return getattr(enum, name if IS_FR3 else f"k{name}")


IMPEDANCE = member(franka.ControllerMode, "JointImpedance")
COMMANDS = {"position": franka.JointPositions, "velocity": franka.JointVelocities, "torque": franka.Torques}


def connect(host: str) -> Any:
    return franka.Robot(host, franka.RealtimeConfig.kIgnore)


def raised(errors: Any) -> list[str]:
    """Return the names of the flags that are up."""
    return [name for name in NAMED if getattr(errors, name)]


def wait_mode(robot: Any, name: str) -> None:
    """Read until the robot is in that mode."""
    mode = member(franka.RobotMode, name)
    for _ in range(500):
        if robot.read_once().robot_mode == mode:
            return
    raise TimeoutError(f"the mode is {robot.read_once().robot_mode}")


def attempt(action: Callable[[], object]) -> str:
    """Return the text of the exception, or nothing."""
    try:
        action()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


class Trajectory:
    """A motion of joints 1 and 4 that begins and ends at rest; ``disturb`` gets the values at time ``at``, once."""

    def __init__(
        self,
        kind: str = "position",
        duration: float = 0.5,
        way: float = 0.1,
        at: float = 0.25,
        disturb: Callable[[list[float]], object] | None = None,
    ) -> None:
        self.kind, self.duration, self.way, self.at, self.disturb = kind, duration, way, at, disturb
        self.t, self.cycles = 0.0, 0
        self.q0: list[float] = []
        self.states = hashlib.sha256()
        """Of everything that two runs must have in common to the last bit."""
        self.rate: float | None = None

    def command(self, state: Any, step: Any) -> Any:
        self.q0 = self.q0 or list(state.q_d)
        self.rate = state.control_command_success_rate
        self.t += step.to_sec()
        self.cycles += 1
        seen = (step.to_sec(), list(state.q), list(state.q_d), list(state.dq_d), list(state.tau_J))
        self.states.update(repr(seen).encode())
        phase = math.pi * min(self.t / self.duration, 1.0)
        if self.kind == "position":
            distance = self.way * (1.0 - math.cos(phase)) / 2.0
            values = [q + (distance if k in (0, 3) else 0.0) for k, q in enumerate(self.q0)]
        elif self.kind == "velocity":
            speed = self.way * math.pi / self.duration * math.sin(phase) / 2.0
            values = [speed if k in (0, 3) else 0.0 for k in range(7)]
        else:
            values = [2.0 * math.sin(phase), *[0.0] * 6]
        if self.disturb is not None and self.t >= self.at:
            disturb, self.disturb = self.disturb, None
            disturb(values)
        command = COMMANDS[self.kind](values)
        command.motion_finished = self.t >= self.duration
        return command


def run_handle(robot: Any, trajectory: Trajectory) -> None:
    """Move as pylibfranka does: read and write in turn."""
    control = {
        "position": lambda: robot.start_joint_position_control(IMPEDANCE),
        "velocity": lambda: robot.start_joint_velocity_control(IMPEDANCE),
        "torque": robot.start_torque_control,
    }[trajectory.kind]()
    while True:
        command = trajectory.command(*control.readOnce())
        control.writeOnce(command)
        if command.motion_finished:
            return


def run_callback(robot: Any, trajectory: Trajectory) -> None:
    """Move as panda_py does: out of a callback. The library neither limits nor filters."""
    if trajectory.kind == "torque":
        robot.control(trajectory.command, False, 1000.0)
    else:
        control = getattr(robot, f"control_joint_{trajectory.kind}")
        control(trajectory.command, IMPEDANCE, False, 1000.0)


def move(robot: Any, **options: Any) -> Report:
    """Run a trajectory to its end or its error."""
    trajectory = Trajectory(**options)
    began = time.monotonic()
    error = attempt(lambda: (run_handle if IS_FR3 else run_callback)(robot, trajectory))
    return {
        "error": error,
        "t": trajectory.t,
        "cycles": trajectory.cycles,
        "wall": time.monotonic() - began,
        "rate": trajectory.rate,
        "states": trajectory.states.hexdigest(),
        "q0": trajectory.q0,
    }


def after(robot: Any) -> Report:
    """Return what the robot reports afterwards."""
    state = robot.read_once()
    return {
        "mode": str(state.robot_mode).split(".")[-1].removeprefix("k"),
        "q": list(state.q),
        "q_d": list(state.q_d),
        "errors": raised(state.current_errors),
        "last_errors": raised(state.last_motion_errors),
    }


# Scenarios with both libraries.


def read(host: str) -> Report:
    robot = connect(host)
    state = robot.read_once()
    report = {
        **after(robot),
        "O_T_EE": list(state.O_T_EE),
        "F_T_EE": list(state.F_T_EE),
        "m_ee": state.m_ee,
        "tau": list(state.tau_J),
        "elbow": list(state.elbow),
        "seconds": state.time.to_sec(),
        "next": robot.read_once().time.to_sec(),
    }
    if not IS_FR3:
        report["version"] = robot.server_version()
    return {**report, "gravity": list(robot.load_model().gravity(state))}


def panda_py_panda(host: str) -> Report:
    """Use the class that examples of panda_py begin with: its model, and a motion with a controller that needs it."""
    panda_py, controllers = importlib.import_module("panda_py"), importlib.import_module("panda_py.controllers")
    panda = panda_py.Panda(host)
    state, model = panda.get_state(), panda.get_model()
    report: Report = {"O_T_EE": list(state.O_T_EE), "pose": list(model.pose(franka.Frame.kEndEffector, state))}
    report["moved"] = panda.move_to_joint_position(panda.q + 0.1)
    report["q"] = panda.q.tolist()
    start = panda.get_position()
    controller = controllers.CartesianImpedance(filter_coeff=1.0)
    panda.start_controller(controller)
    controller.set_control(start + [0.0, 0.05, 0.0], panda.get_orientation())
    for _ in range(2000):
        if abs(panda.get_position() - start)[1] > 0.045:
            break
        time.sleep(0.005)
    panda.stop_controller()
    return {**report, "way": (panda.get_position() - start).tolist()}


def motion(host: str, times: int = 1, commands: list[str] | None = None, **arguments: Any) -> Report:
    """Run one motion or several, in the middle of which fault commands are given."""
    robot = connect(host)
    with EmulatorControl(host) as control:

        def disturb(values: list[float]) -> None:
            for command in commands or []:
                control.send(command)

        runs = [move(robot, disturb=disturb, **arguments) for _ in range(times)]
    return {"runs": runs, **runs[-1], **after(robot)} if "Timeout" not in runs[-1]["error"] else runs[-1]


def jump(host: str, by: float = 0.05, **arguments: Any) -> Report:
    """Command a position that is off by so much, rad."""
    robot = connect(host)

    def disturb(values: list[float]) -> None:
        values[0] += by

    return {**move(robot, disturb=disturb, **arguments), **after(robot)}


def cancelled(host: str) -> Report:
    """Drop the handle of a running motion, or raise in its callback; then move again."""
    robot = connect(host)

    def leave(values: list[float]) -> None:
        raise KeyError("gone")

    first = move(robot, disturb=leave)["error"]
    wait_mode(robot, "Idle")
    return {"first": first, **move(robot), **after(robot)}


def recovery(host: str, flag: str) -> Report:
    """Raise a reflex, try a motion, recover, and move."""
    robot = connect(host)
    with EmulatorControl(host) as control:
        first = move(robot, disturb=lambda values: control.send("reflex", flag))
    told = after(robot)
    refused = move(robot)["error"]
    recovered = attempt(robot.automatic_error_recovery)
    report = {"first": first["error"], "told": told, "refused": refused, "recovered": recovered}
    if recovered:
        return {**report, **after(robot)}
    wait_mode(robot, "Idle")
    return {**report, **move(robot), **after(robot)}


def all_flags(host: str) -> Report:
    """Report the client's name of each flag that the robot raises."""
    robot = connect(host)
    names = []
    with EmulatorControl(host) as control:
        for index in range(len(FLAGS)):
            control.send("reflex", index)
            wait_mode(robot, "Reflex")
            state = robot.read_once()
            names.append((raised(state.current_errors), raised(state.last_motion_errors)))
            control.send("guiding on")
            control.send("guiding off")
            robot.automatic_error_recovery()
            wait_mode(robot, "Idle")
    return {"names": names}


def setters(host: str) -> Report:
    """Set good and bad values; panda_py does not have all of them."""
    robot = connect(host)
    before = list(robot.read_once().O_T_EE)
    set_tool = robot.set_EE if IS_FR3 else robot.set_ee
    good = [
        lambda: robot.set_collision_behavior([20.0] * 7, [21.0] * 7, [22.0] * 6, [23.0] * 6),
        lambda: robot.set_joint_impedance([3000.0] * 4 + [2500.0, 2500.0, 2000.0]),
        lambda: set_tool([*IDENTITY[:12], 0.0, 0.0, 0.1, 1.0]),
        lambda: robot.set_load(0.5, [0.0, 0.0, 0.05], INERTIA),
    ]
    bad = [lambda: robot.set_joint_impedance([20000.0] * 7), lambda: robot.set_load(-0.5, [0.0, 0.0, 0.05], INERTIA)]
    if IS_FR3:
        good += [
            lambda: robot.set_cartesian_impedance([100.0] * 3 + [10.0] * 3),
            lambda: robot.set_K([*IDENTITY[:12], 0.0, 0.0, 0.02, 1.0]),
        ]
        bad += [
            lambda: robot.set_collision_behavior([-1.0] * 7, [21.0] * 7, [22.0] * 6, [23.0] * 6),
            lambda: robot.set_collision_behavior([30.0] * 7, [21.0] * 7, [22.0] * 6, [23.0] * 6),
            lambda: robot.set_cartesian_impedance([1.0] * 6),
            lambda: robot.set_load(0.5, [0.0, 0.0, math.nan], INERTIA),
        ]
    report: Report = {"good": [attempt(action) for action in good], "bad": [attempt(action) for action in bad]}
    robot.read_once()
    state = robot.read_once()
    tool = {"before": before, "after": list(state.O_T_EE), "EE_T_K": list(state.EE_T_K)}
    return {**report, **tool, "m_load": state.m_load}


# Scenarios with pylibfranka only.


def cartesian(host: str) -> Report:
    robot = connect(host)
    return {"error": attempt(lambda: robot.start_cartesian_pose_control(IMPEDANCE)), **after(robot)}


if __name__ == "__main__":
    scenario, host, arguments = sys.argv[2:]
    print(json.dumps(globals()[scenario](host, **json.loads(arguments))), flush=True)
