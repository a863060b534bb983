"""The page as a gamepad: the app's side."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from hal import registry
from hal.driver import GamepadDriver, PadReading
from hal.errors import NotSupported
from hal.gamepad import CONTROL_NAMES
from hal.pads.choice import play_tour
from hal.pads.keyboard import keyboard_table
from hal.servo.watchdog import PAD_SILENCE
from hal.specs import PadSpec
from hal.types import AXES, BUTTONS, PAGE_AXES

_RELEASED: Mapping[str, float] = MappingProxyType(dict.fromkeys(AXES, 0.0))
_LOST_TIME = 0.05
"""A pad that was lost stays lost for at least so long, in s, so that every servo sees it: a window that gets the focus
back at once, or another page that takes control, would otherwise look like a mere release."""
_PRESSED = 0.5
"""Share of a trigger's travel from which it counts as pressed."""
_MAX_WAITING = 64
"""Readings that may wait for the app: 1.3 s of a pad that sends 50 a second."""


def pad_reading(message: Mapping[str, Any], hand: str = "any", deadman: str = "l2") -> PadReading:
    """Return the reading in a message of the console's process, which has checked the numbers.

    The reading has the time at which the page was provably in this state, which is the earliest at which an event can
    have happened: latencies are never too short.

    Args:
        message: The message.
        hand: ``left`` or ``right`` for the pad of that hand, which nothing else on the page moves; else ``any``.
        deadman: Button that such a hand holds.
    """
    if not message["connected"]:
        return lost_reading(float(message["t"]))
    t = float(message["t_alive"])
    *pose, grip = map(float, message["hands"].get(hand, [0.0]))
    if hand == "any":
        mask = int(message["buttons"])
        axes = dict(zip(PAGE_AXES, map(float, message["axes"]), strict=True))
        buttons = {name for bit, name in enumerate(BUTTONS) if mask >> bit & 1}
    else:
        buttons = {deadman} if pose else set()
        axes = {name: float(name in buttons) for name in PAGE_AXES}
    axes["r2"] = max(axes["r2"], grip)
    if grip > _PRESSED:
        buttons.add("r2")
    return PadReading(t, t, t, 0, MappingProxyType(axes), frozenset(buttons), connected=True, pose=tuple(pose))


def lost_reading(t: float) -> PadReading:
    """Return the reading of a pad without a page, at ``t`` (s)."""
    return PadReading(t, -math.inf, t, 0, _RELEASED, frozenset(), connected=False)


class PadQueue:
    """Readings on their way from the thread that receives them to the thread that polls the pad.

    Each is handed out once, in order, so that no press and no interruption is missed. If the app is so late that too
    many wait, only the newest is kept, with a lost pad before it.
    """

    def __init__(self, hand: str = "any") -> None:
        self.hand = hand
        """Whose readings it gets, see :func:`pad_reading`."""
        self._changed = threading.Condition()
        self._waiting: deque[PadReading] = deque()
        self._last = lost_reading(-math.inf)

    def put(self, new: PadReading) -> None:
        """Add a reading."""
        with self._changed:
            if len(self._waiting) >= _MAX_WAITING:
                self._waiting.clear()
                self._waiting.append(lost_reading(new.t))
            self._waiting.append(new)
            self._changed.notify()

    def pop(self, timeout: float) -> PadReading:
        """Return the next reading; after ``timeout`` s without one, the last one again."""
        with self._changed:
            if self._changed.wait_for(lambda: self._waiting, timeout):
                self._last = self._waiting.popleft()
            return self._last


