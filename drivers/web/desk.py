"""Where the pages' messages end up: who drives, what the app is told, and what the pages are told."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from hal.servo.watchdog import PAD_SILENCE
from hal.types import BUTTONS, STICK_AXES

from .applink import Waiting
from .lease import Change, Lease
from .messages import CLOSED, Act, Away, Demo, Malformed, Recover, Setting, Stop, Take, encode, parse
from .outbox import Outbox
from .padmessage import PadMessage

__all__ = ["App", "Desk", "Page"]

_UNHEARD = f"{{}}: the connection is too slow to drive (a round trip may take {1e3 * PAD_SILENCE:g} ms at most)"
_COMPLAINT = 2.0
"""s between two complaints to one page about that."""
_SAYS = 50
"""What the app said last, for pages that open."""


class App(Protocol):
    """The app, as the desk sees it: see :class:`~.applink.AppLink`."""

    waiting: Waiting

    def flush(self) -> None:
        """Send what waits."""


class Page:
    """A page that is open."""

    def __init__(self, number: int, overflow: Callable[[], None]) -> None:
        self.number = number
        self.name = f"page {number}"
        self.outbox = Outbox(overflow)
        self.complained = -math.inf
        """When it was last told that its pad comes too late, s."""


class Desk:
    """Every rule of the console that does not need a socket. One thread."""

    def __init__(self, rig: Mapping[str, Any], app: App, clock: Callable[[], float] = time.monotonic) -> None:
        self._rig = rig
        self._robots = frozenset(robot["name"] for robot in rig["robots"])
        self._app = app
        self._clock = clock
        self._opened = 0
        self._lease = Lease()
        self._labels: str | None = None
        self._says: deque[str] = deque(maxlen=_SAYS)
        self._waiting_for: list[str] = []
        self._recording: str | None = None
        self._driving: str | None = None
        self._settings: frozenset[str] = frozenset()
        self._possible: frozenset[str] = frozenset()
        self.pages: dict[str, Page] = {}
        self.playing = False

    # Pages come and go.

    def open(self, overflow: Callable[[], None]) -> Page:
        """A page opens. ``overflow`` is called when it takes so little of what it is told that it missed something."""
        self._opened += 1
        page = Page(self._opened, overflow)
        self.pages[page.name] = page
        page.outbox.note(self._hello(page))
        if self._labels is not None:
            page.outbox.note(self._labels)
        if self._driving is not None:
            page.outbox.note(self._driving)
        self._tell_lease(page, self._clock())
        page.outbox.note(self._pad_waits())
        for text in self._says:
            page.outbox.note(text)
        if self._recording is not None:
            page.outbox.newest("recording", self._recording)
        return page

    def _hello(self, page: Page) -> str:
        hello = {"type": "hello", "page": page.number, "name": page.name, "axes": STICK_AXES, "buttons": BUTTONS}
        return encode(hello | {"rig": self._rig})

    def leave(self, page: Page) -> None:
        """A page is gone, or about to be: whatever it held, it holds no more. Idempotent."""
        if self.pages.pop(page.name, None) is not None:
            self._change(self._lease.let_go(page.name, self._clock(), CLOSED))

    # What pages say.

    def received(self, page: Page, text: str) -> None:
        """A page said something. Raises Malformed; then nothing of it counted."""
        message = parse(text, self._robots)
        if isinstance(message, PadMessage):
            self._take_pad(page, message)
        elif isinstance(message, Stop):
            self.stop(page)
        elif isinstance(message, Away):
            self._lose(page, message.why)
        elif isinstance(message, Take):
            self._take_or_let_go(page, message.take)
        elif isinstance(message, Recover):
            self._wish(page, {"recover": message.robot, "page": page.name}, "clear a fault")
        elif isinstance(message, Demo):
            self._play(page, message.play)
        elif isinstance(message, Act):
            self._act(page, message.action)
        elif isinstance(message, Setting):
            self._set(page, message)
        else:
            raise Malformed("not on this socket")

    def stop(self, page: Page) -> None:
        """Whoever asks, whoever drives."""
        self._app.waiting.stop(page.name)
        self._app.flush()

    def _take_pad(self, page: Page, message: PadMessage) -> None:
        watch = self._lease.watch_of(page.name)
        if watch is None:
            return  # it was on its way when the page lost the lease
        now = self._clock()
        verdict = watch.take(message, now)
        if verdict.gone is not None:
            self._app.waiting.gone(now, verdict.gone)
        if verdict.dropped is not None and not now - page.complained < _COMPLAINT:
            page.complained = now
            self._refuse(page, _UNHEARD.format(verdict.dropped))
        if verdict.t_alive is not None:
            self._app.waiting.pad(now, verdict.t_alive, message.axes, message.buttons, page.name)
        self._app.flush()
        page.outbox.beat(encode({"type": "beat", "t": watch.stamp(now)}))

    def _lose(self, page: Page, why: str) -> None:
        watch = self._lease.watch_of(page.name)
        if watch is not None and watch.lose(why) is not None:
            self._app.waiting.gone(self._clock(), why)
            self._app.flush()

    def _take_or_let_go(self, page: Page, take: bool) -> None:
        now = self._clock()
        if not take:
            self._change(self._lease.let_go(page.name, now, f"{page.name} released control"))
        elif not self._rig["drivable"]:
            self._refuse(page, f"a page cannot drive this rig: {self._rig['driven_by']} drives it")
        else:
            self._change(self._lease.take(page.name, now))

    def _play(self, page: Page, play: bool) -> None:
        if not self._rig["demo"]:
            self._refuse(page, "this rig has no recorded tour to play")
        else:
            self._wish(page, {"demo": play, "page": page.name}, "play the tour")

    def _act(self, page: Page, action: str) -> None:
        if self._lease.driver == page.name and action not in self._possible:
            self._refuse(page, "that cannot be done now" if self._recording else "this program records nothing")
        else:
            self._wish(page, {"action": action, "page": page.name}, "steer the recording")

    def _set(self, page: Page, setting: Setting) -> None:
        if self._lease.driver == page.name and setting.name not in self._settings:
            self._refuse(page, f"this program does not let a page set the {setting.name}")
        else:
            self._wish(page, {"setting": setting.name, "value": setting.value, "page": page.name}, "change settings")

    def _wish(self, page: Page, message: dict[str, Any], what: str) -> None:
        if self._lease.driver != page.name:
            self._refuse(page, f"only the page in control may {what}")
        elif not self._app.waiting.wish(message):
            self._refuse(page, "the program does not answer")
        else:
            self._app.flush()

    # Who drives.

    def _change(self, change: Change | None) -> None:
        if change is None:
            return
        if change.before is not None:
            self._app.waiting.gone(change.t, change.why)
        self._app.waiting.driver(change.driver)
        self._app.flush()
        for page in self.pages.values():
            self._tell_lease(page, change.t)

    def _tell_lease(self, page: Page, t: float) -> None:
        you = self._lease.driver == page.name
        lease = {"type": "lease", "driver": self._lease.driver, "you": you, "t": t, "why": self._lease.why}
        page.outbox.note(encode(lease))

    # What pages are told.

    def heard(self, message: Mapping[str, Any]) -> None:
        """The app said something for the pages."""
        method = message["method"]
        if method == "labels":
            self._labels = self._tell({"type": "labels", **message["labels"]})
        elif method == "say":
            say = {"type": "say", "t": message["t"], "text": message["text"]}
            self._says.append(self._tell(say | {name: message[name] for name in ("loss", "stop") if name in message}))
        elif method == "waiting":
            self._waiting_for = list(message["controls"])
            self._tell_text(self._pad_waits())
        elif method == "playing":
            self.playing = bool(message["on"])
        elif method == "driving":
            self._settings = frozenset(message["view"]["settings"])
            self._driving = self._tell({"type": "driving", **message["view"]})
        elif method == "recording":
            self._show_recording(message["t"], message["view"])
        elif method == "refused":
            page = self.pages.get(message["page"])
            if page is not None:
                self._refuse(page, message["why"])

    def _show_recording(self, t: float, view: Mapping[str, Any]) -> None:
        self._recording = encode({"type": "recording", "t": t, **view})
        self._possible = frozenset(view["actions"])
        for page in self.pages.values():
            page.outbox.newest("recording", self._recording)

    def _pad_waits(self) -> str:
        return encode({"type": "pad", "waiting": self._waiting_for})

    def _refuse(self, page: Page, why: str) -> None:
        page.outbox.note(encode({"type": "refused", "why": why}))

    def _tell(self, message: dict[str, Any]) -> str:
        text = encode(message)
        self._tell_text(text)
        return text

    def _tell_text(self, text: str) -> None:
        for page in self.pages.values():
            page.outbox.note(text)

    def show(self, state: dict[str, Any]) -> None:
        """Tell every page how things are."""
        text = encode({"type": "state", **state, "pages": len(self.pages), "playing": self.playing})
        for page in self.pages.values():
            page.outbox.newest("state", text)

    def look(self, now: float) -> None:
        """Now and then: has the page that drives fallen silent?"""
        watch = self._lease.watch
        why = watch.look(now) if watch is not None else None
        if why is not None:
            self._app.waiting.gone(now, why)
            self._app.flush()
