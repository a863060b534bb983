"""A gamepad: the driver's abstract class and the public class."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from ._moved import names_of
from .deadman import Deadman, Threshold
from .driver import GamepadDriver, PadReading
from .errors import DeviceNotFound
from .types import AXES, BUTTONS, PadState, Stamp

if TYPE_CHECKING:
    pass

__all__ = [
    "CONTROL_NAMES",
    "Gamepad",
    "HeldControl",
    "NeutralGate",
    "RUMBLE_SECONDS",
    "RUMBLE_STRONG",
    "RUMBLE_WEAK",
    "without_dead_zone",
]

# [controls.py] What one control of a pad means: an axis without its dead zone, a button or trigger that is held.


def without_dead_zone(value: float, zone: float) -> float:
    """``value`` (-1..1) with the part nearer to 0 than ``zone`` cut out, and the rest stretched to start from 0.

    What is not a number is 0.
    """
    if not abs(value) > zone or zone >= 1.0:
        return 0.0
    return math.copysign(min(1.0, (abs(value) - zone) / (1.0 - zone)), value)


class HeldControl:
    """Reads one button or trigger of a pad for its dead-man."""

    def __init__(self, control: str, deadman: Deadman) -> None:
        self.control = control
        self.deadman = deadman
        self._threshold = Threshold()

    def update(self, reading: PadReading, *, gate_open: bool) -> None:
        """Take a reading; before the pad's :class:`~hal.gamepad.NeutralGate` is open nothing counts."""
        if not gate_open:
            self._threshold.held = False
            pressed = True  # so this is no release, which would arm the switch
        elif self.control in ("l2", "r2") and self.control in reading.axes:
            pressed = self._threshold.update(reading.axes[self.control])
        else:
            pressed = self.control in reading.buttons
        self.deadman.update(pressed, reading.connected, reading.t_alive)


# [neutral.py] Nothing that was held when a pad came (back) may move anything.


class NeutralGate:
    """Lets a pad's controls through once its hands are off it.

    It opens when every axis was near neutral at the same time, triggers let go of included, and shuts again when the
    pad disconnects. A button that was down at that moment counts only after it was seen up.
    """

    def __init__(self, near: float = 0.25) -> None:
        """``near``: share of an axis' travel that counts as neutral; more than a worn stick's drift."""
        self.near = near
        self.open = False
        self._seen_up: frozenset[str] = frozenset()
        self.waiting_for: tuple[str, ...] = ()
        """Controls that must be let go of (or, if the pad never spoke of them, moved once), for people."""

    def shut(self) -> None:
        """The pad is gone."""
        self.open = False
        self._seen_up = frozenset()
        self.waiting_for = ()

    def update(self, axes: Mapping[str, float], buttons: frozenset[str], unknown: Collection[str]) -> frozenset[str]:
        """Take a reading of a pad that is connected; the buttons that count come back."""
        if not self.open:
            away = tuple(name for name in AXES if name in unknown or not abs(axes.get(name, 0.0)) <= self.near)
            self.open = not away
            silent = bool(axes) and all(name in unknown for name in axes)
            self.waiting_for = ("any control: the pad has said nothing yet",) if silent else away
        if not self.open:
            return frozenset()
        self._seen_up |= frozenset(BUTTONS) - buttons
        self.waiting_for = tuple(name for name in BUTTONS if name not in self._seen_up)
        return buttons & self._seen_up


RUMBLE_STRONG, RUMBLE_WEAK, RUMBLE_SECONDS = 1.0, 0.5, 0.5
"""How a pad rumbles unless told otherwise: shares of what its heavy and its light motor can, and s. A driver that must
prepare a rumble prepares this one, so that a trip is felt at once."""

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

_POLL = 0.01  # s; how long a poll may wait for news, and so how often a dead-man's heartbeat is passed on
_AFTER_ERROR = 0.2  # s
_JOIN = 2.0  # s


_NOTHING = PadReading(-math.inf, -math.inf, 0.0, 0, MappingProxyType({}), frozenset(), connected=False)