class WebPad(GamepadDriver):
    """The pad of the page in control, or one hand of its headset (``options.hand``).

    ``source`` is the rig's console (:class:`~.console.WebConsole`).

    The page's main thread sends the whole pad 50 times a second, and each message proves when the page was alive at the
    latest (:class:`~.session.PadWatch`), so silence is noticed: a frozen browser, a hidden tab and a cut cable all stop
    the arm. That the *person* is there is proven by the finger on the dead-man alone, as with every pad.

    In simulation, a page may start the recorded tour. It replaces the page's pad until it ends, the page is gone, a
    button is pressed on the page, or the arms are stopped.
    """

    proves_liveness = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._console: Any = source
        self._queue = PadQueue()
        self._reported = lost_reading(-math.inf)
        self._lost_until = -math.inf
        self._tour: GamepadDriver | None = None
        self._stop_count = 0
        """Stop count when the tour began. A further stop ends the tour, which could not acknowledge it."""
        self._wanted: bool | None = None
        """Whether to start (True) or end the tour in the next poll; None for neither."""
        self._open = False

    def open(self) -> None:
        if not hasattr(self.source, "subscribe"):
            raise NotSupported("the web pad needs the rig's console: open the rig with pad='web'", code="no_console")
        self._queue = self._console.subscribe(self.spec.hand or "any")
        self._open = True

    def play(self, on: bool) -> None:
        """Start the recorded tour, or end it, in the next poll. Only for rigs on which nothing real moves."""
        self._wanted = on

    def poll(self, now: float, timeout: float) -> PadReading:
        wanted, self._wanted = self._wanted, None
        if wanted is not None and wanted != (self._tour is not None):
            return self._start_tour(now) if wanted else self._end_tour(now)
        if self._tour is None:
            found = self._queue.pop(timeout)
            silent = now - found.t_alive > PAD_SILENCE  # the console's process hangs, or is stopped
            return self._report(found if self._open and not silent else lost_reading(found.t), now)
        page = self._queue.pop(0.0)
        watched = page.connected and now - page.t_alive <= PAD_SILENCE
        if page.buttons or not watched or self._tour.finished or self._console.stop_count != self._stop_count:
            return self._end_tour(now)
        return self._report(self._tour.poll(now, timeout), now)

    # At both ends of the tour the pad is lost for a moment: nothing held on one pad moves the arm with the other.

    def _start_tour(self, now: float) -> PadReading:
        recorded = play_tour(self.spec)
        self._tour = registry.load(recorded.driver, "gamepad")(replace(recorded, name=self.spec.name), None)
        self._tour.open()
        self._stop_count = self._console.stop_count
        self._console.show_playing(True)
        return self._report(lost_reading(now), now)

    def _end_tour(self, now: float) -> PadReading:
        if self._tour is not None:
            self._tour.close()
            self._tour = None
        self._console.show_playing(False)
        return self._report(lost_reading(now), now)

    def _report(self, found: PadReading, now: float) -> PadReading:
        """Return ``found`` as the next reading: a change of the controls is an event, a repetition a sign of life."""
        last = self._reported
        if not found.connected and last.connected:
            self._lost_until = now + _LOST_TIME
        elif found.connected and now < self._lost_until:
            found = lost_reading(found.t)
        if found[4:] == last[4:]:  # axes, buttons, connection, pose
            self._reported = last._replace(t_alive=max(last.t_alive, found.t_alive))
        else:
            t = max(last.t, found.t)
            self._reported = found._replace(t=t, t_device=t, seq=last.seq + 1)
        return self._reported

    @property
    def control_names(self) -> Mapping[str, str]:
        """The keys of the page; for the dead-man and buttons with the gamepad's control, which the page shows too."""
        if self.spec.hand:
            return {self._console.deadman: f"the {self.spec.hand} squeeze", "r2": "the trigger"}
        keys = keyboard_table("browser").names
        named = {name for name in keys if name in BUTTONS and name in CONTROL_NAMES}
        return {name: f"{key} ({CONTROL_NAMES[name]})" if name in named else key for name, key in keys.items()}

    def describe(self) -> str:
        page = self._console.driver
        hand = f"the {self.spec.hand} hand in a " if self.spec.hand else ""
        return f"{hand}browser ({page or 'no one connected'})"

    def close(self) -> None:
        if self._tour is not None:
            self._tour.close()
            self._tour = None
        self._open = False


def check_hand(spec: PadSpec) -> Iterator[tuple[str, str, str]]:
    """Yield what is wrong with a pad's options, as :attr:`hal.registry.DriverSpec.checks`."""
    if spec.hand not in ("", "left", "right"):
        yield "options.hand", f"is left or right, not {spec.hand!r}", "unknown_hand"
