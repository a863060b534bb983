"""A gamepad from being plugged in to being unplugged: its devices, its state, and whether it is still alive."""

from __future__ import annotations

import errno
import math
import select
import time

from hal.gamepad import RUMBLE_STRONG, RUMBLE_WEAK
from hal.pads.codes import BUS_USB, EV_KEY, EV_SYN, KEY, SYN_DROPPED, SYN_REPORT
from hal.pads.mapper import PadMapper
from hal.pads.model import MatchRule, PadModel

from .finder import EvdevNode, NodeInfo
from .rumble import Rumble

_SEPARATE = frozenset({KEY["BTN_MODE"], KEY["BTN_LEFT"]})
"""Buttons that may come in reports of their own, which tell nothing about the other controls: xpad does so with the
Xbox button of an Xbox One pad."""
_GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL


class PadLink:
    """The connection to one pad. :meth:`poll` raises OSError when the pad is gone.

    Before a pad's first report the kernel shows it at rest, whatever is held: xpad and hid-playstation do, seen with
    the real drivers. So everything counts as unknown until the pad has reported: with a report of its own or, where it
    has a motion sensor, with the second event of that (the first may be older than the opening). Only then the kernel's
    state is true, and a dead-man that was held while the pad was plugged in is seen as held.

    The proof of life (``t_alive``) is the newest event of the motion sensor, once there was one, because it streams all
    the time; without a motion sensor, every poll that finds the device still there. The latter is proof only where
    unplugging is seen, that is, with a cable.
    """

    def __init__(self, info: NodeInfo, node: EvdevNode, model: PadModel, rule: MatchRule | None) -> None:
        self.info = info
        self.model = model
        self.title = rule.title if rule is not None and rule.title is not None else model.title
        self.wired = info.identity.bus == BUS_USB and rule is not None and not rule.wireless
        self.mapper = PadMapper(model, node.axes, node.rels)
        self.events = 0
        """Number of events, with those that the kernel dropped and the axes that were released by silence."""
        self.t = self.t_alive = -math.inf
        """Time of the newest event, at first that of the first poll, and of the last proof of life; s, rig's clock."""
        self.t_device = 0.0
        self._node = node
        self._motion: EvdevNode | None = None
        self._touch: EvdevNode | None = None
        self._beats = 0
        """Reports of the motion sensor so far."""
        self._known = False
        """Whether the pad has reported since it was opened, so that the kernel's state is true."""
        self._reported = False
        """Whether the present report has an event that comes with the state of all controls."""
        self._dropping = False
        self._poller = select.poll()
        self._poller.register(node.fileno(), select.POLLIN)
        if info.is_keyboard:  # the kernel knows its keys from the start, so that a pedal that is held shows as held
            self._trust_kernel()
        self._rumble = Rumble(node.fileno(), RUMBLE_STRONG, RUMBLE_WEAK) if node.can_rumble else None

    @property
    def proves_liveness(self) -> bool:
        """Whether the pad's silence would be noticed."""
        return self.wired or self._beats > 0

    # The pad's other devices: a Sony pad is three.

    @property
    def lacks_motion(self) -> bool:
        return self.model.motion_node is not None and self._motion is None

    @property
    def lacks_touch(self) -> bool:
        return self.model.touch_node is not None and self._touch is None

    def add_motion(self, motion: EvdevNode) -> None:
        """Use the pad's motion sensor as its heartbeat, from its first event on."""
        self._motion = motion
        self._poller.register(motion.fileno(), 0)  # wakes a poll only when it is unplugged, not with its events

    def add_touch(self, touch: EvdevNode) -> None:
        """Use the pad's touchpad, whose click is one of the pad's buttons."""
        self._touch = touch
        self._poller.register(touch.fileno(), 0)
        self.mapper.press("touchpad", KEY["BTN_LEFT"] in touch.snapshot()[1])

    # Events.

    def poll(self, now: float, timeout: float) -> None:
        """Read every event; wait for the first one for up to ``timeout`` s. Raises OSError if the pad is gone.

        ``now`` is the time on the rig's clock, s; in lock-step that is not the clock of the events.
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
                self._reported |= event.kind != EV_KEY or (event.code not in _SEPARATE)
        if self.mapper.expire(polled):
            self._count(polled + ahead, self.t_device)
        self._read_touch(ahead)
        beats = self._motion.read() if self._motion is not None else ()
        if beats:
            self._beats += sum(event.kind == EV_SYN and event.code == SYN_REPORT for event in beats)
            self.t_alive = max(self.t_alive, beats[-1].t + ahead)
            if self._beats > 1:
                self._trust_kernel()
        elif not self._beats:
            self.t_alive = polled + ahead
        if self.t == -math.inf:
            self.t = now

    def _count(self, t: float, t_device: float) -> None:
        self.events += 1
        self.t, self.t_device = max(self.t, t), t_device

    def _synchronise(self, code: int) -> None:
        """End a report. After a full buffer the kernel drops events and marks it: all up to the next report is void."""
        if code == SYN_DROPPED:
            self._dropping = True
        elif code == SYN_REPORT:
            if self._dropping:
                self._dropping, self._known = False, True
                self.mapper.sync(*self._node.snapshot())
            if self._reported:
                self._trust_kernel()

    def _trust_kernel(self) -> None:
        """Read the kernel's state once: from now on it is that of the pad, and every change is an event."""
        if not self._known:
            self._known = True
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

    # Motors, and the end.

    @property
    def can_rumble(self) -> bool:
        """Whether it has motors that may be used."""
        return self._rumble is not None

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        """Turn the motors; False where there are none, or they are busy. Raises OSError when the pad is gone."""
        return self._rumble is not None and self._rumble.play(strong, weak, seconds)

    def close(self) -> None:
        if self._rumble is not None:
            self._rumble.close()
        for node in (self._node, self._motion, self._touch):
            if node is not None:
                node.close()
