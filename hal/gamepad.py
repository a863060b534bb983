"""A gamepad of a rig: its state, and the dead-man switches on its buttons.

:class:`Gamepad` polls a driver and shapes what it reports. :class:`NeutralGate` keeps controls that were held when the
pad connected from moving anything; :class:`HeldControl` feeds one dead-man switch.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from .deadman import Deadman, Threshold
from .driver import PadReading
from .errors import DeviceNotFound
from .types import AXES, BUTTONS, PadState, Stamp

if TYPE_CHECKING:
    from .driver import GamepadDriver

RUMBLE_STRONG, RUMBLE_WEAK, RUMBLE_SECONDS = 1.0, 0.5, 0.5
"""Default rumble: power of the heavy and of the light motor (0..1), and duration in s. A driver that has to prepare a
rumble prepares this one, so that a trip is felt at once."""
CONTROL_NAMES: Mapping[str, str] = MappingProxyType(
    {
        **{name: name.upper() for name in ("l1", "r1", "l2", "r2", "l3", "r3")},
        **{f"dpad_{axis}": f"D-pad {way}" for axis, way in (("x", "left/right"), ("y", "up/down"))},
        **{
            f"{side}_{axis}": f"{side} stick {way}"
            for side in ("left", "right")
            for axis, way in (("x", "left/right"), ("y", "up/down"))
        },
    }
)
"""Control -> its name in messages, unless the pad has another one printed on it."""
_POLL = 0.01
"""Longest time that a poll may wait for a change, s; also the period in which a dead-man's heartbeat is passed on."""
_AFTER_ERROR = 0.2
"""Pause after an error of the driver, s."""
_JOIN = 2.0
"""Longest wait for the thread to end, s."""
_UNPLUGGED = PadReading(-math.inf, -math.inf, 0.0, 0, MappingProxyType({}), frozenset(), connected=False)