class Gamepad:
    """A pad, whatever its make: ``pad.state()``, and ``pad.hold("l2")`` as the dead-man of a control session.

    After it was opened or plugged in again nothing counts until all its sticks and triggers were at rest, and a
    button not until it was seen up. Sticks have a dead zone, the rig's or the pad's own, whichever is larger, and
    start from 0 at its edge.

    It is polled by its own thread in real time (:meth:`start_thread`), or by the clock in lock-step
    (:meth:`poll_once`). A driver that fails looks like a pad that is unplugged; :attr:`error` says why.
    """

    def __init__(self, driver: GamepadDriver) -> None:
        self.driver = driver
        self.name = driver.spec.name
        self._error: Exception | None = None
        self._rumble_error: Exception | None = None
        self._gate = NeutralGate()
        self._reading = _NOTHING
        self._state = PadState(Stamp(_NOTHING.t, _NOTHING.t_device, _NOTHING.seq))
        self._held: dict[str, HeldControl] = {}
        self._lock = threading.RLock()
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._open = False

    # What it says.

    def state(self) -> PadState:
        """The newest state. Never waits; a pad that is gone has ``connected=False`` and everything released."""
        return self._state

    def wait(self, timeout: float) -> PadState:
        """The state after its next change, or the present one after ``timeout`` s. For a pad with its own thread."""
        seen = self._state
        with self._changed:
            self._changed.wait_for(lambda: self._state is not seen or self._stopping.is_set(), timeout)
        return self._state

    def hold(self, control: str = "l2") -> Deadman:
        """The dead-man switch on a button or trigger: the same object every time.

        A trigger counts from half its travel on, until it is back below 0.3. Raises DeviceNotFound for a control
        that no pad has.
        """
        if control not in BUTTONS:
            raise DeviceNotFound(f"{control!r} is no button; buttons: {', '.join(BUTTONS)}")
        with self._lock:
            held = self._held.get(control)
            if held is None:
                deadman = Deadman(f"{control} of {self.name}", self.distrust, self.rumble)
                held = self._held[control] = HeldControl(control, deadman)
                held.update(self._reading, gate_open=self._gate.open)
            return held.deadman

    @property
    def error(self) -> Exception | None:
        """The newest error of the driver in polling or rumbling; None while there is none."""
        return self._error or self._rumble_error

    @property
    def waiting_for(self) -> tuple[str, ...]:
        """Controls that must be let go of before the pad counts. A pad that never reported an axis wants it moved."""
        return self._gate.waiting_for

    @property
    def reported(self) -> tuple[str, ...]:
        """The axes that the pad which is plugged in has, of ``hal.types.AXES``; :meth:`state` has all of them."""
        axes = self._reading.axes
        return tuple(name for name in AXES if name in axes)

    @property
    def can_hold(self) -> bool:
        """Can a control be held down? Where not (a terminal's keys), each press is one small step."""
        return self.driver.can_hold

    @property
    def finished(self) -> bool:
        """Is it a recording that has come to its end?"""
        return self.driver.finished

    @property
    def mapping(self) -> str | None:
        """Teleoperation mapping that is meant for the pad that is plugged in; None where any will do."""
        return self.driver.mapping

    def rumble(
        self, *, strong: float = RUMBLE_STRONG, weak: float = RUMBLE_WEAK, seconds: float = RUMBLE_SECONDS
    ) -> bool:
        """Shake the hand that holds the pad: shares of what its heavy and its light motor can (0..1), and s.

        Returns at once: True where the pad will. One that cannot, or is not plugged in, is no error.
        """
        try:
            return self.driver.rumble(_share(strong), _share(weak), seconds if seconds > 0.0 else 0.0)
        except Exception as error:
            self._rumble_error = error
            return False

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know about the pad, each with what mends it."""
        return self.driver.notes

    def control_name(self, control: str) -> str:
        """Return the name of an axis or a button as printed on the pad that is plugged in: ``south`` is ``Cross``."""
        return self.driver.control_names.get(control) or CONTROL_NAMES.get(control, control)

    def describe(self) -> str:
        """What drives, in words."""
        return self.driver.describe()

    def distrust(self) -> str | None:
        """Why this pad may not be the dead-man of a real arm at the moment, with the remedy; None where it may."""
        driver = self.driver
        if driver.simulated:
            return f"{driver.describe()} cannot be the dead-man of a real arm: nobody holds it; plug a gamepad in"
        if driver.proves_liveness or driver.spec.options.get("accept_silent_pad") is True:
            return None
        return (
            f"{driver.describe()} cannot be the dead-man of a real arm: when it falls silent, nothing tells whether "
            "it is still held; plug the pad in with its cable, or accept that risk with "
            f"gamepads.{self.name}.options.accept_silent_pad: true"
        )

    # Being polled.

    def open(self, now: float) -> None:
        """Look for the pad; ``now`` is the time on the rig's clock, s. Not finding one is no error."""
        self.driver.open()
        self._open = True
        self.poll_once(now)

    def poll_once(self, now: float) -> None:
        """Take what is there at ``now`` (s), without waiting. The lock-step clock calls this."""
        self._poll(now, 0.0)

    def start_thread(self, clock_now: Callable[[], float]) -> None:
        """Poll from a thread of its own until :meth:`close`; ``clock_now`` gives the time on the rig's clock, s."""
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
            self._take(self.driver.poll(now, timeout))
        except Exception as error:
            self._error = error
            self._lose(now)
            return False
        self._error = None
        return True

    def _lose(self, now: float) -> None:
        last = self._state.stamp
        t = now if self._state.connected else last.t
        self._take(_NOTHING._replace(t=t, t_device=last.t_device, seq=last.seq))

    def _take(self, reading: PadReading) -> None:
        with self._lock:
            self._reading = reading
            if reading.connected:
                buttons = self._gate.update(reading.axes, reading.buttons, reading.unknown)
            else:
                self._gate.shut()
                buttons = frozenset()
            live = reading.connected and self._gate.open
            axes = {name: self._shaped(name, reading.axes.get(name, 0.0)) if live else 0.0 for name in AXES}
            for held in self._held.values():
                held.update(reading, gate_open=live)
            last = self._state
            state = PadState(
                Stamp(reading.t, reading.t_device, reading.seq), MappingProxyType(axes), buttons, reading.connected
            )
            if (last.stamp, last.axes, last.buttons, last.connected) == (state.stamp, axes, buttons, state.connected):
                return
            self._state = state
        with self._changed:
            self._changed.notify_all()

    def _shaped(self, name: str, value: float) -> float:
        if name.startswith("dpad"):
            return without_dead_zone(value, 0.0)
        return without_dead_zone(value, max(self.driver.flat.get(name, 0.0), self.driver.spec.dead_zone))

    def close(self) -> None:
        """Stop polling and let go of the device; every dead-man is released. Idempotent."""
        self._stopping.set()
        with self._changed:
            self._changed.notify_all()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(_JOIN)
        if not self._open:
            return
        self._open = False
        self.driver.close()
        self._lose(self._state.stamp.t)


def _share(value: float) -> float:
    """0..1; what is not a number is 0."""
    return min(1.0, value) if value > 0.0 else 0.0


__getattr__ = names_of(__name__)
