"""An emulated arm with its gripper: its servos, and its mechanics. Time passes only in ``step``."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.drivers.servo_bus.protocol import ALL, COUNT
from hal.drivers.servo_bus.settings import ServoArmSettings, ServoGripperSettings
from hal.kinematics.urdf import read_urdf
from hal.specs import RobotSpec
from hal_emulators.can.plant import ArmPlant, Drive, GripperPlant, JointMechanics
from hal_emulators.shared_world import ArmInWorld

from .servo import SERVOS, Servo


def _find_mechanics(servos: Sequence[Servo]) -> JointMechanics:
    """Return the mechanics of motors that turn a joint together: shares of their torque, chosen."""
    torque = sum(servo.stored.stall_torque for servo in servos)
    return JointMechanics(inertia=0.002 * torque, coulomb=0.017 * torque, viscous=0.017 * torque, torque=torque)


def _find_range(lower: float, upper: float, sign: int, zero: int | None) -> tuple[tuple[int, int], float]:
    """Return the ends of a joint's range and its zero, counts, as if it had been calibrated without an error."""
    if zero is None:
        half = min(round(max(-lower, upper) / COUNT), 2047)
        ends = (0, 4095) if half > 1800 else (2047 - half, 2047 + half)
        return ends, 0.5 * sum(ends)
    counts = sorted(min(max(round(zero + sign * angle / COUNT), 0), 4095) for angle in (lower, upper))
    return (counts[0], counts[1]), zero


def _add(drives: Sequence[Drive]) -> Drive:
    """Return what motors do together that turn a joint."""
    kp = sum(drive.kp for drive in drives)
    q = sum(drive.kp * drive.q for drive in drives) / kp if kp else 0.0
    return Drive(q, 0.0, kp, sum(drive.kd for drive in drives), sum(drive.tau for drive in drives))