class Gamepad:
    """A gamepad of any make: ``pad.state()``, and ``pad.hold("l2")`` as the dead-man of a control session.

    After the pad is opened or plugged in again, nothing counts until all its sticks and triggers were at rest, and a
    button not until it was seen released. Sticks have a dead zone, the larger of the rig's and the pad's own, and start
    from 0 at its edge. A driver that fails looks like an unplugged pad; :attr:`error` has the reason.

    In real time a thread polls the pad (:meth:`start_thread`), in lock-step the clock does (:meth:`poll_once`).

    Args:
        driver: Driver of the pad.
    """

    guard: Gamepad | None = None
    """Another pad whose buttons it has; None for most (see :class:`hal.leader.Leader`)."""

    def __init__(self, driver: GamepadDriver) -> None:
        self.driver = driver
        self.name = driver.spec.name
        self._error: Exception | None = None
        self._rumble_error: Exception | None = None
        self._gate = NeutralGate()
        self._reading = _UNPLUGGED
        self._state = PadState(Stamp(_UNPLUGGED.t, _UNPLUGGED.t_device, _UNPLUGGED.seq))
        self._held: dict[str, HeldControl] = {}
        self._lock = threading.RLock()
        self._wakers: list[threading.Event] = []
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._open = False

    # State.

    def state(self) -> PadState:
        """Return the newest state; never waits. An unplugged pad has ``connected=False`` and everything released."""
        return self._state

    @property
    def reading(self) -> PadReading:
        """Newest reading of the driver, of which nothing is left out yet."""
        return self._reading

    def wake(self, event: threading.Event) -> None:
        """Set an event whenever an axis, a button or the connection changes, for ``rig.clock.rate(hz, wake=event)``."""
        self._wakers.append(event)

    def hold(self, control: str = "l2") -> Deadman:
        """Return the dead-man switch on a button or trigger; the same object for every call.

        A trigger counts from half of its travel on, until it is back below 0.3.

        Args:
            control: Name of a button, of ``hal.types.BUTTONS``.

        Raises:
            DeviceNotFound: No pad has such a button (``code`` is ``unknown_control``).
        """
        if control not in BUTTONS:
            raise DeviceNotFound(f"{control!r} is no button; buttons: {', '.join(BUTTONS)}", code="unknown_control")
        with self._lock:
            held = self._held.get(control)
            if held is None:
                deadman = Deadman(f"{control} of {self.name}", self.distrust, self.rumble)
                held = self._held[control] = HeldControl(control, deadman)
                held.update(self._reading, gate_open=self._gate.open)
            return held.deadman

    @property
    def error(self) -> Exception | None:
        """Newest error of the driver in polling or rumbling; None if there is none."""
        return self._error or self._rumble_error

    @property
    def waiting_for(self) -> tuple[str, ...]:
        """Controls that must be released, or moved once if the pad has not reported them yet, before the pad counts."""
        return self._gate.waiting_for

    @property
    def reported(self) -> tuple[str, ...]:
        """Axes that the connected pad has, of ``hal.types.AXES``; :meth:`state` always has all of them."""
        axes = self._reading.axes
        return tuple(name for name in AXES if name in axes)

    @property
    def can_hold(self) -> bool:
        """Whether a control can be held down. If not (keys of a terminal), each press is one small step."""
        return self.driver.can_hold

    @property
    def finished(self) -> bool:
        """Whether the pad is a recording that has come to its end."""
        return self.driver.finished

    @property
    def mapping(self) -> str | None:
        """Name of the teleoperation mapping made for the connected pad; None if any mapping fits."""
        return self.driver.mapping

    def rumble(
        self, *, strong: float = RUMBLE_STRONG, weak: float = RUMBLE_WEAK, seconds: float = RUMBLE_SECONDS
    ) -> bool:
        """Start the pad's vibration motors; never waits.

        Args:
            strong: Power of the heavy motor, 0..1.
            weak: Power of the light motor, 0..1.
            seconds: Duration, s.

        Returns:
            Whether the pad vibrates; False for one that cannot, or that is not connected.
        """
        try:
            return self.driver.rumble(_clip_share(strong), _clip_share(weak), seconds if seconds > 0.0 else 0.0)
        except Exception as error:
            self._rumble_error = error
            return False

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the user about this pad, each with the remedy."""
        return self.driver.notes

    def control_name(self, control: str) -> str:
        """Return the name of an axis or a button as printed on the pad that is plugged in: ``south`` is ``Cross``."""
        return self.driver.control_names.get(control) or CONTROL_NAMES.get(control, control)

    def describe(self) -> str:
        """Return a few words that identify the input device."""
        return self.driver.describe()

    def distrust(self) -> str | None:
        """Return why this pad must not be the dead-man of a real arm at the moment, with the remedy; None if it may."""
        driver = self.driver
        if driver.simulated:
            return f"{driver.describe()} cannot be the dead-man of a real arm: no person holds it; plug in a gamepad"
        if driver.proves_liveness or driver.spec.options.get("accept_silent_pad") is True:
            return None
        return (
            f"{driver.describe()} cannot be the dead-man of a real arm: if it falls silent, it cannot be known whether "
            "it is still held; plug the pad in with its cable, or accept that risk with "
            f"gamepads.{self.name}.options.accept_silent_pad: true"
        )

    # Polling.

    def open(self, now: float) -> None:
        """Search for the pad; not finding one is no error. ``now`` is the time on the rig's clock, s."""
        self.driver.open()
        self._open = True
        self.poll_once(now)

    def poll_once(self, now: float) -> None:
        """Take the pad's present state without waiting; ``now`` is the time on the rig's clock, s. For lock-step."""
        self._poll(now, 0.0)

    def start_thread(self, clock_now: Callable[[], float]) -> None:
        """Poll from a thread until :meth:`close`; ``clock_now`` returns the time on the rig's clock, s."""
        if self._thread is not None:
            return
        self._thread = threading.Thread(target=self._run, args=(clock_now,), name=f"hal pad {self.name}", daemon=True)
        self._thread.start()

    def _run(self, clock_now: Callable[[], float]) -> None:
        while not self._stopping.is_set():
            if not self._poll(clock_now(), _POLL):
                self._stopping.wait(_AFTER_ERROR)

    def _poll(self, now: float, timeout: float) -> bool:
        if not self._open:
            return False
        try:
            self._apply(self.driver.poll(now, timeout))
        except Exception as error:
            self._error = error
            self._lose(now)
            return False
        self._error = None
        return True

    def _lose(self, now: float) -> None:
        last = self._state.stamp
        t = now if self._state.connected else last.t
        self._apply(_UNPLUGGED._replace(t=t, t_device=last.t_device, seq=last.seq))

    def _apply(self, reading: PadReading) -> None:
        with self._lock:
            self._reading = reading
            if reading.connected:
                buttons = self._gate.update(reading.axes, reading.buttons, reading.unknown, self.driver.absolute)
            else:
                self._gate.shut()
                buttons = frozenset()
            live = reading.connected and self._gate.open
            values, ignored = reading.axes if live else {}, self._gate.ignored
            axes = {
                name: self._shape_axis(name, values[name]) if name in values and name not in ignored else 0.0
                for name in AXES
            }
            for held in self._held.values():
                held.update(reading, gate_open=live)
            last = self._state
            stamp, where = Stamp(reading.t, reading.t_device, reading.seq), (reading.joints, reading.pose)
            state = PadState(stamp, MappingProxyType(axes), buttons, reading.connected, *where)
            same = (last.axes, last.buttons, last.connected) == (axes, buttons, state.connected)
            same = same and (last.joints, last.pose) == where
            if same and last.stamp == state.stamp:
                return
            self._state = state
        if not same:
            for event in self._wakers:
                event.set()

    def _shape_axis(self, name: str, value: float) -> float:
        if name.startswith("dpad"):
            return apply_dead_zone(value, 0.0)
        return apply_dead_zone(value, max(self.driver.flat.get(name, 0.0), self.driver.spec.dead_zone))

    def close(self) -> None:
        """Stop polling and release the device; every dead-man is released. Idempotent."""
        self._stopping.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(_JOIN)
        if not self._open:
            return
        self._open = False
        self.driver.close()
        self._lose(self._state.stamp.t)


