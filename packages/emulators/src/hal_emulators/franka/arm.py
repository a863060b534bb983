"""The emulated arm: modes, motions and errors, its answers to requests, and its state packets. No socket, no clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from hal.drivers.franka.flags import FLAGS
from hal.drivers.franka.limits import ELBOW_FLIP, ArmLimits
from hal.drivers.franka.link import ArmMode

from .faults import SetpointReports, Unrest
from .journal import Counters, Journal
from .motion import (
    DT,
    EmulatedMotion,
    Ending,
    Floats,
    LimitChecker,
    MotionSample,
    MoveOptions,
    at_rest,
    braked,
    read_move,
)
from .plant import Plant
from .protocol import (
    CommandPacket,
    ControllerMode,
    FrankaProtocol,
    Generator,
    GeneratorMode,
    RequestOutcome,
    StatePacket,
)
from .settings import SETTERS, ClientSettings

_MANUAL_ERRORS = frozenset({"joint_position_limits_violation"})
"""Errors that are cleared only by guiding the arm by hand. Which ones is an assumption."""


class ArmReply(NamedTuple):
    name: str
    number: int
    body: bytes
    after_state: bool
    """Whether it must follow the next state: the client reads that state once it has the response."""


@dataclass
class StopSwitches:
    """Switches that keep the arm from moving, apart from errors."""

    user: bool = False
    emergency: bool = False
    guiding: bool = False


@dataclass
class EmulatedArm:
    """One arm. :meth:`tick` is its control cycle; requests are served in between (:class:`RequestHandler`)."""

    protocol: FrankaProtocol
    limits: ArmLimits
    plant: Plant
    journal: Journal
    with_hand: bool = True
    send: Callable[[ArmReply], None] = lambda reply: None
    """Sends an answer to the client."""
    counters: Counters = field(default_factory=Counters)
    no_move_reply: bool = False
    """Injected fault: the end of a motion is never answered."""
    reports: SetpointReports = field(default_factory=SetpointReports)
    """Injected faults of the reported set-points."""
    unrest: Unrest = field(default_factory=Unrest)
    """Injected fault: an arm that does not settle."""

    def __post_init__(self) -> None:
        self.checker = LimitChecker(self.limits)
        self.message_id = 0
        self._writer = StateWriter(self.protocol.version)
        self._start = self.plant.q
        self.restart()

    def restart(self) -> None:
        """Reset to the state after switching on, at the present position."""
        self.settings = ClientSettings(self.with_hand)
        self.stops = StopSwitches()
        self.errors: frozenset[int] = frozenset()
        self.last_errors: frozenset[int] = frozenset()
        self.motion: EmulatedMotion | None = None
        self.sample: MotionSample = at_rest(self.plant.q)
        self.shown = self.sample
        """Set-point that the state reports."""
        self._pending: tuple[int, MoveOptions] | None = None
        self.unrest.set(None)
        self._writer.spoilt.clear()

    def place(self, q: Floats | None) -> None:
        """Put the arm at ``q`` (7,), rad, or at its start position. Raises ValueError while a motion runs."""
        if self.motion is not None:
            raise ValueError("not while a motion runs")
        self.plant.place(self._start if q is None else q)
        self.sample = at_rest(self.plant.q)

    # State.

    @property
    def mode(self) -> ArmMode:
        """Mode in the state."""
        if self.stops.emergency:
            return ArmMode.OTHER
        if self.stops.user:
            return ArmMode.USER_STOPPED
        if self.errors:
            return ArmMode.REFLEX
        if self.stops.guiding:
            return ArmMode.GUIDING
        return ArmMode.IDLE if self.motion is None else ArmMode.MOVE

    @property
    def modes(self) -> tuple[GeneratorMode, ControllerMode]:
        """Modes of motion generator and controller. The latter of an idle robot is an assumption."""
        if self.motion is None:
            return GeneratorMode.IDLE, ControllerMode.OTHER
        options = self.motion.options
        return GeneratorMode(options.generator + 1), ControllerMode(options.controller)

    @property
    def at_rest(self) -> bool:
        """Whether the arm is at rest and no motion is running."""
        return self.motion is None and not self.sample.moving and max(map(abs, self.plant.dq)) < 1e-4

    # One cycle.

    def tick(self, command: CommandPacket | None) -> bytearray:
        """Advance one millisecond, with or without a command, and return the state packet after it."""
        motion = self.motion
        if motion is None:
            self._rest()
        else:
            ending = motion.step(command, self.plant.q)
            self.sample = motion.sample
            if motion.lost_in_row:
                self.counters.lost += 1
                self.counters.lost_in_row = max(self.counters.lost_in_row, motion.lost_in_row)
            if ending is not None:
                self._end(ending)
        self._move()
        self.shown = self.reports.shown(self.sample, self.plant.q, self.plant.dq)
        self.message_id += 1
        self.counters.cycles += 1
        return self._writer.write(self)

    def _rest(self) -> None:
        self.sample = braked(self.sample, self.limits.acceleration)
        if self._pending is not None and not self.sample.moving:
            (number, options), self._pending = self._pending, None
            self._begin(number, options)

    def _move(self) -> None:
        motion = self.motion
        if motion is None or not motion.external or motion.waiting:
            self.plant.follow(self.unrest.shifted(self.sample))
            return
        self.plant.push(motion.torques)
        if motion.options.generator is Generator.NONE:
            motion.sample = self.sample = MotionSample(self.plant.q, self.plant.dq, (0.0,) * 7)
        violation = self.checker.measured(self.plant.q, self.plant.dq)
        if violation is not None:
            self._end(Ending(RequestOutcome.REFLEX, violation.text, violation.flag))

    # Motions.

    def _begin(self, number: int, options: MoveOptions) -> None:
        self.last_errors = frozenset()
        self.sample = at_rest(self.sample.q)
        self.answer("Move", number, RequestOutcome.STARTED, after_state=False)
        self.motion = EmulatedMotion(number, options, self.sample, self.message_id, self.checker)
        self.counters.motions += 1
        self.journal.record("motion started", f"motion started: {options.describe()}")

    def _end(self, ending: Ending) -> None:
        motion = self.motion
        assert motion is not None
        if motion.external:
            self.sample = MotionSample(self.plant.q, self.plant.dq, (0.0,) * 7)
        speed = max(map(abs, self.sample.dq))
        self.motion = None
        rate = motion.success_rate
        if ending.flag is not None:
            self._raise(ending.flag, ending.text)
        self.journal.record(
            "motion ended",
            f"motion ended: {ending.outcome.value} ({ending.text}) after {motion.commands} commands, "
            f"success rate {rate:.2f}, at {speed:.3g} rad/s",
            outcome=ending.outcome.value,
            commands=motion.commands,
            success_rate=rate,
            speed=speed,
        )
        if not self.no_move_reply:
            self.answer("Move", motion.request, ending.outcome)

    def _raise(self, flag: int, text: str) -> None:
        self.errors = self.last_errors = frozenset({flag})
        self.counters.reflexes += 1
        self.journal.record("reflex", f"reflex {FLAGS[flag]}: {text}", flag=FLAGS[flag], reason=text)

    # Faults and stops.

    def reflex(self, flag: int) -> None:
        """Raise an error flag, which ends a running motion."""
        if self.motion is not None:
            self._end(Ending(RequestOutcome.REFLEX, "by command", flag))
        else:
            self._raise(flag, "by command")

    def user_stop(self, on: bool) -> None:
        """Press or release the user stop."""
        self.stops.user = on
        self._set_stop(on, "user stop")

    def emergency_stop(self, on: bool) -> None:
        """Press or release the emergency stop. That the arm is idle once it is released is an assumption."""
        self.stops.emergency = on
        self._set_stop(on, "emergency stop")

    def spoil(self, name: str, value: float | None) -> None:
        """Report ``value`` as the first number of a field of the state; None for the true one. Raises ValueError."""
        reals = [known for known, kept in self._writer.packet.layout.fields.items() if kept.kind in "df"]
        if name not in reals:
            raise ValueError(f"{name!r} is none of the state's fields of real numbers: {', '.join(reals)}")
        self._writer.spoilt.pop(name, None)
        if value is not None:
            self._writer.spoilt[name] = value

    def guiding(self, on: bool) -> None:
        """Start or end guiding by hand. Raises ValueError while a motion runs."""
        if on and self.motion is not None:
            raise ValueError("not while a motion runs")
        self.stops.guiding = on
        if not on and any(FLAGS[flag] in _MANUAL_ERRORS for flag in self.errors):
            self.errors = frozenset()
        self.journal.record("guiding", f"guiding {'on' if on else 'off'}")

    def _set_stop(self, on: bool, what: str) -> None:
        self.journal.record(what, f"{what} {'pressed' if on else 'released'}")
        if on and self.motion is not None:
            self._end(Ending(RequestOutcome.EMERGENCY, what))
        if on:
            self._refuse_pending()

    def client_gone(self) -> None:
        """Handle the end of the connection: the robot stops."""
        self._pending = None
        if self.motion is not None:
            self._end(Ending(RequestOutcome.ABORTED, "the client disconnected"))

    def _refuse_pending(self) -> None:
        if self._pending is not None:
            self.answer("Move", self._pending[0], RequestOutcome.NOT_POSSIBLE)
            self._pending = None

    # Requests of the client.

    def move(self, number: int, options: MoveOptions) -> RequestOutcome | None:
        """Start a motion in the next cycle, or once the arm is at rest; return the outcome if it is refused."""
        if self.motion is not None or self.mode is not ArmMode.IDLE:
            return RequestOutcome.NOT_POSSIBLE
        self._refuse_pending()
        self._pending = (number, options)
        return None

    def stop(self) -> RequestOutcome:
        self._refuse_pending()
        if self.motion is None:
            return RequestOutcome.NOT_POSSIBLE
        self._end(Ending(RequestOutcome.PREEMPTED, "StopMove"))
        return RequestOutcome.SUCCESS

    def recover(self) -> RequestOutcome:
        if self.stops.emergency:
            return RequestOutcome.EMERGENCY
        if self.motion is not None or self.stops.user or self.stops.guiding:
            return RequestOutcome.NOT_POSSIBLE
        if any(FLAGS[flag] in _MANUAL_ERRORS for flag in self.errors):
            return RequestOutcome.MANUAL
        self.errors = frozenset()
        return RequestOutcome.SUCCESS

    def answer(
        self, name: str, number: int, outcome: RequestOutcome, body: bytes = b"", *, after_state: bool = True
    ) -> None:
        """Send the response to a request."""
        status = self.protocol.status(name, outcome)
        self.send(ArmReply(name, number, bytes((status,)) + body, after_state))

    def report(self) -> dict[str, Any]:
        """Return the state as plain values, for the control port."""
        generator, controller = self.modes
        return {
            "message_id": self.message_id,
            "mode": self.mode.name.lower(),
            "generator": generator.name.lower(),
            "controller": controller.name.lower(),
            "errors": [FLAGS[flag] for flag in self.errors],
            "last_errors": [FLAGS[flag] for flag in self.last_errors],
            "q": list(self.plant.q),
            "dq": list(self.plant.dq),
            "tau": list(self.plant.tau),
            "q_d": list(self.sample.q),
            "dq_d": list(self.sample.dq),
            "O_T_EE": list(self.plant.body.tip(self.plant.q, self.settings.F_T_EE)),
            "success_rate": self.motion.success_rate if self.motion is not None else 0.0,
            "commands": self.motion.commands if self.motion is not None else 0,
        }


# State packets.

_HAND_MASS = 0.73
_HAND_CENTRE = (-0.01, 0.0, 0.03)
_HAND_INERTIA = (0.001, 0.0, 0.0, 0.0, 0.0025, 0.0, 0.0, 0.0, 0.0017)
"""m_ee (kg), F_x_Cee (m) and I_ee (kg m2) of an arm with a Franka Hand."""


class StateWriter:
    """Keeps one state packet up to date, and writes only what may have changed.

    Contacts, external forces and accelerometers are always 0.
    """

    def __init__(self, version: int) -> None:
        self.packet = StatePacket(version)
        self.spoilt: dict[str, float] = {}
        """Injected fault: what is reported in place of the first number of a field."""
        self._settings: object = None
        self._changes = -1
        self._flags: object = None
        self._q: Floats | None = None
        self._q_d: Floats | None = None
        self._tau: Floats = (0.0,) * 7
        self.packet.put("O_ddP_O", (0.0, 0.0, -9.81))

    def write(self, arm: EmulatedArm) -> bytearray:
        """Return the packet after this cycle, always in the same buffer, unless it is spoilt."""
        packet, plant, motion, sample = self.packet, arm.plant, arm.motion, arm.shown
        if arm.settings is not self._settings or arm.settings.changes != self._changes:
            self._write_settings(arm)
        packet.put("message_id", (arm.message_id,))
        q, tau = plant.q, plant.tau
        if q is not self._q or sample.q is not self._q_d:
            self._write_poses(arm)
        dtau = [(new - old) / DT for new, old in zip(tau, self._tau, strict=True)]
        self._tau = tau
        torques: Floats = motion.torques if motion is not None else (0.0,) * 7
        packet.put_joints((*tau, *torques, *dtau, *q, *sample.q, *plant.dq, *sample.dq, *sample.ddq))
        packet.put_motors((*q, *plant.dq))
        packet.put_modes(*arm.modes)
        flags = (arm.errors, arm.last_errors)
        if flags != self._flags:
            self._flags = flags
            for name, raised in (("errors", arm.errors), ("reflex_reason", arm.last_errors)):
                packet.put(name, [int(k in raised) for k in range(len(FLAGS))])
        packet.put("robot_mode", (arm.mode,))
        packet.put("control_command_success_rate", (motion.success_rate if motion is not None else 0.0,))
        return packet.spoilt(self.spoilt) if self.spoilt else packet.buffer

    def _write_poses(self, arm: EmulatedArm) -> None:
        q, q_d = arm.plant.q, arm.shown.q
        self._q, self._q_d = q, q_d
        packet, tip = self.packet, arm.settings.F_T_EE
        pose = arm.plant.body.tip(q, tip)
        desired = pose if q_d is q else arm.plant.body.tip(q_d, tip)
        packet.put("O_T_EE", pose)
        packet.put("O_T_EE_d", desired)
        packet.put("O_T_EE_c", desired)
        packet.put("elbow", _elbow(q))
        packet.put("elbow_d", _elbow(q_d))
        packet.put("elbow_c", _elbow(q_d))

    def _write_settings(self, arm: EmulatedArm) -> None:
        packet, settings = self.packet, arm.settings
        self._settings, self._changes = settings, settings.changes
        packet.put("F_T_EE", settings.F_T_EE)
        packet.put("EE_T_K", settings.EE_T_K)
        packet.put("F_T_NE", settings.F_T_NE)
        packet.put("NE_T_EE", settings.NE_T_EE)
        if settings.with_hand:
            packet.put("m_ee", (_HAND_MASS,))
            packet.put("F_x_Cee", _HAND_CENTRE)
            packet.put("I_ee", _HAND_INERTIA)
        mass, centre, inertia = settings.load
        packet.put("m_load", (mass,))
        packet.put("F_x_Cload", centre)
        packet.put("I_load", inertia)
        self._q = None


def _elbow(q: Floats) -> tuple[float, float]:
    """Return the angle of joint 3, rad, and the direction in which joint 4 bends."""
    return q[2], 1.0 if q[3] > ELBOW_FLIP else -1.0


# Requests.

_VIRTUAL_WALL = bytes(24 + 128 + 1)
"""Payload of GetCartesianLimit: size, frame, whether it is active. There is no virtual wall."""
_X64_LINUX = bytes(2)
"""Payload of a LoadModelLibrary that can be answered: architecture and system."""


@dataclass(frozen=True)
class RobotFiles:
    """Files that a client may request."""

    urdf: bytes
    model_library: bytes
    """Shared object for a Panda's client (:mod:`.model_library`)."""


