"""The rules of the console, without any socket: which page drives, whose pad counts, what the app and pages are sent.

:class:`PadWatch` decides whether a pad message is recent enough to count, :class:`SendQueue` holds what waits for one
page, and :class:`WebSession` connects them, and knows which page is in control.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, NamedTuple

from hal.servo.watchdog import PAD_SILENCE

from .messages import (
    CLOCK_AHEAD,
    MESSAGES_LATE,
    PAGE_GONE,
    PAGE_SILENT,
    ControlRequest,
    DriverRequest,
    MalformedMessage,
    Outbox,
    PadMessage,
    PageLeft,
    StopRequest,
    encode,
    parse,
)

_MAX_REQUESTS = 16
"""Requests of pages that may wait for the app."""
_MAX_NOTES = 256
"""Messages that must not be left out and may wait for one page."""
_KEPT_LINES = 50
"""Newest lines of the app that a page gets when it opens."""


# Whether a pad message counts.


class PadVerdict(NamedTuple):
    """What a pad message means."""

    lost: str | None = None
    """Why the pad was lost before or with this message; None if it was not, or had been lost already."""
    t_alive: float | None = None
    """Time at which the page provably was in this state, in s; None if the message does not count."""


class PadWatch:
    """Decides which pad messages of the page in control count, from the moment at which it was given control.

    A message may wait in buffers for long before it arrives, so its arrival proves nothing. The server therefore sends
    its own clock's time with every answer. The page repeats the newest one (``seen``) and how long ago, by its own
    clock, that came (``since``): at ``seen + since`` the page was in the state that the message describes, however late
    the message is read.

    Pure: all times are arguments. The pad is :attr:`connected` from a message that counts until something disconnects
    it; its reader must then see it released before it counts again.
    """

    def __init__(self, granted: float) -> None:
        """``granted`` is the time stamp of the message that gives the page control, in s."""
        self._granted = granted
        self._stamp = granted
        self._alive = -math.inf
        self.connected = False

    def stamp(self, now: float) -> float:
        """Note that the time ``now`` is sent to the page, which may repeat it from now on. Returns ``now``."""
        self._stamp = now
        return now

    def judge(self, message: PadMessage, now: float) -> PadVerdict:
        """Decide whether the page's next message, read at ``now``, counts.

        Raises:
            MalformedMessage: It repeats a stamp that was not sent yet.
        """
        if message.seen > self._stamp:
            raise MalformedMessage("a stamp that was never sent")
        if message.seen < self._granted:
            return PadVerdict()  # sent before the page was given control this time
        claimed = message.seen + message.since
        if not claimed - now <= PAD_SILENCE:
            return PadVerdict(self.disconnect(CLOCK_AHEAD))
        # Messages arrive in the order in which they were sent: what one proves, the next one proves too.
        alive = max(self._alive, min(now, claimed))
        gap, self._alive = alive - self._alive, alive
        if not now - alive <= PAD_SILENCE:
            return PadVerdict(self.disconnect(MESSAGES_LATE))
        lost = self.disconnect(PAGE_SILENT) if gap > PAD_SILENCE else None
        self.connected = True
        return PadVerdict(lost, alive)

    def check_silence(self, now: float) -> str | None:
        """Disconnect the pad if its page has been silent for too long; returns the reason if it was connected."""
        return self.disconnect(PAGE_SILENT) if not now - self._alive <= PAD_SILENCE else None

    def disconnect(self, why: str) -> str | None:
        """Disconnect the pad; returns ``why`` if it was connected."""
        was, self.connected = self.connected, False
        return why if was else None


# What waits to be sent.


def make_app_queue() -> Outbox[dict[str, Any]]:
    """Return the queue of messages for the app: of each kind the newest, and a few requests in their order.

    A lost pad (``lost``) comes before the next state of a pad, however many of either the app missed.
    """
    return Outbox("stop", "lost", "driver", "pad", most=_MAX_REQUESTS)


class SendQueue(Outbox[str]):
    """Messages for one page: the newest ``beat`` first, then notes in order, then the newest of the rest.

    Only :meth:`pump` waits for the page, so a page that is slow or frozen delays no other.
    """

    def __init__(self, overflow: Callable[[], None]) -> None:
        """``overflow`` is called when a note is lost: the page must be disconnected."""
        super().__init__("beat", most=_MAX_NOTES)
        self._overflow = overflow
        self._changed = asyncio.Event()

    def put_note(self, text: str) -> None:
        """Add a message that must not be left out."""
        if self.put(text):
            self._changed.set()
        else:
            self._overflow()

    def put_newest(self, kind: str, message: str) -> None:
        super().put_newest(kind, message)
        self._changed.set()

    async def pump(self, send: Callable[[str], Awaitable[None]]) -> None:
        """Send every message until the connection breaks or the task is cancelled. ``send`` waits for a slow page."""
        try:
            while True:
                await self._changed.wait()
                self._changed.clear()
                while (text := self.pop()) is not None:
                    await send(text)
        except ConnectionError:
            pass  # the reader of the page's socket notices it too


class WebPage:
    """A page that is open in a browser."""

    def __init__(self, number: int, overflow: Callable[[], None]) -> None:
        self.number = number
        self.name = f"page {number}"
        self.queue = SendQueue(overflow)


class WebSession:
    """Every open page, the one in control, and the newest view of everything that the app shows. One thread."""

    def __init__(
        self,
        rig: Mapping[str, Any],
        to_app: Outbox[dict[str, Any]],
        flush: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare a session; ``flush`` sends the app what waits in ``to_app``."""
        self._rig = rig
        self._robots = frozenset(robot["name"] for robot in rig["robots"])
        self._to_app = to_app
        self._flush = flush
        self._clock = clock
        self._opened = 0
        self._driver: str | None = None
        """Name of the page in control: one at a time, and no name is used twice."""
        self._watch: PadWatch | None = None
        """Judges the pad of that page; a new one with each grant, so that messages from before do not count."""
        self._why = ""
        """Reason of the last change of control, for people; empty if no page lost it."""
        self._kept: dict[str, str] = {}
        """Type of a message that pages get when they open -> the newest one."""
        self._lines: deque[str] = deque(maxlen=_KEPT_LINES)
        self._settings: frozenset[str] = frozenset()
        self._actions: frozenset[str] = frozenset()
        self.pages: dict[str, WebPage] = {}
        self.playing = False

    # Pages open and close.

    def open_page(self, overflow: Callable[[], None]) -> WebPage:
        """Add a page. ``overflow`` is called when it reads so slowly that it missed a message."""
        self._opened += 1
        page = WebPage(self._opened, overflow)
        self.pages[page.name] = page
        page.queue.put_note(encode({"type": "hello", "page": page.number, "name": page.name, "rig": self._rig}))
        self._send_lease(page, self._clock())
        for text in (*self._kept.values(), *self._lines):
            page.queue.put_note(text)
        return page

    def close_page(self, page: WebPage) -> None:
        """Remove a page and end its control. Idempotent."""
        if self.pages.pop(page.name, None) is not None and page.name == self._driver:
            self._set_driver(None, PAGE_GONE)

    # Messages of pages.

    def receive(self, page: WebPage, text: str) -> None:
        """Handle a message of a page.

        Raises:
            MalformedMessage: It is not one that this socket accepts; nothing of it was applied.
        """
        message = parse(text, self._robots)
        if isinstance(message, PadMessage):
            self._receive_pad(page, message)
        elif isinstance(message, StopRequest):
            self.stop(page)
        elif isinstance(message, PageLeft):
            self._disconnect_pad(page, message.why)
        elif isinstance(message, ControlRequest):
            self._take_or_release(page, message.take)
        elif isinstance(message, DriverRequest):
            self._request(page, message)
        else:
            raise MalformedMessage("not on this socket")

    def stop(self, page: WebPage) -> None:
        """Request a stop of every arm; every page may, in control or not."""
        self._to_app.put_newest("stop", {"stop": page.name})
        self._flush()

    def _receive_pad(self, page: WebPage, message: PadMessage) -> None:
        watch = self._watch if page.name == self._driver else None
        if watch is None:
            return  # it was on its way when the page lost control
        now = self._clock()
        verdict = watch.judge(message, now)
        if verdict.lost is not None:
            self._lose_pad(now, verdict.lost)
        if verdict.t_alive is not None:
            pad = {"connected": True, "t": now, "t_alive": verdict.t_alive, "axes": message.axes}
            pad |= {"buttons": message.buttons, "hands": message.hands, "from": page.name}
            self._to_app.put_newest("pad", {"pad": pad})
        self._flush()
        page.queue.put_newest("beat", encode({"type": "beat", "t": watch.stamp(now)}))

    def _disconnect_pad(self, page: WebPage, why: str) -> None:
        watch = self._watch if page.name == self._driver else None
        if watch is not None and watch.disconnect(why) is not None:
            self._lose_pad(self._clock(), why)

    def _lose_pad(self, t: float, why: str) -> None:
        self._to_app.discard("pad")
        self._to_app.put_newest("lost", {"pad": {"connected": False, "t": t, "why": why}})
        self._flush()

    def _take_or_release(self, page: WebPage, take: bool) -> None:
        drives = page.name == self._driver
        if not take and drives:
            self._set_driver(None, f"{page.name} released control")
        elif take and not self._rig["drivable"]:
            self._refuse(page, f"a page cannot drive this rig: {self._rig['driven_by']} drives it")
        elif take and not drives:
            self._set_driver(page.name, f"{page.name} took control" if self._driver is not None else "")

    def _request(self, page: WebPage, request: DriverRequest) -> None:
        wanted, why = request.message, ""
        if "demo" in wanted and not self._rig["demo"]:
            why = "this rig has no recorded tour to play"
        elif self._driver != page.name:
            why = f"only the page in control may {request.what}"
        elif wanted.get("action", "") not in ("", *self._actions):
            why = "that cannot be done now" if "recording" in self._kept else "this program records nothing"
        elif wanted.get("setting", "") not in ("", *self._settings):
            why = f"this program does not let a page set the {wanted['setting']}"
        elif not self._to_app.put({**wanted, "page": page.name}):
            why = "the program does not answer"
        if why:
            self._refuse(page, why)
        else:
            self._flush()

    # Changes of control.

    def _set_driver(self, driver: str | None, why: str) -> None:
        """Give control to a page, or to none; ``why`` is the reason for the page that loses it."""
        now = self._clock()
        if self._driver is not None:
            self._lose_pad(now, why)
        self._driver, self._why = driver, why
        self._watch = PadWatch(now) if driver is not None else None
        self._to_app.put_newest("driver", {"driver": driver})
        self._flush()
        for page in self.pages.values():
            self._send_lease(page, now)

    def _send_lease(self, page: WebPage, t: float) -> None:
        lease = {"type": "lease", "driver": self._driver, "you": self._driver == page.name, "t": t, "why": self._why}
        page.queue.put_note(encode(lease))

    # Messages to pages.

    def receive_from_app(self, message: Mapping[str, Any]) -> None:
        """Pass a message of the app on to the pages that it is for, and keep it for those that open later."""
        method = message["method"]
        if method == "labels":
            self._keep({"type": "labels", **message["labels"]})
        elif method == "say":
            line = {"type": "say", "t": message["t"], "text": message["text"]}
            line |= {name: message[name] for name in ("loss", "stop") if name in message}
            self._lines.append(self._send_all(line))
        elif method == "waiting":
            self._keep({"type": "pad", "waiting": message["controls"]})
        elif method == "playing":
            self.playing = bool(message["on"])
        elif method == "driving":
            self._settings = frozenset(message["view"]["settings"])
            self._keep({"type": "driving", **message["view"]})
        elif method == "recording":
            self._show_recording(message["t"], message["view"])
        elif method == "refused":
            page = self.pages.get(message["page"])
            if page is not None:
                self._refuse(page, message["why"])

    def _show_recording(self, t: float, view: Mapping[str, Any]) -> None:
        self._kept["recording"] = encode({"type": "recording", "t": t, **view})
        self._actions = frozenset(view["actions"])
        for page in self.pages.values():
            page.queue.put_newest("recording", self._kept["recording"])

    def _keep(self, message: dict[str, Any]) -> None:
        self._kept[message["type"]] = self._send_all(message)

    def _refuse(self, page: WebPage, why: str) -> None:
        page.queue.put_note(encode({"type": "refused", "why": why}))

    def _send_all(self, message: dict[str, Any]) -> str:
        text = encode(message)
        for page in self.pages.values():
            page.queue.put_note(text)
        return text

    def send_state(self, state: dict[str, Any]) -> None:
        """Send the state of the rig to every page; a page that is slow gets the newest one only."""
        text = encode({"type": "state", **state, "pages": len(self.pages), "playing": self.playing})
        for page in self.pages.values():
            page.queue.put_newest("state", text)

    def check_pad(self, now: float) -> None:
        """Report the pad as lost if the page in control has been silent for too long; to be called regularly."""
        watch = self._watch
        why = watch.check_silence(now) if watch is not None else None
        if why is not None:
            self._lose_pad(now, why)
