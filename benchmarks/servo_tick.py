"""Time of one servo tick for each kind of command, beside a bare Ruckig update in the same run.

"Answer" is that to a device that extrapolates (a Franka): the set-point was computed after the last write, and is
handed out when the device took the one before. The second table waits for the rest of each millisecond between two
ticks, as a host does: the processor's cold caches are then included. Times differ from machine to machine and from
minute to minute; compare the ratio to the reference, which is measured in turn with them.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from ruckig import ControlInterface, InputParameter, OutputParameter, Ruckig, Synchronization

from hal.commands import NO_INBOX, CommandRecord, Inbox, Kind, Session
from hal.config.data_files import find_data
from hal.driver import Reading
from hal.dynamics import Dynamics
from hal.kinematics.arm import Kinematics
from hal.servo.controllers import Controller, JointImpedance, OperationalSpace, Position, controller_data, resolve
from hal.servo.servo import Servo
from hal.specs import RobotSpec, WorkspaceSpec

from .kit import Table, median
from .servo_streams import PANDA, robot_spec

PATHS = ("hal/servo", "hal/kinematics", "hal/dynamics.py")

RATE_HZ = 1000.0
STILL = [0.0] * 7
Values = Callable[[float, list[float]], list[float]]


def panda() -> RobotSpec:
    """Return a Panda."""
    spec = robot_spec(PANDA, RATE_HZ)
    kinematics = replace(
        spec.kinematics,
        urdf=str(find_data("robots", "panda.urdf")),
        joints=tuple(f"panda_joint{i}" for i in range(1, 8)),
        tcp_link="panda_hand",
        tcp_position=(0.0, 0.0, 0.1034),
    )
    return replace(spec, kinematics=kinematics, limits=replace(spec.limits, torque=(87.0,) * 4 + (12.0,) * 3))


class Bare:
    """Return the reference: a velocity target of seven joints, changed every tick, and the result read back, us."""

    def __init__(self) -> None:
        self.ruckig, self.inputs, self.output = Ruckig(7, 1 / RATE_HZ), InputParameter(7), OutputParameter(7)
        self.inputs.control_interface = ControlInterface.Velocity
        self.inputs.synchronization = Synchronization.No
        self.inputs.max_velocity = list(PANDA.velocity)
        self.inputs.max_acceleration, self.inputs.max_jerk = list(PANDA.acceleration), list(PANDA.jerk)
        self.q = self.dq = self.ddq = STILL

    def tick(self, t: float) -> None:
        inputs = self.inputs
        inputs.current_position, inputs.current_velocity, inputs.current_acceleration = self.q, self.dq, self.ddq
        inputs.target_velocity = [math.sin(t)] * 7
        self.ruckig.update(inputs, self.output)
        output = self.output
        self.q, self.dq, self.ddq = output.new_position, output.new_velocity, output.new_acceleration


def measure(
    spec: RobotSpec,
    kind: Kind | None,
    values: Values,
    tcp_speed: float,
    ticks: int,
    idle: bool,
    controller: Controller,
) -> tuple[float, ...]:
    """Return the median and p99 of a tick, the median of an answer and of the reference, us. No kind: ``move_to``."""
    kinematics = Kinematics(spec.kinematics)
    mass_matrix = Dynamics.of(spec).mass_matrix
    servo = Servo(spec, 1 / RATE_HZ, kinematics, mass_matrix, extrapolates=True)
    servo.anchor(spec.home)
    goal = tuple(x + 0.3 * math.cos(k) for k, x in enumerate(spec.home)) if kind is None else None
    servo.open_session(Session(1, 0.3, tcp_speed, False, goal, controller=controller_data(controller)), NO_INBOX)
    bare = Bare()
    now, q, dq = 10.0, list(spec.home), STILL
    start = list(q)
    inverse = np.linalg.inv(mass_matrix(start))
    command = None
    times, answers, references = [], [], []
    for k in range(ticks):
        due = time.perf_counter() + 1 / RATE_HZ
        now += 1 / RATE_HZ
        t = k / RATE_HZ
        if kind is not None and k % 20 == 0:  # 50 Hz
            command = CommandRecord(k + 1, 1, now, now + 0.1, kind, tuple(values(t, start)))
        reading = Reading(now, now, k, q, dq, None, q, dq)
        inbox = Inbox(command, None, 0, 0, now)
        begun = time.perf_counter_ns()
        answer = servo.answer(now, reading)
        answered = time.perf_counter_ns()
        setpoint = servo.tick(now, reading, inbox)
        ended = time.perf_counter_ns()
        bare.tick(t)
        references.append(time.perf_counter_ns() - ended)
        times.append(ended - answered)
        assert setpoint is not None
        if setpoint.tau is None:
            if answer is not None:
                answers.append(answered - begun)
                dq = [(x - y) * RATE_HZ for x, y in zip(answer.q, q, strict=True)]
                q = list(answer.q)
        else:  # an arm without friction, whose inertia does not change
            dq = [v + a / RATE_HZ for v, a in zip(dq, inverse.dot(setpoint.tau).tolist(), strict=True)]
            q = [x + v / RATE_HZ for x, v in zip(q, dq, strict=True)]
        if idle:
            time.sleep(max(0.0, due - time.perf_counter()))
    if servo.report.trip or max(abs(a - b) for a, b in zip(q, start, strict=True)) < 1e-3:
        raise RuntimeError(f"{kind}: the arm did not move as it should: {servo.report}")
    p99 = sorted(times)[int(0.99 * ticks)]
    return tuple(1e-3 * spent for spent in (median(times), p99, median(answers or [0]), median(references)))


Case = tuple[str, RobotSpec, Kind | None, Values, float, Controller]


def cases() -> list[Case]:
    """Return what is measured: name, arm, kind of command, its values, the limit of the tcp's speed, the controller."""
    free, capped = 1e9, 0.25
    box = WorkspaceSpec((0.1, -0.8, 0.0), (0.9, 0.8, 1.2))

    def sine(t: float, start: list[float]) -> list[float]:
        q = [x + 0.2 * (1 - math.cos(t + k)) - 0.2 * (1 - math.cos(k)) for k, x in enumerate(start)]
        return q + [0.2 * math.sin(t + k) for k in range(7)]

    def held(t: float, start: list[float]) -> list[float]:
        return [x + 0.09 for x in start] + STILL

    def velocity(t: float, start: list[float]) -> list[float]:
        return [0.2 * math.sin(t + k) for k in range(7)]

    def twist(t: float, start: list[float]) -> list[float]:
        return [0.1 * math.cos(t), 0.1 * math.sin(t), -0.05 * math.cos(t), 0.0, 0.0, 0.2 * math.cos(t), 0.0]

    def torque(t: float, start: list[float]) -> list[float]:
        return [(-1.0) ** k * math.cos(5.0 * t) for k in range(7)]

    spec = panda()
    servo = Servo(spec, 1 / RATE_HZ)
    pose = list(servo.kinematics.fk(spec.home))

    def target(t: float, start: list[float]) -> list[float]:
        return [pose[0] + 0.04 * math.sin(t), pose[1] + 0.04 * math.sin(2 * t), *pose[2:]]

    walled = replace(spec, workspace=box)
    arm = Kinematics(spec.kinematics)
    task = resolve(OperationalSpace(), spec, arm, RATE_HZ)
    joints = resolve(JointImpedance(), spec, arm, RATE_HZ)
    plain: list[tuple[str, RobotSpec, Kind | None, Values, float]] = [
        ("joint targets, moving", spec, Kind.JOINT_TARGET, sine, free),
        ("joint targets, held", spec, Kind.JOINT_TARGET, held, free),
        ("joint targets, tcp speed capped", spec, Kind.JOINT_TARGET, sine, capped),
        ("joint targets, capped, workspace", walled, Kind.JOINT_TARGET, sine, capped),
        ("joint velocities, capped", spec, Kind.JOINT_VELOCITY, velocity, capped),
        ("poses", spec, Kind.CARTESIAN_TARGET, target, capped),
        ("twists", spec, Kind.TWIST, twist, capped),
        ("twists, workspace", walled, Kind.TWIST, twist, capped),
        ("torques, capped", spec, Kind.JOINT_TORQUE, torque, capped),
        ("torques, capped, workspace", walled, Kind.JOINT_TORQUE, torque, capped),
        ("move_to", spec, None, held, capped),
    ]
    return [
        *((*case, Position()) for case in plain),
        ("poses, OperationalSpace", walled, Kind.CARTESIAN_TARGET, target, capped, task),
        ("twists, OperationalSpace", spec, Kind.TWIST, twist, capped, task),
        ("twists, JointImpedance", spec, Kind.TWIST, twist, capped, joints),
    ]


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    columns = ("us", "median", "p99", "answer, median", "Ruckig's own step (reference)", "ratio")
    gc.disable()
    try:
        for idle in (False,) if quick else (False, True):
            table = Table("with a pause between two ticks" if idle else "tick after tick", columns)
            for name, spec, kind, values, tcp_speed, controller in cases():
                found = measure(spec, kind, values, tcp_speed, 1000 if quick else 5000, idle, controller)
                table.add(name, *found, found[0] / found[3])
            yield table
    finally:
        gc.enable()