class RequestHandler:
    """Decodes requests, one at a time, and has the arm carry them out and answer."""

    def __init__(self, arm: EmulatedArm, files: RobotFiles) -> None:
        self._arm = arm
        self._files = files
        self._handlers: dict[str, Callable[[int, bytes], None]] = {
            "Move": self._move,
            "StopMove": self._stop,
            "AutomaticErrorRecovery": self._recover,
            "GetRobotModel": self._model,
            "LoadModelLibrary": self._library,
            "GetCartesianLimit": self._wall,
        }

    def handle(self, name: str, number: int, payload: bytes) -> None:
        """Carry out one request, whose payload has the right size."""
        if name in SETTERS:
            self._set(name, number, payload)
        else:
            self._handlers[name](number, payload)

    def _set(self, name: str, number: int, payload: bytes) -> None:
        arm = self._arm
        if arm.motion is not None:  # refusing settings during a motion is an assumption
            arm.answer(name, number, RequestOutcome.NOT_POSSIBLE)
            return
        reason = arm.settings.store(name, payload)
        text = "accepted" if reason is None else f"refused, {reason}"
        arm.journal.record("setting", f"{name}: {text}", name=name, refused=reason)
        arm.answer(name, number, RequestOutcome.SUCCESS if reason is None else RequestOutcome.INVALID)

    def _move(self, number: int, payload: bytes) -> None:
        arm = self._arm
        try:
            options = read_move(payload)
        except ValueError as error:
            self._refuse(number, RequestOutcome.INVALID, str(error))
            return
        if options.generator in (Generator.CARTESIAN_POSITION, Generator.CARTESIAN_VELOCITY):
            self._refuse(number, RequestOutcome.NOT_POSSIBLE, "Cartesian motions are not emulated")
            return
        reason = arm.move(number, options)
        if reason is not None:
            self._refuse(number, reason, f"the robot's mode is {arm.mode.name.lower()}")

    def _refuse(self, number: int, outcome: RequestOutcome, why: str) -> None:
        self._arm.journal.record("refused", f"Move refused: {why}")
        self._arm.answer("Move", number, outcome)

    def _stop(self, number: int, payload: bytes) -> None:
        self._arm.answer("StopMove", number, self._arm.stop())

    def _recover(self, number: int, payload: bytes) -> None:
        outcome = self._arm.recover()
        self._arm.journal.record("recovery", f"automatic error recovery: {outcome.value}", outcome=outcome.value)
        self._arm.answer("AutomaticErrorRecovery", number, outcome)

    def _model(self, number: int, payload: bytes) -> None:
        self._arm.answer("GetRobotModel", number, RequestOutcome.SUCCESS, self._files.urdf)

    def _library(self, number: int, payload: bytes) -> None:
        if payload == _X64_LINUX:
            self._arm.answer("LoadModelLibrary", number, RequestOutcome.SUCCESS, self._files.model_library)
        else:
            self._arm.answer("LoadModelLibrary", number, RequestOutcome.NOT_POSSIBLE)

    def _wall(self, number: int, payload: bytes) -> None:
        self._arm.answer("GetCartesianLimit", number, RequestOutcome.SUCCESS, _VIRTUAL_WALL)