class EmulatedArm:
    """An arm on a servo bus, and the gripper there.

    Attributes:
        servos: Its servos, from base to tip, then that of its gripper.
        plant: The arm's mechanics.
        world: The simulated world that it is in; None for none.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self.spec = spec
        settings = ServoArmSettings.of(spec)
        self.port, kind = settings.port, SERVOS[spec.driver]
        self.protocol = kind.protocol
        urdf = read_urdf(Path(spec.urdf), meshes=False).joints
        torques = spec.limits.torque or (0.0,) * len(spec.joints)
        self.joints: list[list[Servo]] = []
        """Servos of each joint."""
        for k, (name, ids) in enumerate(zip(spec.joints, settings.motors, strict=True)):
            sign = -1 if name in settings.reversed else 1
            ends, zero = _find_range(urdf[name].lower or 0.0, urdf[name].upper or 0.0, sign, settings.zero)
            self.joints.append([kind(id, 211 * k - 500 + 30 * n, ends, sign, zero) for n, id in enumerate(ids)])
            for servo in self.joints[-1]:
                servo.become(torques[k] / len(ids), ids[0])
        mechanics = [_find_mechanics(servos) for servos in self.joints]
        self.plant = ArmPlant(spec.kinematics, mechanics, spec.initial, spec.base_orientation)
        if spec.payload is not None:
            self.plant.load(payload=(spec.payload.mass, spec.payload.position))
        self.servos = [servo for servos in self.joints for servo in servos]
        self.jaw: GripperPlant | None = None
        self.object_width = 0.0
        gripper = spec.gripper
        if gripper is not None and gripper.driver == spec.driver:
            own = ServoGripperSettings.of(gripper)
            span = abs(gripper.opened[0] - gripper.closed[0]) if own.widths is None else 0.0
            table = own.widths or [(share * span, width) for share, width in gripper.travel]
            self._ways, self._widths = [angle - table[0][0] for angle, _ in table], [width for _, width in table]
            closed = 2000 if own.widths is None else round(own.zero + table[0][0] / COUNT)
            ends = (closed, closed + round(self._ways[-1] / COUNT))
            self._jaw_servo = kind(own.id, 77, ends, 1, closed)
            self._jaw_servo.become(torques[-1], own.id)  # as that of the last joint
            self.servos.append(self._jaw_servo)
            self.jaw = GripperPlant(_find_mechanics([self._jaw_servo]), 0.5 * self._ways[-1], 0.0, self._ways[-1])
        self.world: ArmInWorld | None = None
        self.peak = [0.0] * len(self.joints)
        """Greatest speed of each joint since the last reset, rad/s."""
        self._hand: deque[tuple[float, NDArray[np.float64]]] = deque()
        """Motions that a hand still makes: duration, s, and where they end: the joints, rad, then the lever, 0 to 1."""
        self._begun, self._t_hand = np.zeros(0), 0.0
        self._in_hand = False
        """Whether a hand is at it, which holds it as long as its motors have no torque."""
        self.place(spec.initial)

    def lead(self, seconds: float, end: Sequence[float]) -> None:
        """Let a hand move an arm without torque, after the motions that it makes already.

        Args:
            seconds: Duration of the motion.
            end: Where it ends: the joints, rad, and the lever from 0 (open) to 1 (closed), or only the joints.

        Raises:
            ValueError: The wrong number of values, or a motor has torque.
        """
        count = len(self.joints)
        if len(end) not in (count, count + 1) or not seconds > 0.0:
            raise ValueError(f"needs a duration, {count} angles and perhaps the lever")
        if any(servo.on for servo in self.servos):
            raise ValueError("its motors have torque: no hand moves it")
        self._in_hand = True
        before = self._hand[-1][1] if self._hand else self._held
        self._hand.append((seconds, np.array([*end, *before[len(end) :]])))

    @property
    def _held(self) -> NDArray[np.float64]:
        lever = [] if self.jaw is None else [1.0 - self.jaw.q / self._ways[-1]]
        return np.array([*self.plant.q.tolist(), *lever])

    def _move_by_hand(self, dt: float) -> None:
        if not self._t_hand:
            self._begun = self._held
        self._t_hand += dt
        seconds, end = self._hand[0]
        share = min(1.0, self._t_hand / seconds)
        at = self._begun + share**2 * (3.0 - 2.0 * share) * (end - self._begun)
        count = len(self.joints)
        self.plant.q[:] = at[:count]
        if self.jaw is not None:
            self.jaw.q = (1.0 - float(at[count])) * self._ways[-1]
        if share >= 1.0:
            self._hand.popleft()
            self._t_hand = 0.0

    def find(self, id: int) -> list[Servo]:
        """Return the servos with an id, those that are on the bus."""
        return [servo for servo in self.servos if servo.plugged and id in (servo.id, ALL)]

    def place(self, q: Sequence[float]) -> None:
        """Put the arm at rest at a position, rad, without torque, and hold it there until its torque is on."""
        self.plant.place(q)
        self._hand.clear()
        self._t_hand = 0.0
        self._report()
        for servo in self.servos:
            servo.restart()

    def _report(self) -> None:
        """Let the servos feel their shafts."""
        plant = self.plant
        for servos, *motion in zip(self.joints, plant.q.tolist(), plant.dq.tolist(), plant.tau.tolist(), strict=True):
            for servo in servos:
                servo.turn_to(motion[0], motion[1], motion[2] / len(servos))
        if self.jaw is not None:
            self._jaw_servo.turn_to(self.jaw.q, self.jaw.dq, self.jaw.tau)

    def step(self, dt: float) -> None:
        """Let ``dt`` s pass."""
        plant = self.plant
        drives = [_add([servo.drive(dt) for servo in servos]) for servos in self.joints]
        on = [servo.on for servos in self.joints for servo in servos]
        if all(on):
            plant.held = False
        elif self._in_hand and not any(on):
            plant.held = True
        plant.step(dt, drives)
        if self._hand:
            self._move_by_hand(dt)
        self.peak = [max(peak, abs(speed)) for peak, speed in zip(self.peak, plant.dq.tolist(), strict=True)]
        if self.jaw is not None:
            width = self.object_width if self.world is None else self.world.object_width or 0.0
            self.jaw.lower = float(np.interp(width, self._widths, self._ways)) if width else 0.0
            self.jaw.step(dt, self._jaw_servo.drive(dt))
        self._report()
        if self.world is not None:
            if self.jaw is not None:
                lever = (self._widths[-1] - self._widths[0]) / self._ways[-1]
                self.world.fingers = self.world.now, self.width, abs(self.jaw.tau) / lever
            self.world.exchange(dt, plant.q.tolist())

    @property
    def width(self) -> float:
        """Width of its gripper, m; 0 without one."""
        return 0.0 if self.jaw is None else float(np.interp(self.jaw.q, self._ways, self._widths))

    def report(self) -> dict[str, Any]:
        """Return the state of the arm, for programs and people."""
        plant = self.plant
        return {
            "q": plant.q.tolist(),
            "dq": plant.dq.tolist(),
            "tau": plant.tau.tolist(),
            "goals": [servo.goal for servo in self.servos],
            "counts": [round(servo.angle) for servo in self.servos],
            "on": [servo.on for servo in self.servos],
            "limits": [servo.get(self.protocol.limit) for servo in self.servos],
            "errors": [servo.errors for servo in self.servos],
            "width": self.width,
            "peak_speed": self.peak,
        }
