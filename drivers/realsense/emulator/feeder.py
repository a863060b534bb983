"""The thread that is the camera's firmware: takes pictures on time, and sends them as they are streamed."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import NamedTuple

import numpy as np

from hal.specs import CameraSpec

from .device import Device
from .figures import Mode, streams_of
from .knobs import Knobs
from .number import draw_number
from .options import Emulation
from .pictures import Pictures
from .scene import PHASES

__all__ = ["Feeder", "Sent"]

_IDLE = 0.02  # s between two looks whether somebody streams
_WRAP = 2**32 * 1e-6  # s after which the sensor's clock begins anew
_KEPT = 256  # how many of the newest pictures it can be asked about
_ORDER = ("depth", "infrared", "infrared_right", "color")


class Sent(NamedTuple):
    """When a set of pictures went out."""

    number: int
    stamp: float
    """When it was taken, on the clock of its stamps, s."""
    t: float
    """Just before its last picture was handed to the library, on the host's monotonic clock, s."""


class Feeder:
    """Feeds whatever :class:`Device` is plugged in; without one, and while nobody streams, it rests.

    Numbers begin with 1 when streaming begins. They count the pictures of the fastest stream; a slower one has fewer.
    """

    def __init__(self, spec: CameraSpec, emulation: Emulation) -> None:
        self.emulation = emulation
        self.streams = streams_of(spec)
        self.pictures = Pictures(self.streams, emulation.pattern, emulation.seed)
        self.modes: dict[str, Mode] = {}
        """Those of the streams that are on."""
        self.late = 0
        """How many pictures were taken more than a period late, because this thread was held up."""
        self.sent: deque[Sent] = deque(maxlen=_KEPT)
        self.knobs = Knobs()
        self._device: Device | None = None
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._chance = np.random.default_rng(emulation.seed)
        self._made = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="realsense-emulator", daemon=True)
        self._thread.start()

    def plug(self, device: Device | None) -> None:
        """Feed this one from now on; None for none. Once this returns nothing is sent to the last one any more."""
        with self._lock:
            self._device = device

    def end(self) -> None:
        """Stop the thread. Idempotent."""
        self._end.set()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        tick, due = 0, 0.0
        while not self._end.is_set():
            if self._look():
                due = time.monotonic()
            if not self.modes:
                tick = 0
                self._end.wait(_IDLE)
                continue
            period = 1.0 / max(mode.rate for mode in self.modes.values())
            due += period
            if self._end.wait(max(0.0, due - time.monotonic())):
                return
            if time.monotonic() - due > period:
                self.late += 1
                due = time.monotonic()
            tick += 1
            with self._lock:
                if self._device is not None:
                    self._send(self._device, tick, due)

    def _look(self) -> bool:
        """Which streams are on now? True where those are others than before; their pictures are ready then."""
        with self._lock:
            modes = self._device.streaming() if self._device is not None else {}
        if modes == self.modes:
            return False
        for name, mode in modes.items():
            self.pictures.prepare(name, mode)
        self.modes = modes
        return True

    def _send(self, device: Device, tick: int, taken: float) -> None:
        """Send what was taken at that time: each sensor's pictures together."""
        fastest = max(mode.rate for mode in self.modes.values())
        due = {
            name: tick * mode.rate // fastest
            for name in _ORDER
            if (mode := self.modes.get(name)) and tick * mode.rate // fastest != (tick - 1) * mode.rate // fastest
        }
        due = {name: number for name, number in due.items() if not self._lost(name, number)}
        last, delayed = next(reversed(due), None), 0.0
        for name, number in due.items():
            if name in ("color", next(iter(due))) and self.emulation.arrival_jitter:
                delay = max(delayed, self.emulation.arrival_jitter * self._chance.random())
                time.sleep(delay - delayed)
                delayed = delay
            mode = self.modes[name]
            picture = self.pictures.prepare(name, mode)[number % PHASES]
            draw_number(picture, mode.format, number)
            stamp, domain = self._stamp(device, name, taken)
            number += self.emulation.color_ahead if name == "color" else 0
            if self.emulation.metadata:
                device.note(name, self._metadata(mode, number, taken))
            if name == last:
                self.sent.append(Sent(due[name], stamp / 1e3, time.monotonic()))
            device.push(name, mode, picture, number, stamp, domain)

    def _lost(self, name: str, number: int) -> bool:
        knobs = self.knobs
        dropped = knobs.drop > 0 and number % knobs.drop == 0 and knobs.drop_stream in (None, name)
        return knobs.freeze or dropped

    def _stamp(self, device: Device, name: str, taken: float) -> tuple[float, str]:
        """ms, and whose."""
        later = self.knobs.skew if name == "color" else 0.0
        if self.emulation.clock == "system":
            return 1e3 * (time.time() + later), "system_time"
        if device.takes_global_time(name):
            return 1e3 * (taken + time.time() - time.monotonic() + later), "global_time"
        return 1e3 * self._sensor_time(taken + later), "hardware_clock"

    def _sensor_time(self, t: float) -> float:
        passed = (t - self._made) * (1.0 + 1e-6 * self.emulation.drift_ppm)
        return (self.emulation.clock_at + passed) % _WRAP

    def _metadata(self, mode: Mode, number: int, taken: float) -> dict[str, int]:
        microseconds = round(1e6 * self._sensor_time(taken))
        return {
            "frame_counter": number,
            "actual_fps": 1000 * mode.rate,  # the matcher divides by 1000
            "frame_timestamp": microseconds,
            "sensor_timestamp": microseconds,
            "time_of_arrival": round(1e3 * time.time()),
        }
