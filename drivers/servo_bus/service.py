"""Set up and calibrate the motors of an arm on a servo bus, and of its gripper there: ids, rates, homing and ranges.

Calibration is LeRobot's: what is stored in the motors, and the file, can be exchanged with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from time import monotonic
from typing import Any, NamedTuple

from hal import registry
from hal.errors import ConfigError, ConnectionLost, DeviceNotFound, Problem
from hal.serial_line import set_baud
from hal.specs import PadSpec, RobotSpec

from .arm import ServoArm
from .bus import ServoBus
from .chain import SPANS
from .leader import ServoLeader
from .protocol import ALL, COUNT, PING, TURN, Calibration

_WHOLE = 5.5
"""Range of a joint in the model from which its motor is given a whole turn, rad, as LeRobot does."""
_UNKNOWN = 0.5, 5.0
"""Least and greatest range of a motor that has none in the model, a gripper's, rad, before :data:`SPANS`."""
_SCAN = 0.1
"""Time in which all motors on the bus answer, s."""


class Motor(NamedTuple):
    """A motor that the rig names."""

    name: str
    """That of its joint; of a second motor there, with ``_shadow``, and ``gripper``."""
    id: int
    span: float
    """Range of its joint in the model, rad; 0 if that is not known."""


class MotorService:
    """The motors of an arm and its gripper, or of a leader. No other program may use the bus. Use it in ``with``.

    Attributes:
        motors: The motors, from the gripper's or the lever's to the base.
        pose: Where the joints are to be for :meth:`take_middle`, in words.
        seen: Least and greatest count of each motor since :meth:`take_middle`.
    """

    def __init__(self, spec: RobotSpec | PadSpec) -> None:
        kind = "robot" if isinstance(spec, RobotSpec) else "leader"
        arm: ServoArm | ServoLeader = registry.load(spec.driver, kind)(spec)
        devices = [arm.chain]
        if isinstance(spec, RobotSpec) and spec.gripper is not None and spec.gripper.driver == spec.driver:
            devices.append(registry.load(spec.driver, "gripper")(spec.gripper).chain)
        found = [
            Motor(("gripper" if chain is not arm.chain else joint.label) + "_shadow" * (k > 0), id, joint.span)
            for chain in devices
            for joint in chain.joints
            for k, id in enumerate(joint.ids)
        ]
        self.name, self.motors = spec.name, found[::-1]
        self.protocol, self.settings = arm.protocol, arm.chain.settings
        zero = arm.settings.zero
        self.middle = TURN // 2 - 1 if zero is None else zero
        self.pose = "to the middle of its range" if zero is None else "to where the model has its 0"
        self.seen: dict[int, tuple[int, int]] = {}
        self._offsets: dict[int, int] = {}
        self._before: dict[int, Calibration] = {}
        """How the motors were calibrated, until they are calibrated anew."""

    def __enter__(self) -> MotorService:
        self.bus = ServoBus.acquire(self.settings.port, self.protocol, self.settings.baud)
        return self

    def __exit__(self, *_: object) -> None:
        for id, calibration in self._before.items():  # what was begun did not come to its end
            with suppress(ConnectionLost):  # one that does not answer keeps no other from its calibration
                self._write(id, calibration)
        self.bus.release(())

    # Ids and rates.

    def set_up(self, motor: Motor) -> str:
        """Give the only motor on the bus an id, the rig's rate and no return delay; return what it was.

        Raises:
            DeviceNotFound: No motor is on the bus, or more than one.
            ConnectionLost: The port does not work, or the motor confirms nothing.
        """
        line, bus = self.bus.check(), self.bus
        try:
            for baud in dict.fromkeys((bus.baud, *self.protocol.bauds)):
                set_baud(line, baud)
                surplus = bus.surplus
                found = bus.ask(ALL, PING, b"", range(253), _SCAN)
                if len(found) > 1 or (found and bus.surplus > surplus):
                    which = f"with the ids {', '.join(map(str, sorted(found)))}" if len(found) > 1 else "with one id"
                    raise DeviceNotFound(f"several motors are on the bus, {which}; connect {motor.name} alone")
                for id in found:
                    self._give(id, motor.id, baud)
                    return f"was {id} at {baud} bit/s"
        finally:
            set_baud(line, bus.baud)
        raise DeviceNotFound("no motor answers; check its plug, and the motors' power supply", code="motor_missing")

    def _give(self, old: int, new: int, baud: int) -> None:
        protocol = self.protocol
        self._store(old, protocol.torque, b"\0")
        self._unlock(old, True)
        self._store(old, protocol.delay_address, b"\0")
        if old != new:
            self.bus.store(old, protocol.id_address, bytes((new,)))  # it may confirm that with either id
        if baud != self.bus.baud:
            self.bus.store(new, protocol.baud_address, bytes((protocol.bauds[self.bus.baud],)))
            set_baud(self.bus.check(), self.bus.baud)
        self._unlock(new, False)
        if not self.bus.ask(new, PING, b"", (new,)):
            raise ConnectionLost(f"the motor does not answer with its new id {new}; switch its power off and on")

    # Homing and ranges.

    def relax(self) -> None:
        """Switch the torque of all motors off, and let them turn freely. Raises ConnectionLost.

        Unless they are calibrated anew before the service ends, they then have their calibration again.
        """
        self._before = {motor.id: self._read_calibration(motor.id) for motor in self.motors}
        for motor in self.motors:
            self._store(motor.id, self.protocol.torque, b"\0")
            self._write(motor.id, Calibration(0, 0, 0, TURN - 1))

    def take_middle(self) -> None:
        """Let each motor count from :attr:`middle` where it is now. Raises ConnectionLost."""
        for id, count in self._read().items():
            self._offsets[id] = self.protocol.homing * (self.middle - count)
            self._write(id, Calibration(0, self._offsets[id], 0, TURN - 1))
        self.seen = {id: (count, count) for id, count in self._read().items()}

    def watch(self) -> dict[str, tuple[int, int]]:
        """Note where the motors are, and return the least and greatest count of each. Raises ConnectionLost."""
        for id, count in self._read().items():
            low, high = self.seen[id]
            self.seen[id] = min(low, count), max(high, count)
        return {motor.name: self.seen[motor.id] for motor in self.motors}

    def store(self) -> dict[str, dict[str, int]]:
        """Store the ranges that were seen in the motors, and return LeRobot's file.

        Raises:
            ConfigError: A motor was not moved through its range; names each, and nothing is stored.
            ConnectionLost: A motor does not answer.
        """
        found, problems = {}, []
        for motor in self.motors:
            low, high = self.seen[motor.id]
            if motor.span > _WHOLE:
                low, high = 0, TURN - 1
            span = (high - low) * COUNT
            least, most = (share * (motor.span or _UNKNOWN[k]) for k, share in enumerate(SPANS))
            if not least <= span <= most:
                message = f"was moved through {span:.2f} rad, not {least:.2f} to {most:.2f}; begin again"
                problems.append(Problem("<motors>", motor.name, message, "not_calibrated"))
            mode = self._read_calibration(motor.id).drive_mode
            found[motor.name] = Calibration(mode, self._offsets[motor.id], low, high)
        if problems:
            raise ConfigError(problems)
        file = {motor.name: {"id": motor.id, **found[motor.name]._asdict()} for motor in self.motors[::-1]}
        self.restore(file)
        return file

    def restore(self, file: Mapping[str, Mapping[str, Any]]) -> None:
        """Write LeRobot's file into the motors. Raises ConnectionLost, ValueError for a motor that it lacks."""
        entries = {int(entry["id"]): entry for entry in file.values()}
        missing = [motor.name for motor in self.motors if motor.id not in entries]
        if missing:
            raise ValueError(f"it has no motor for {', '.join(missing)}")
        for motor in self.motors:
            entry = entries[motor.id]
            self._store(motor.id, self.protocol.torque, b"\0")
            self._write(motor.id, Calibration(*(int(entry[key]) for key in Calibration._fields)))
        self._before = {}

    # Registers.

    def _read(self) -> dict[int, int]:
        ids = [motor.id for motor in self.motors]
        for _ in range(2):
            answers = self.bus.read_all(self.protocol.state, ids, monotonic() + _SCAN)
            if len(answers) == len(ids):
                break
        silent = [motor.name for motor in self.motors if motor.id not in answers]
        if silent:
            raise ConnectionLost(f"no answer from {', '.join(silent)}; check plugs and power supply")
        status = bytes(self.protocol.status[1] if self.protocol.status is not None else 0)
        return {id: self.protocol.decode_state(0.0, answer, status).position for id, answer in answers.items()}

    def _read_calibration(self, id: int) -> Calibration:
        block = self.bus.read(id, *self.protocol.stored)
        if block is None:
            raise ConnectionLost(f"no answer from motor {id}")
        return self.protocol.decode_registers(block).calibration

    def _write(self, id: int, calibration: Calibration) -> None:
        self._unlock(id, True)
        address, mode = self.protocol.free
        rest = (self.protocol.delay_address, b"\0"), *self.protocol.store_calibration(calibration)
        for place, data in ((address, bytes((mode,))), *rest):
            self._store(id, place, data)
        self._unlock(id, False)

    def _unlock(self, id: int, open: bool) -> None:
        if self.protocol.lock is not None:
            self._store(id, self.protocol.lock, bytes((not open,)))

    def _store(self, id: int, address: int, data: bytes) -> None:
        if not any(self.bus.store(id, address, data) for _ in range(3)):
            raise ConnectionLost(f"motor {id} does not confirm what is written; check its plugs and power supply")