def _clip_share(value: float) -> float:
    """Return ``value`` within 0..1; 0 for NaN."""
    return min(1.0, value) if value > 0.0 else 0.0


class NeutralGate:
    """Blocks a pad's controls until they were all released.

    It opens when every axis is near neutral at the same time, triggers included, and closes when the pad disconnects. A
    button that was pressed when it opened counts only after it was seen released. An absolute axis, which stays where
    it is put, does not keep it closed, and counts only after it was near neutral once.

    Args:
        near: Share of an axis' travel that counts as neutral; more than the drift of a worn stick.
    """

    def __init__(self, near: float = 0.25) -> None:
        self.near = near
        self.open = False
        self._seen_up: frozenset[str] = frozenset()
        self._seen_neutral: frozenset[str] = frozenset()
        self.ignored: frozenset[str] = frozenset()
        """Absolute axes that do not count yet."""
        self.waiting_for: tuple[str, ...] = ()
        """Controls that must be released, or moved once if the pad has not reported them yet; for messages."""

    def shut(self) -> None:
        """Close the gate, because the pad has disconnected."""
        self.open = False
        self._seen_up = self._seen_neutral = frozenset()
        self.waiting_for = ()

    def update(
        self,
        axes: Mapping[str, float],
        buttons: frozenset[str],
        unknown: Collection[str],
        absolute: Collection[str] = (),
    ) -> frozenset[str]:
        """Take a state of the connected pad.

        Returns:
            The buttons that count; :attr:`ignored` has the axes that do not.
        """
        if absolute:
            self._seen_neutral |= {x for x in absolute if x not in unknown and abs(axes.get(x, 1.0)) <= self.near}
            self.ignored = frozenset(absolute) - self._seen_neutral
        if not self.open:
            held = (name for name in AXES if name not in absolute)
            away = tuple(name for name in held if name in unknown or not abs(axes.get(name, 0.0)) <= self.near)
            self.open = not away
            unreported = bool(axes) and all(name in unknown for name in axes)
            self.waiting_for = ("any control: the pad has sent nothing yet",) if unreported else away
        if not self.open:
            return frozenset()
        self._seen_up |= frozenset(BUTTONS) - buttons
        self.waiting_for = tuple(name for name in BUTTONS if name not in self._seen_up)
        return buttons & self._seen_up


class HeldControl:
    """The button or trigger of a pad on which one dead-man switch is."""

    def __init__(self, control: str, deadman: Deadman) -> None:
        self.control = control
        self.deadman = deadman
        self._threshold = Threshold()

    def update(self, reading: PadReading, *, gate_open: bool) -> None:
        """Pass a reading on to the switch; nothing counts before the pad's :class:`NeutralGate` is open."""
        if not gate_open:
            self._threshold.held = False
            pressed = True  # not a release, which would arm the switch
        elif self.control in reading.axes:  # a trigger
            pressed = self._threshold.update(reading.axes[self.control])
        else:
            pressed = self.control in reading.buttons
        self.deadman.update(pressed, reading.connected, reading.t_alive)


def apply_dead_zone(value: float, zone: float) -> float:
    """Return ``value`` (-1..1), cut to 0 within ``zone`` and stretched to start from 0 at its edge; 0 for NaN."""
    if not abs(value) > zone or zone >= 1.0:
        return 0.0
    return math.copysign(min(1.0, (abs(value) - zone) / (1.0 - zone)), value)
