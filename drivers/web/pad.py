"""The page as a gamepad: the app's side."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Protocol

from hal import registry
from hal.driver import GamepadDriver, PadReading
from hal.errors import NotSupported
from hal.pads.choice import tour
from hal.servo.watchdog import PAD_SILENCE
from hal.specs import PadSpec
from hal.types import AXES, BUTTONS

__all__ = ["PadMail", "PadSource", "WebPad", "gone", "reading"]

_RELEASED: Mapping[str, float] = MappingProxyType(dict.fromkeys(AXES, 0.0))
_GONE = 0.05
"""A pad that was lost stays lost for at least so long, s, so that every servo sees it: a window that has the focus back
at once, or another page that takes over, would otherwise look like a mere release."""
_WAITING = 64
"""Messages that may wait for the app: 1.3 s of a pad that speaks 50 times a second."""


def reading(message: Mapping[str, Any], seq: int) -> PadReading:
    """What the console's process says of the page's pad. It has checked the numbers.

    An event counts from when the page was provably alive, which is the earliest that it can have happened: latencies
    are never too short.
    """
    if not message["connected"]:
        return gone(float(message["t"]), seq)
    t = float(message["t_alive"])
    mask = int(message["buttons"])
    return PadReading(
        t=t,
        t_alive=t,
        t_device=t,
        seq=seq,
        axes=MappingProxyType(dict(zip(AXES, map(float, message["axes"]), strict=False))),  # a page has the first ones
        buttons=frozenset(name for bit, name in enumerate(BUTTONS) if mask >> bit & 1),
        connected=True,
    )


def gone(t: float, seq: int) -> PadReading:
    """No page drives."""
    return PadReading(t, -math.inf, t, seq, _RELEASED, frozenset(), connected=False)


class PadMail:
    """Readings on their way from the thread that hears the page to the thread that polls the pad.

    Each is handed out, in order, so that no press and no interruption is missed. Should the app be so late that too
    many wait, they count as an interruption: only the newest is kept, with a lost pad before it.
    """

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._waiting: deque[PadReading] = deque()
        self._last = gone(-math.inf, 0)

    def put(self, new: PadReading) -> None:
        """Hand in the next one."""
        with self._news:
            if len(self._waiting) >= _WAITING:
                self._waiting.clear()
                self._waiting.append(gone(new.t, new.seq))
            self._waiting.append(new)
            self._news.notify()

    def take(self, timeout: float) -> PadReading:
        """The next one; after ``timeout`` s without any, the last one again."""
        with self._news:
            if self._news.wait_for(lambda: self._waiting, timeout):
                self._last = self._waiting.popleft()
            return self._last


class PadSource(Protocol):
    """What :class:`WebPad` asks of the console."""

    def subscribe(self) -> PadMail:
        """What the page does with its pad, from now on; each pad of a rig that is the page's has a mail of its own."""

    @property
    def driver(self) -> str | None:
        """The page that drives."""

    @property
    def stops(self) -> int:
        """How often ``rig.stop()`` was called."""

    def show_playing(self, on: bool) -> None:
        """Tell the pages whether the recorded tour is being played."""


class WebPad(GamepadDriver):
    """The page that holds the lease; ``source`` is a :class:`PadSource`, the rig's console.

    Its main thread sends the whole pad 50 times a second, and each message proves when it was alive at the latest
    (:mod:`.padmessage`), so silence is noticed: a frozen browser, a hidden tab and a cut cable all let the arm stop.
    That the *person* is there is proven by a finger on the dead-man alone, as with every pad.

    In simulation, a page may ask for the recorded tour; it is played in the place of the page's pad until it ends, the
    page is gone, its person touches a button, or somebody stops the arms.
    """

    proves_liveness = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._mail = PadMail()
        self._told = gone(-math.inf, 0)
        self._gone_until = -math.inf
        self._tour: GamepadDriver | None = None
        self._stops = 0
        """Calls of ``rig.stop()`` when the tour began: one more ends it, for nobody is there to acknowledge it."""
        self._wanted: bool | None = None
        """Somebody asked for the tour, or for its end."""
        self._open = False

    @property
    def _console(self) -> PadSource:
        source: PadSource = self.source  # type: ignore[assignment]  # checked by open
        return source

    def open(self) -> None:
        if not hasattr(self.source, "subscribe"):
            raise NotSupported("the page drives a rig that was opened with its console: pad='web'")
        self._mail = self._console.subscribe()
        self._open = True

    def play(self, on: bool) -> None:
        """Play the recorded tour, or end it; in the next poll. Only for rigs on which nothing real moves."""
        self._wanted = on

    def poll(self, now: float, timeout: float) -> PadReading:
        wanted, self._wanted = self._wanted, None
        if wanted is not None and wanted != (self._tour is not None):
            return self._begin(now) if wanted else self._end(now)
        if self._tour is None:
            found = self._mail.take(timeout)
            silent = now - found.t_alive > PAD_SILENCE  # the console's process hangs, or is stopped
            return self._tell(found if self._open and not silent else gone(found.t, 0), now)
        page = self._mail.take(0.0)
        watched = page.connected and now - page.t_alive <= PAD_SILENCE
        if page.buttons or not watched or self._tour.finished or self._console.stops != self._stops:
            return self._end(now)
        return self._tell(self._tour.poll(now, timeout), now)

    def _begin(self, now: float) -> PadReading:
        self._tour = registry.load("playback", "gamepad")(replace(tour(self.spec), name=self.spec.name), None)
        self._tour.open()
        self._stops = self._console.stops
        self._console.show_playing(True)
        return self._tell(gone(now, 0), now)

    def _end(self, now: float) -> PadReading:
        """Between the tour and the page the pad is gone for a moment: nothing that is held on one moves the other."""
        if self._tour is not None:
            self._tour.close()
            self._tour = None
        self._console.show_playing(False)
        return self._tell(gone(now, 0), now)

    def _tell(self, found: PadReading, now: float) -> PadReading:
        """Only a change of the controls is an event; what the page repeats proves that it is alive."""
        last = self._told
        if not found.connected and last.connected:
            self._gone_until = now + _GONE
        elif found.connected and now < self._gone_until:
            found = gone(found.t, 0)
        same = (found.axes, found.buttons, found.connected) == (last.axes, last.buttons, last.connected)
        if same:
            self._told = last._replace(t_alive=max(last.t_alive, found.t_alive))
        else:
            t = max(last.t, found.t)
            self._told = found._replace(t=t, t_device=t, seq=last.seq + 1)
        return self._told

    def describe(self) -> str:
        page = self._console.driver
        return f"browser ({page})" if page else "browser (no one connected)"

    def close(self) -> None:
        if self._tour is not None:
            self._tour.close()
            self._tour = None
        self._open = False
