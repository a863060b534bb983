"""Gamepads and leader arms that another computer serves."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from types import MappingProxyType

from hal.driver import GamepadDriver, PadReading
from hal.errors import HalError, NotSupported
from hal.host.process import unpack_error
from hal.leader import Angles, LeaderDriver
from hal.remote.client import connect
from hal.remote.link import ANSWER_LIMIT, MOST_ROUND_TRIP, RigLink
from hal.remote.pads import ReceivedReadings
from hal.servo.watchdog import PAD_SILENCE
from hal.specs import PadSpec

_RETRY = 1.0
"""Time between two attempts to connect, s."""
_BEAT = 0.02
"""Longest wait before the other computer gets a sign of life, s."""
_AWAY = PadReading(-math.inf, -math.inf, 0.0, 0, MappingProxyType({}), frozenset(), connected=False)


class ServedPad(GamepadDriver):
    """A gamepad of another computer, which is plugged in as long as its readings come in time.

    Times are translated into this computer's clock, and wrong by half of the shortest round trip lately at most. Above
    :data:`~hal.remote.link.MOST_ROUND_TRIP` it counts as unplugged, because a release would come too late.
    """

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._link: RigLink | None = None
        self._received = ReceivedReadings()
        self._reading = _AWAY
        self._retry_at = -math.inf
        self._trouble = ""
        self._open = False

    def open(self) -> None:
        self._open = True

    def poll(self, now: float, timeout: float) -> PadReading:
        try:
            if self._link is not None:
                return self._receive(self._link, timeout)
            if time.monotonic() < self._retry_at:
                time.sleep(timeout)
            else:
                self._connect()
        except HalError as error:
            self._disconnect(str(error))
        return self._reading

    def _connect(self) -> None:
        link, _ = connect(str(self.spec.at), {"want": "pad", "pad": self.spec.name})
        self._received = ReceivedReadings()
        link.incoming = [self._received]
        self._link = link
        deadline = time.monotonic() + ANSWER_LIMIT
        while self._received.reading is None and time.monotonic() < deadline:
            self._receive(link, _BEAT)
        if not self._open:  # closed meanwhile
            self.close()

    def _receive(self, link: RigLink, timeout: float) -> PadReading:
        link.send()
        link.wait(timeout)
        for message in link.receive():
            raise unpack_error(message["error"])
        found, about = self._received.reading, self._received.about
        if found is None:
            return self._reading
        self._trouble = ""
        if link.offset.round_trip > MOST_ROUND_TRIP:
            self._trouble = f"a round trip takes more than {1e3 * MOST_ROUND_TRIP:g} ms: a release would come too late"
        elif found.connected and time.monotonic() - found.t_alive > PAD_SILENCE:
            self._trouble = "its readings come late"
        self._reading = _unplug(found) if self._trouble else found
        self.proves_liveness, self.simulated = about.proves_liveness, about.simulated  # type: ignore[misc]
        self.flat, self.absolute = about.flat, about.absolute
        self._explain()
        return self._reading

    def _disconnect(self, trouble: str) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()
        self._trouble, self._retry_at = trouble, time.monotonic() + _RETRY
        self._reading = _unplug(self._reading)
        self._explain()

    def _explain(self) -> None:
        trouble = (f"{self.spec.name} at {self.spec.at}: {self._trouble}",) if self._trouble else ()
        self.notes = (*self._received.about.notes, *trouble)

    def describe(self) -> str:
        about = self._received.about
        return f"{about.title or 'no gamepad'} at {self.spec.at}"

    @property
    def mapping(self) -> str | None:
        return self._received.about.mapping

    @property
    def control_names(self) -> Mapping[str, str]:
        return self._received.about.control_names

    @property
    def can_hold(self) -> bool:
        return self._received.about.can_hold

    @property
    def finished(self) -> bool:
        return self._received.about.finished

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        link = self._link
        if link is not None:
            link.post({"rumble": [strong, weak, seconds]})
        return link is not None

    def close(self) -> None:
        self._open = False
        self._disconnect("it is not open")


class ServedLeader(ServedPad, LeaderDriver):
    """A leader arm of another computer. It never follows the arm."""

    def read_angles(self, now: float) -> Angles:
        raise NotSupported("the motors of a leader are read by the computer that serves it", code="served")


def _unplug(reading: PadReading) -> PadReading:
    return reading._replace(connected=False, axes=MappingProxyType({}), buttons=frozenset(), joints=(), pose=())
