"""The robot's side of the control interface: modes, motions, errors. There is no socket and no clock in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from hal.drivers.franka.flags import FLAGS
from hal.drivers.franka.limits import ArmLimits

from .checker import LimitChecker
from .faults import Reports
from .journal import Figures, Journal
from .layouts import CommandPacket
from .motion import Ending, Motion
from .moves import MoveOptions
from .plant import Plant
from .protocol import ControllerMode, Generator, GeneratorMode, Outcome, Protocol, RobotMode
from .samples import Floats, Sample, at_rest, braked
from .setters import Settings
from .state import StateWriter

__all__ = ["Arm", "Reply"]

_BY_HAND = frozenset({"joint_position_limits_violation"})
"""Errors that need a person to move the arm by hand; that it is just these is an assumption."""


class Reply(NamedTuple):
    """A response to a request."""

    name: str
    number: int
    body: bytes
    after_state: bool
    """It must not leave before the next state: the client reads the state when it has the response."""


@dataclass
class Stops:
    """What keeps the arm from moving, apart from errors."""

    user: bool = False
    emergency: bool = False
    guiding: bool = False


@dataclass
class Arm:
    """One arm. :meth:`tick` is its control cycle; what requests ask for is done in between (see :mod:`.requests`)."""

    protocol: Protocol
    limits: ArmLimits
    plant: Plant
    journal: Journal
    with_hand: bool = True
    send: Callable[[Reply], None] = lambda reply: None
    """Where answers go: the connection's."""
    figures: Figures = field(default_factory=Figures)
    no_move_reply: bool = False
    """A fault: the end of a motion is never told."""
    reports: Reports = field(default_factory=Reports)
    """Faults of what the states say was commanded."""

    def __post_init__(self) -> None:
        self.checker = LimitChecker(self.limits)
        self.message_id = 0
        self._writer = StateWriter(self.protocol.version)
        self._start = self.plant.q
        self.restart()

    def restart(self) -> None:
        """As after switching it on, where it stands."""
        self.settings = Settings(self.with_hand)
        self.stops = Stops()
        self.errors: frozenset[int] = frozenset()
        self.last_errors: frozenset[int] = frozenset()
        self.motion: Motion | None = None
        self.sample: Sample = at_rest(self.plant.q)
        self.shown = self.sample
        """What the state says that it was commanded."""
        self._pending: tuple[int, MoveOptions] | None = None

    def place(self, q: Floats | None) -> None:
        """Put the arm there (7,), rad, or where it was at the start. Raises ValueError while a motion runs."""
        if self.motion is not None:
            raise ValueError("not while a motion runs")
        self.plant.place(self._start if q is None else q)
        self.sample = at_rest(self.plant.q)

    # What it shows.

    @property
    def mode(self) -> RobotMode:
        """As the state tells it."""
        if self.stops.emergency:
            return RobotMode.OTHER
        if self.stops.user:
            return RobotMode.USER_STOPPED
        if self.errors:
            return RobotMode.REFLEX
        if self.stops.guiding:
            return RobotMode.GUIDING
        return RobotMode.IDLE if self.motion is None else RobotMode.MOVE

    @property
    def modes(self) -> tuple[GeneratorMode, ControllerMode]:
        """Of motion generator and controller. What an idle robot shows for the latter is an assumption."""
        if self.motion is None:
            return GeneratorMode.IDLE, ControllerMode.OTHER
        options = self.motion.options
        return GeneratorMode(options.generator + 1), ControllerMode(options.controller)

    @property
    def at_rest(self) -> bool:
        """Does it stand, with nothing running?"""
        return self.motion is None and not self.sample.moving and max(map(abs, self.plant.dq)) < 1e-4

    # One cycle.

    def tick(self, command: CommandPacket | None) -> bytearray:
        """Go on for one millisecond with this command, or without one; gives the state packet after it."""
        motion = self.motion
        if motion is None:
            self._rest()
        else:
            ending = motion.step(command, self.plant.q)
            self.sample = motion.sample
            if motion.lost_in_row:
                self.figures.lost += 1
                self.figures.lost_in_row = max(self.figures.lost_in_row, motion.lost_in_row)
            if ending is not None:
                self._end(ending)
        self._move()
        self.shown = self.reports.shown(self.sample, self.plant.q, self.plant.dq)
        self.message_id += 1
        self.figures.cycles += 1
        return self._writer.write(self)

    def _rest(self) -> None:
        self.sample = braked(self.sample, self.limits.acceleration)
        if self._pending is not None and not self.sample.moving:
            (number, options), self._pending = self._pending, None
            self._begin(number, options)

    def _move(self) -> None:
        motion = self.motion
        if motion is None or not motion.external or motion.waiting:
            self.plant.follow(self.sample)
            return
        self.plant.push(motion.torques)
        if motion.options.generator is Generator.NONE:
            motion.sample = self.sample = Sample(self.plant.q, self.plant.dq, (0.0,) * 7)
        violation = self.checker.measured(self.plant.q, self.plant.dq)
        if violation is not None:
            self._end(Ending(Outcome.REFLEX, violation.text, violation.flag))

    # Motions.

    def _begin(self, number: int, options: MoveOptions) -> None:
        self.last_errors = frozenset()
        self.sample = at_rest(self.sample.q)
        self.answer("Move", number, Outcome.STARTED, after_state=False)
        self.motion = Motion(number, options, self.sample, self.message_id, self.checker)
        self.figures.motions += 1
        self.journal.say("motion started", f"motion started: {options.describe()}")

    def _end(self, ending: Ending) -> None:
        motion = self.motion
        assert motion is not None
        if motion.external:
            self.sample = Sample(self.plant.q, self.plant.dq, (0.0,) * 7)
        speed = max(map(abs, self.sample.dq))
        self.motion = None
        rate = motion.success_rate
        if ending.flag is not None:
            self._raise(ending.flag, ending.text)
        self.journal.say(
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
        self.figures.reflexes += 1
        self.journal.say("reflex", f"reflex {FLAGS[flag]}: {text}", flag=FLAGS[flag], reason=text)

    # What happens to it.

    def reflex(self, flag: int) -> None:
        """The controller stops the arm with this error."""
        if self.motion is not None:
            self._end(Ending(Outcome.REFLEX, "by command", flag))
        else:
            self._raise(flag, "by command")

    def user_stop(self, on: bool) -> None:
        """The button in somebody's hand is pressed or released."""
        self.stops.user = on
        self._stopped(on, "user stop")

    def emergency_stop(self, on: bool) -> None:
        """The emergency stop. That the arm is idle as soon as it is released is an assumption."""
        self.stops.emergency = on
        self._stopped(on, "emergency stop")

    def guiding(self, on: bool) -> None:
        """Somebody leads the arm by hand. Raises ValueError while a motion runs."""
        if on and self.motion is not None:
            raise ValueError("not while a motion runs")
        self.stops.guiding = on
        if not on and any(FLAGS[flag] in _BY_HAND for flag in self.errors):
            self.errors = frozenset()
        self.journal.say("guiding", f"guiding {'on' if on else 'off'}")

    def _stopped(self, on: bool, what: str) -> None:
        self.journal.say(what, f"{what} {'pressed' if on else 'released'}")
        if on and self.motion is not None:
            self._end(Ending(Outcome.EMERGENCY, what))
        if on:
            self._refuse_pending()

    def client_gone(self) -> None:
        """The connection ended: the robot stops by itself."""
        self._pending = None
        if self.motion is not None:
            self._end(Ending(Outcome.ABORTED, "the client is gone"))

    def _refuse_pending(self) -> None:
        if self._pending is not None:
            self.answer("Move", self._pending[0], Outcome.NOT_POSSIBLE)
            self._pending = None

    # What a client asks for.

    def move(self, number: int, options: MoveOptions) -> Outcome | None:
        """Begin a motion in the next cycle, or when the arm has come to rest; the reason where it may not."""
        if self.motion is not None or self.mode is not RobotMode.IDLE:
            return Outcome.NOT_POSSIBLE
        self._refuse_pending()
        self._pending = (number, options)
        return None

    def stop(self) -> Outcome:
        """End the motion that runs."""
        self._refuse_pending()
        if self.motion is None:
            return Outcome.NOT_POSSIBLE
        self._end(Ending(Outcome.PREEMPTED, "StopMove"))
        return Outcome.SUCCESS

    def recover(self) -> Outcome:
        """Clear the errors."""
        if self.stops.emergency:
            return Outcome.EMERGENCY
        if self.motion is not None or self.stops.user or self.stops.guiding:
            return Outcome.NOT_POSSIBLE
        if any(FLAGS[flag] in _BY_HAND for flag in self.errors):
            return Outcome.MANUAL
        self.errors = frozenset()
        return Outcome.SUCCESS

    def answer(self, name: str, number: int, outcome: Outcome, body: bytes = b"", *, after_state: bool = True) -> None:
        """Respond to a request."""
        status = self.protocol.status(name, outcome)
        self.send(Reply(name, number, bytes((status,)) + body, after_state))

    def report(self) -> dict[str, Any]:
        """The state as plain values, for the control port."""
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
