"""A leader: a small arm that a person moves, and that an arm of the rig follows.

To a rig it is a gamepad that also reports joint positions. :class:`LeaderDriver` reads its motors, and :class:`Leader`
adds the gamepad that is its dead-man. :mod:`hal.leading` turns its states into commands.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import monotonic, sleep
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from .deadman import Deadman, Threshold
from .driver import GamepadDriver, PadReading
from .errors import HalError
from .gamepad import RUMBLE_SECONDS, RUMBLE_STRONG, RUMBLE_WEAK, Gamepad

if TYPE_CHECKING:
    import threading

    from .specs import PadSpec
    from .types import PadState

_PERIOD = 0.01
"""Time between two readings, s."""
_RETRY = 0.25
"""Time between two attempts to connect to a leader, s."""
_STIR, _REST = 0.01, 1.0
"""A leader without any dead-man counts as held from a motion of so many rad on, until it rests for so many s."""
_HEARD = 0.15
"""Time for which a leader follows, or feels, what it was given last, s."""
_AWAY = PadReading(-math.inf, -math.inf, 0.0, 0, MappingProxyType({}), frozenset(), connected=False)


class Angles(NamedTuple):
    """One reading of a leader's motors."""

    t: float
    """When they were asked, s on the rig's clock; that of the reading before if they have not answered since."""
    q: Sequence[float]
    """Angle of each motor from base to tip, rad; any turn."""
    lever: float
    """Its lever, from 0 (open, released) to 1."""


