"""Gamepads and leaders over a connection: each reading with its time, and what is known of the device.

What is sent is what the driver reports, so that neutral gate, dead zone and dead-man are those of the program. A link
that is silent is a pad that was unplugged: nothing that is still held counts when it comes back.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import NamedTuple

from ..driver import PadReading
from ..gamepad import Gamepad
from ..types import AXES, BUTTONS
from .boxes import Box
from .link import RigLink

_PERIOD = 0.005
"""Longest time from a new reading to its frame, s."""


class AboutPad(NamedTuple):
    """What the program must know of a pad beside its readings; another one may be plugged in at any time."""

    title: str = ""
    proves_liveness: bool = False
    simulated: bool = False
    can_hold: bool = True
    finished: bool = False
    mapping: str | None = None
    control_names: Mapping[str, str] = MappingProxyType({})
    flat: Mapping[str, float] = MappingProxyType({})
    absolute: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, pad: Gamepad) -> AboutPad:
        """Return that of a pad of this computer, whose rig may accept that its silence goes unnoticed."""
        driver = pad.driver
        trusted = driver.proves_liveness or driver.spec.options.get("accept_silent_pad") is True
        names = {**driver.control_names}, {**driver.flat}, tuple(driver.absolute), driver.notes
        kind = trusted, driver.simulated, driver.can_hold, driver.finished, driver.mapping
        return cls(driver.describe(), *kind, *names)


class SentReadings(Box):
    """The newest reading of a pad, to be sent."""

    def __init__(self, pad: Gamepad) -> None:
        super().__init__()
        self._pad = pad
        self._reading: PadReading | None = None
        self._number = 0

    def number(self) -> int:
        """Return a number that grows with each reading."""
        reading = self._pad.reading
        if reading is not self._reading:
            self._reading, self._number = reading, self._number + 1
        return self._number

    def read(self) -> bytes:
        """Return the newest reading."""
        pad = self._pad
        reading = pad.reading
        packed = reading._replace(axes=dict(reading.axes), buttons=sorted(reading.buttons), unknown=[*reading.unknown])  # type: ignore[arg-type]
        return json.dumps([packed, AboutPad.of(pad)]).encode()


class ReceivedReadings(Box):
    """The newest reading that has come, and what it comes from."""

    def __init__(self) -> None:
        super().__init__()
        self.reading: PadReading | None = None
        self.about = AboutPad()

    def take(self, number: int, record: bytes, shift: float, now: float) -> None:
        """Keep a reading that has come, as :meth:`.Box.take` does."""
        if number == self._taken or not record:
            return
        self._taken = number
        try:
            reading, about = json.loads(record)
            self.reading, self.about = _check_reading(PadReading(*reading), shift, now), AboutPad(*about)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no reading of a pad: {error!r}") from error


def _check_reading(sent: PadReading, shift: float, now: float) -> PadReading:
    """Return a reading with its times in this computer's clock, none after ``now``. Raises ValueError for nonsense."""
    numbers = (*sent.axes.values(), *sent.joints, *sent.pose)
    names = {*sent.axes, *sent.unknown} <= {*AXES} and {*sent.buttons} <= {*BUTTONS}
    sound = all(map(math.isfinite, numbers)) and not math.isnan(sent.t_alive) and isinstance(sent.connected, bool)
    if not names or not sound:
        raise ValueError("a reading with unknown controls or values that are not numbers")
    return sent._replace(
        t=min(sent.t + shift, now),
        t_alive=min(sent.t_alive + shift, now),
        axes=MappingProxyType(sent.axes),
        buttons=frozenset(sent.buttons),
        joints=tuple(sent.joints),
        pose=tuple(sent.pose),
    )


def send_readings(pad: Gamepad, link: RigLink, over: threading.Event) -> None:
    """Send the readings of a pad, and let it rumble, until the client leaves or the server ends.

    Raises:
        ConnectionLost: The client is gone.
    """
    link.post({"pad": pad.name})
    link.outgoing = [SentReadings(pad)]
    while not over.is_set():
        link.wait(_PERIOD)
        for message in link.receive():
            with suppress(KeyError, TypeError, ValueError):
                strong, weak, seconds = map(float, message["rumble"])
                pad.rumble(strong=strong, weak=weak, seconds=min(seconds, 1.0))
        link.send()
