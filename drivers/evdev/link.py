"""A pad that is plugged in: its open devices, its state, and whether it is still alive."""

from __future__ import annotations

import errno
import math
import select
import time

from hal.pads.codes import BUS_USB, EV_SYN, SYN_DROPPED, SYN_REPORT
from hal.pads.mapper import PadMapper
from hal.pads.model import MatchRule, PadModel

from .node import Node
from .system import NodeInfo

__all__ = ["Link"]

_GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL


class Link:
    """One pad from being plugged in to being unplugged. :meth:`poll` raises OSError when it is gone.

    What proves that the pad is alive (``t_alive``): the newest event of its motion sensor, once that was heard, for
    it speaks all the time; without one, every poll that finds the device still there. The second is proof only where
    unplugging is seen, that is, with a cable.
    """

    def __init__(self, info: NodeInfo, node: Node, model: PadModel, rule: MatchRule | None) -> None:
        self.info = info
        self.model = model
        self.wired = info.identity.bus == BUS_USB and rule is not None and not rule.wireless
        self.mapper = PadMapper(model, node.axes)
        self.events = 0
        """Events so far; one that the kernel dropped counts too."""
        self.t = self.t_alive = -math.inf
        """Time of the newest event, at first that of the first poll, and of the last proof of life; s, rig's clock."""
        self.t_device = 0.0
        self._node = node
        self._motion: Node | None = None
        self._heard_motion = False
        self._dropping = False
        self._poller = select.poll()
        self._poller.register(node.fileno(), select.POLLIN)
        self.mapper.sync(*node.snapshot(), trusted=False)

    @property
    def proves_liveness(self) -> bool:
        """Would its silence be noticed?"""
        return self.wired or self._heard_motion

    @property
    def lacks_motion(self) -> bool:
        """Is there a motion sensor to be found yet?"""
        return self.model.motion_node is not None and self._motion is None

    def listen_to(self, motion: Node) -> None:
        """Take the pad's motion sensor as its heartbeat, as soon as it is heard."""
        self._motion = motion
        self._poller.register(motion.fileno(), 0)  # wakes nobody with its news, only when it is unplugged

    def poll(self, now: float, timeout: float) -> None:
        """Take every event; wait for the first one for up to ``timeout`` s. Raises OSError when the pad is gone.

        ``now`` is the time on the rig's clock, s, which in lock-step is another one than that of the events.
        """
        ahead = now - time.monotonic()
        if self.t == -math.inf:
            self.t = now
        for _, flags in self._poller.poll(timeout * 1e3):
            if flags & _GONE:
                raise OSError(errno.ENODEV, "unplugged", self.info.path)
        polled = time.monotonic() + ahead
        for event in self._node.read():
            self.events += 1
            self.t, self.t_device = event.t + ahead, event.t_device
            if event.kind == EV_SYN:
                self._synchronise(event.code)
            elif not self._dropping:
                self.mapper.feed(event.kind, event.code, event.value)
        beats = self._motion.read() if self._motion is not None else ()
        if beats:
            self._heard_motion = True
            self.t_alive = max(self.t_alive, beats[-1].t + ahead)
        elif not self._heard_motion:
            self.t_alive = polled

    def _synchronise(self, code: int) -> None:
        """After a full buffer the kernel drops events and says so: what came before the next report is worthless."""
        if code == SYN_DROPPED:
            self._dropping = True
        elif code == SYN_REPORT and self._dropping:
            self._dropping = False
            self.mapper.sync(*self._node.snapshot(), trusted=True)

    def close(self) -> None:
        """Let go of the devices. Idempotent."""
        for node in (self._node, self._motion):
            if node is not None:
                node.close()
