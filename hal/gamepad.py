"""A gamepad: the driver's abstract class and the public class."""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from .deadman import Deadman
from .errors import DeviceNotFound
from .pads.controls import HeldControl, without_dead_zone
from .pads.neutral import NeutralGate
from .types import AXES, BUTTONS, PadState, Stamp

if TYPE_CHECKING:
    from .specs import PadSpec

__all__ = ["RUMBLE_SECONDS", "RUMBLE_STRONG", "RUMBLE_WEAK", "Gamepad", "GamepadDriver", "PadReading", "Plugged"]

RUMBLE_STRONG, RUMBLE_WEAK, RUMBLE_SECONDS = 1.0, 0.5, 0.5
"""How a pad rumbles unless told otherwise: shares of what its heavy and its light motor can, and s. A driver that must
prepare a rumble prepares this one, so that a trip is felt at once."""

_POLL = 0.01  # s; how long a poll may wait for news, and so how often a dead-man's heartbeat is passed on
_AFTER_ERROR = 0.2  # s
_JOIN = 2.0  # s


class PadReading(NamedTuple):
    """What a gamepad driver reports. Canonical names (``hal.types.AXES``, ``BUTTONS``), no dead zone applied yet."""

    t: float
    """Time of the newest event, on the host's clock, s."""
    t_alive: float
    """When the driver last had proof that the pad is there and speaking, s. The dead-man's watchdog looks at this."""
    t_device: float
    seq: int
    """Counts events."""
    axes: Mapping[str, float]
    """Sticks -1..1, right and up positive; triggers 0..1. A trigger that is only a button is 0 or 1, or left out."""
    buttons: frozenset[str]
    connected: bool
    unknown: Collection[str] = ()
    """Axes that the pad has not spoken of yet; they show 0, and nothing counts until they were moved."""


class Plugged(NamedTuple):
    """What a driver could open."""

    pads: tuple[str, ...]
    """Pads that are there, in words."""
    notes: tuple[str, ...] = ()
    """What stands in the way of others, each with the command that mends it."""
    devices: tuple[str, ...] = ()
    """What ``options.device`` of a rig calls each of :attr:`pads`, where the driver has such an option."""


_NOTHING = PadReading(-math.inf, -math.inf, 0.0, 0, MappingProxyType({}), frozenset(), connected=False)


class GamepadDriver(ABC):
    """One pad. ``poll`` is called for as long as the rig is open, from one thread; a pad that is not plugged in is
    not an error but a reading with ``connected=False``, and comes back by itself when it is plugged in again.
    """

    simulated: ClassVar[bool] = False
    proves_liveness: bool = False
    """True where silence means that the pad is gone (unplugging is seen, or the pad streams), so that its buttons
    may serve as a dead-man on a real arm. It may change when another pad is plugged in."""

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        self.spec = spec
        self.source = source
        """Where a pad that lives in another process gets its record from; for ``playback``, the world's time."""
        self.notes: tuple[str, ...] = ()
        """What a person should know about the pad, each with what mends it."""
        self.flat: Mapping[str, float] = MappingProxyType({})
        """Axis -> share of its travel that the pad itself calls neutral."""

    @classmethod
    def plugged(cls) -> Plugged:
        """What could be opened at the moment. Quick, opens nothing, and never raises for what is not there."""
        return Plugged(())

    @abstractmethod
    def open(self) -> None:
        """Look for the pad."""

    @abstractmethod
    def poll(self, now: float, timeout: float) -> PadReading:
        """The present reading; waits up to ``timeout`` s for news. ``now`` is the time on ``rig.clock``."""

    def describe(self) -> str:
        """What drives, in words, for the banner."""
        return type(self).__name__

    def details(self) -> Mapping[str, str]:
        """What is known of the pad that is plugged in, for a person who has trouble with it: what -> in words."""
        return {}

    @property
    def mapping(self) -> str | None:
        """Teleoperation mapping that is meant for the pad that is plugged in; None where any will do."""
        return None

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        """Let the pad's motors shake the hand: shares of what they can (0..1), and how long, s. True where they will.

        Returns at once, from whatever thread it is called.
        """
        return False

    @property
    def can_hold(self) -> bool:
        """Can a control be held down? Where not (a terminal's keys), each press is one small step."""
        return True

    @property
    def finished(self) -> bool:
        """Has it nothing more to say? Only a recording ends."""
        return False

    @abstractmethod
    def close(self) -> None:
        """Let go of the device. Idempotent."""


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
        self._callback_error: Exception | None = None
        self._gate = NeutralGate()
        self._reading = _NOTHING
        self._state = PadState(Stamp(_NOTHING.t, _NOTHING.t_device, _NOTHING.seq))
        self._held: dict[str, HeldControl] = {}
        self._listeners: dict[object, Callable[[PadState], None]] = {}
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

    def on_change(self, callback: Callable[[PadState], None]) -> Callable[[], None]:
        """Call ``callback`` with every new state, from the polling thread; the function that comes back ends that.

        An exception in it ends it too, and is kept as :attr:`error`.
        """
        token = object()
        with self._lock:
            self._listeners[token] = callback

        def detach() -> None:
            with self._lock:
                self._listeners.pop(token, None)

        return detach

    @property
    def error(self) -> Exception | None:
        """What went wrong last in the driver or in a callback; None while all is well."""
        return self._error or self._callback_error

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
            self._callback_error = error
            return False

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know about the pad, each with what mends it."""
        return self.driver.notes

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
            listeners = tuple(self._listeners.items())
        for token, callback in listeners:
            self._tell(token, callback, state)
        with self._changed:
            self._changed.notify_all()

    def _tell(self, token: object, callback: Callable[[PadState], None], state: PadState) -> None:
        try:
            callback(state)
        except Exception as error:
            self._callback_error = error
            with self._lock:
                self._listeners.pop(token, None)

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