class LeaderDriver(GamepadDriver):
    """Driver of one leader arm. It never moves a motor or writes to one, but to follow the arm or to push the hand."""

    proves_liveness = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        assert spec.leader is not None
        self.leader = spec.leader
        self.absolute = ("r2",) if self.leader.lever == "gripper" else ()
        self.is_open = False
        self._due = self._retry_at = -math.inf
        """When the next reading is due, by the monotonic clock, and an attempt to connect, by the rig's; s."""
        self._trouble = "it is not open"
        self.limp = ""
        """Why it can neither follow nor push the hand although it may, with the remedy; set by :meth:`read_angles`."""
        self._reading = _AWAY
        self._pressed = Threshold()
        self._rested: Sequence[float] = ()
        """Joint positions from which a motion is counted, if moving it is its dead-man."""
        self._t_moved = -math.inf
        self._wanted: tuple[float, Sequence[float]] | None = None
        """When it was given joint positions to follow, by the monotonic clock, s, and these, rad."""
        self._felt: tuple[float, Sequence[float]] | None = None
        """When it was given torques to feel, by the monotonic clock, s, and these, Nm."""

    def follow(self, q: Sequence[float] | None) -> None:
        """Come to these joint positions (n,), rad, if it may move; for 0.15 s, if no others come. Any thread.

        None: let it go, which a person wants to move.
        """
        self._wanted = None if q is None else (monotonic(), q)

    def feel(self, torques: Sequence[float] | None) -> None:
        """Push the hand with these torques of the joints (n,), Nm, if it can; for 0.15 s, if no others come.

        None: let it go. Any thread.
        """
        self._felt = None if torques is None else (monotonic(), torques)

    @property
    def wanted(self) -> Sequence[float] | None:
        """Joint positions to follow at the moment (n,), rad; None for none."""
        return _find_fresh(self._wanted) if self.leader.follow > 0.0 else None

    @property
    def felt(self) -> Sequence[float] | None:
        """Torques to push the hand with at the moment (n,), Nm; None for none."""
        return _find_fresh(self._felt) if self.leader.feedback > 0.0 else None

    @abstractmethod
    def read_angles(self, now: float) -> Angles:
        """Return the angles of all motors, after at most 10 ms; connect first where that is due.

        Args:
            now: Time on the rig's clock, s.

        Raises:
            HalError: There is no leader, or it is not as it must be; the message has the remedy.
            OSError: Its port does not work.
        """

    def open(self) -> None:
        """Get ready; the motors are looked for by every poll."""
        self.is_open, self._retry_at = True, -math.inf

    def poll(self, now: float, timeout: float) -> PadReading:
        """Return the present state; in real time 100 times a second."""
        if timeout > 0.0:
            wait = min(max(0.0, self._due - monotonic()), timeout)
            sleep(wait)
            now += wait
            self._due = max(self._due + _PERIOD, monotonic())
        if not self.is_open or now < self._retry_at:
            return self._reading
        try:
            self._reading = self._make_reading(self.read_angles(now))
            self._trouble = ""
        except (HalError, OSError) as error:
            self._lose(now, str(error))
        return self._reading

    def _lose(self, now: float, trouble: str) -> None:
        self._trouble, self._retry_at = trouble, now + _RETRY
        self.notes = (f"{self.spec.name}: {trouble}",)
        last = self._reading
        t = now if last.connected else last.t
        self._reading = _AWAY._replace(t=t, t_alive=last.t_alive, t_device=t, seq=last.seq + last.connected)
        self._rested = ()
        self._pressed.held = False

    def _make_reading(self, angles: Angles) -> PadReading:
        last, leader = self._reading, self.leader
        q = self.find_joints(angles.q)
        axes = {"r2": angles.lever} if leader.lever == "gripper" else {}
        if leader.lever == "deadman":
            axes["l2"] = angles.lever
        elif leader.deadman is None:
            axes["l2"] = float(self._is_moved(q, angles.t))
        held = "l2" in axes and self._pressed.update(axes["l2"])
        buttons = frozenset({"l2"} if held else ())
        t, seq = last.t, last.seq
        if (q, axes, buttons) != (last.joints, dict(last.axes), last.buttons):
            t, seq = angles.t, seq + 1
        return PadReading(t, angles.t, t, seq, MappingProxyType(axes), buttons, connected=True, joints=q)

    def find_joints(self, angles: Sequence[float]) -> tuple[float, ...]:
        """Return the joint positions, without leaps where a motor begins another turn.

        The first ones are in the turn nearest to their usual positions: a motor that counts turns may come back from a
        power cycle shifted by some.
        """
        found, last = [], self._reading.joints
        for k, angle in enumerate(angles):
            gain = self.leader.gains[k]
            position = gain * (angle - self.leader.offsets[k])
            turn = 2.0 * math.pi * gain
            found.append(position - turn * round((position - (last[k] if last else self.leader.middles[k])) / turn))
        return tuple(found)

    def _is_moved(self, q: Sequence[float], t: float) -> bool:
        """Return whether the leader was moved lately, for one that has no dead-man."""
        if self._rested and max(abs(a - b) for a, b in zip(q, self._rested, strict=True)) > _STIR:
            self._t_moved, self._rested = t, q
        self._rested = self._rested or q
        return t - self._t_moved < _REST

    @property
    def mapping(self) -> str | None:
        """Name of the mapping for its buttons."""
        return "leader"

    @property
    def control_names(self) -> Mapping[str, str]:
        """Names of its own controls."""
        held = "the lever" if self.leader.lever == "deadman" else "the moving leader"
        return {"l2": held, "r2": "the lever"}

    def describe(self) -> str:
        """Return what it is and where, or why it is not there."""
        where = f"{self.leader.title} at {self.spec.options.get('port', 'no port')}"
        if self._trouble:
            return f"no {where}: {self._trouble}"
        return f"{where}, without torque: {self.limp}" if self.limp else where

    def close(self) -> None:
        """Release the leader."""
        if self.is_open:
            self.is_open = False
            self._lose(self._reading.t, "it is not open")


def _find_fresh(given: tuple[float, Sequence[float]] | None) -> Sequence[float] | None:
    """Return what was given with this time of the monotonic clock, s; None if that was too long ago."""
    return given[1] if given is not None and monotonic() - given[0] < _HEARD else None


