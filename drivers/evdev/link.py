"""A pad that is plugged in: its open devices, its state, and whether it is still alive."""

from __future__ import annotations

import errno
import math
import select
import time

from hal.gamepad import RUMBLE_STRONG, RUMBLE_WEAK
from hal.pads.codes import BUS_USB, EV_KEY, EV_SYN, KEY, SYN_DROPPED, SYN_REPORT
from hal.pads.mapper import PadMapper
from hal.pads.model import MatchRule, PadModel

from .node import Node
from .rumble import Rumble
from .system import NodeInfo

__all__ = ["Link"]

_APART = frozenset({KEY["BTN_MODE"], KEY["BTN_LEFT"]})
"""Buttons that may come in reports of their own, which say nothing of the others: xpad does so with the Xbox button of
an Xbox One pad."""
_GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL


class Link:
    """One pad from being plugged in to being unplugged. :meth:`poll` raises OSError when it is gone.

    Before a pad's first report the kernel shows it at rest, whatever is held: xpad and hid-playstation do, seen with
    the real drivers. So everything counts as unknown until the pad itself has spoken: in a report of its own, or, where
    it has a motion sensor, in the second beat of that (the first may be older than our looking at it). Only then is
    what the kernel shows the truth, and a dead-man that was held while the pad was plugged in is seen held.

    What proves that the pad is alive (``t_alive``): the newest event of its motion sensor, once that was heard, for
    it speaks all the time; without one, every poll that finds the device still there. The second is proof only where
    unplugging is seen, that is, with a cable.
    """

    def __init__(self, info: NodeInfo, node: Node, model: PadModel, rule: MatchRule | None) -> None:
        self.info = info
        self.model = model
        self.title = rule.title if rule is not None and rule.title is not None else model.title
        self.wired = info.identity.bus == BUS_USB and rule is not None and not rule.wireless
        self.mapper = PadMapper(model, node.axes, node.rels)
        self.events = 0
        """Events so far; one that the kernel dropped counts too, and an axis that let go of itself."""
        self.t = self.t_alive = -math.inf
        """Time of the newest event, at first that of the first poll, and of the last proof of life; s, rig's clock."""
        self.t_device = 0.0
        self._node = node
        self._motion: Node | None = None
        self._touch: Node | None = None
        self._beats = 0
        """Events of the motion sensor so far."""
        self._spoken = False
        """Has the pad reported since it was opened, so that the kernel knows how it stands?"""
        self._said = False
        """Was there an event in this report that comes with all others? Some buttons have reports of their own."""
        self._dropping = False
        self._poller = select.poll()
        self._poller.register(node.fileno(), select.POLLIN)
        self._rumble = Rumble(node.fileno(), RUMBLE_STRONG, RUMBLE_WEAK) if node.can_rumble else None

    @property
    def proves_liveness(self) -> bool:
        """Would its silence be noticed?"""
        return self.wired or self._beats > 0

    # Its other devices: a Sony pad is three.

    @property
    def lacks_motion(self) -> bool:
        """Is there a motion sensor to be found yet?"""
        return self.model.motion_node is not None and self._motion is None

    @property
    def lacks_touch(self) -> bool:
        """Is there a touchpad to be found yet?"""
        return self.model.touch_node is not None and self._touch is None

    def listen_to(self, motion: Node) -> None:
        """Take the pad's motion sensor as its heartbeat, as soon as it is heard."""
        self._motion = motion
        self._poller.register(motion.fileno(), 0)  # wakes nobody with its news, only when it is unplugged

    def take_touch(self, touch: Node) -> None:
        """Take the pad's touchpad, whose click is one of the pad's buttons."""
        self._touch = touch
        self._poller.register(touch.fileno(), 0)
        self.mapper.press("touchpad", KEY["BTN_LEFT"] in touch.snapshot()[1])

    # What it says.

    def poll(self, now: float, timeout: float) -> None:
        """Take every event; wait for the first one for up to ``timeout`` s. Raises OSError when the pad is gone.

        ``now`` is the time on the rig's clock, s, which in lock-step is another one than that of the events.
        """
        ahead = now - time.monotonic()
        for _, flags in self._poller.poll(timeout * 1e3):
            if flags & _GONE:
                raise OSError(errno.ENODEV, "unplugged", self.info.path)
        polled = time.monotonic()
        for event in self._node.read():
            self._count(event.t + ahead, event.t_device)
            if event.kind == EV_SYN:
                self._synchronise(event.code)
            elif not self._dropping and self.mapper.feed(event.kind, event.code, event.value, event.t):
                self._said |= event.kind != EV_KEY or (event.code not in _APART)
        if self.mapper.expire(polled):
            self._count(polled + ahead, self.t_device)
        self._read_touch(ahead)
        beats = self._motion.read() if self._motion is not None else ()
        if beats:
            self._beats += sum(event.kind == EV_SYN and event.code == SYN_REPORT for event in beats)
            self.t_alive = max(self.t_alive, beats[-1].t + ahead)
            if self._beats > 1:
                self._believe()
        elif not self._beats:
            self.t_alive = polled + ahead
        if self.t == -math.inf:
            self.t = now

    def _count(self, t: float, t_device: float) -> None:
        self.events += 1
        self.t, self.t_device = max(self.t, t), t_device

    def _synchronise(self, code: int) -> None:
        """After a full buffer the kernel drops events and says so: what came before the next report is worthless."""
        if code == SYN_DROPPED:
            self._dropping = True
        elif code == SYN_REPORT:
            if self._dropping:
                self._dropping, self._spoken = False, True
                self.mapper.sync(*self._node.snapshot())
            if self._said:
                self._believe()

    def _believe(self) -> None:
        """The pad has spoken: from here on it is as the kernel shows it, and every change is an event."""
        if not self._spoken:
            self._spoken = True
            self.mapper.sync(*self._node.snapshot(), rest=True)

    def _read_touch(self, ahead: float) -> None:
        if self._touch is None:
            return
        for event in self._touch.read():
            if (event.kind, event.code) == (EV_KEY, KEY["BTN_LEFT"]):
                self._count(event.t + ahead, event.t_device)
                self.mapper.press("touchpad", event.value != 0)
            elif (event.kind, event.code) == (EV_SYN, SYN_DROPPED):
                self.mapper.press("touchpad", KEY["BTN_LEFT"] in self._touch.snapshot()[1])

    # What it is told.

    @property
    def can_rumble(self) -> bool:
        """Has it motors that may be turned on?"""
        return self._rumble is not None

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        """Turn its motors; False where it has none, or they are busy. Raises OSError when it is gone."""
        return self._rumble is not None and self._rumble.play(strong, weak, seconds)

    def close(self) -> None:
        """Let go of the devices. Idempotent."""
        if self._rumble is not None:
            self._rumble.close()
        for node in (self._node, self._motion, self._touch):
            if node is not None:
                node.close()