class Leader(Gamepad):
    """A leader arm of a rig. Its state has the buttons of the gamepad that is its dead-man, its own lever, and joints.

    ``guard`` is that gamepad; beside a lever that is the dead-man, one for the other buttons; or None.
    """

    def __init__(self, driver: LeaderDriver, guard: Gamepad | None = None) -> None:
        super().__init__(driver)
        self.spec = driver.leader
        self.guard = guard
        self._lever = {"gripper": "r2", "deadman": "l2"}.get(driver.leader.lever, "")
        """Control that its lever is."""
        self._guarded: list[tuple[Deadman, Deadman]] = []
        """Dead-men of the gamepad, and those of the leader that follow them."""

    def state(self) -> PadState:
        """Return the newest state of the leader, with the buttons of its gamepad; never waits."""
        own, name = super().state(), self._lever
        if self.guard is None:
            return own
        pad = self.guard.state()
        axes = {**pad.axes, name: own.axes.get(name, 0.0)} if name else pad.axes
        buttons = (pad.buttons - {name}) | own.buttons if own.connected else frozenset()
        connected = own.connected and (pad.connected or not self.spec.deadman)
        return replace(own, axes=MappingProxyType(dict(axes)), buttons=buttons, connected=connected)

    def wake(self, event: threading.Event) -> None:
        """Set an event whenever the leader or its gamepad changes."""
        super().wake(event)
        if self.guard is not None:
            self.guard.wake(event)

    def hold(self, control: str = "l2") -> Deadman:
        """Return the dead-man switch on a control, which counts as connected only while leader and gamepad are."""
        if self.guard is None or not self.spec.deadman:
            return super().hold(control)
        theirs = self.guard.hold(control)
        with self._lock:
            for known, ours in self._guarded:
                if known is theirs:
                    return ours
            ours = Deadman(f"{theirs.name}, with {self.name}", self.distrust, self.rumble)
            self._guarded.append((theirs, ours))
        theirs.attach(lambda _: self._pass_on())
        return ours

    def _pass_on(self) -> None:
        """Update the dead-men: alive only as long as both devices are."""
        own = self._reading
        for theirs, ours in self._guarded:
            record = theirs.record
            connected = record.connected and own.connected
            ours.update(record.held, connected, min(record.t_alive, own.t_alive))

    def _apply(self, reading: PadReading) -> None:
        super()._apply(reading)
        self._pass_on()

    def distrust(self) -> str | None:
        """Return why it must not lead a real arm at the moment, with the remedy; None if it may."""
        if self.driver.simulated or self.spec.emulated:
            return f"{self.driver.describe()} cannot lead a real arm: no person holds it"
        if not self.spec.may_drive_real:
            return explain_unguarded(self.name)
        return self.guard.distrust() if self.guard is not None and self.spec.deadman else super().distrust()

    def rumble(
        self, *, strong: float = RUMBLE_STRONG, weak: float = RUMBLE_WEAK, seconds: float = RUMBLE_SECONDS
    ) -> bool:
        """Start the motors of its gamepad; False without one."""
        return self.guard is not None and self.guard.rumble(strong=strong, weak=weak, seconds=seconds)

    @property
    def can_hold(self) -> bool:
        """Whether its dead-man can be held down."""
        return self.guard is None or not self.spec.deadman or self.guard.can_hold

    @property
    def finished(self) -> bool:
        """Whether its gamepad is a recording that has come to its end."""
        return self.guard is not None and self.guard.finished

    def control_name(self, control: str) -> str:
        """Return the name of a control, as printed on its gamepad."""
        theirs = self.guard is not None and control != self._lever
        return self.guard.control_name(control) if self.guard and theirs else super().control_name(control)


def make_leader(driver: LeaderDriver, pads: Mapping[str, Gamepad]) -> Leader:
    """Return a leader with its dead-man, or else the first of the rig's gamepads for its buttons."""
    wanted = driver.leader.deadman or next((name for name, pad in pads.items() if not isinstance(pad, Leader)), "")
    return Leader(driver, pads.get(wanted))


def explain_unguarded(name: str) -> str:
    """Return why a leader without a dead-man may not drive a real arm, with the remedy."""
    return (
        f"leaders.{name} has no dead-man, so it cannot lead a real arm: add a pedal or a gamepad to `gamepads`, or "
        "set `lever: deadman`"
    )
