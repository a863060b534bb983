"""The emulated camera's firmware: a thread that sends frames on time."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import NamedTuple

import numpy as np

from hal.specs import CameraSpec

from .device import EmulatedDevice
from .pictures import PHASES, EmulatedImages, StreamMode, draw_number, make_streams
from .settings import CameraFaults, Emulation

_IDLE = 0.02
"""s between two checks whether a stream is on."""
_WRAP = 2**32 * 1e-6
"""s after which the sensor's clock wraps."""
_KEPT = 256
"""Number of the newest frame sets whose times are kept."""
_ORDER = ("depth", "infrared", "infrared_right", "color")


class SentFrames(NamedTuple):
    number: int
    stamp: float
    """When it was taken, on the clock of its stamps, s."""
    t: float
    """Just before its last frame was handed to the library, on the host's monotonic clock, s."""


class FrameFeeder:
    """The thread that feeds an :class:`~.device.EmulatedDevice`; it rests without one, and while no stream is on.

    Frame numbers start with 1 when streaming starts. They count the frames of the fastest stream; a slower one has
    fewer.
    """

    def __init__(self, spec: CameraSpec, emulation: Emulation) -> None:
        self.emulation = emulation
        self.streams = make_streams(spec)
        self.images = EmulatedImages(self.streams, emulation.pattern, emulation.seed)
        self.modes: dict[str, StreamMode] = {}
        """Modes of the streams that are on."""
        self.late = 0
        """Number of frame sets that were taken more than a period late, because this thread was held up."""
        self.sent: deque[SentFrames] = deque(maxlen=_KEPT)
        self.faults = CameraFaults()
        self._device: EmulatedDevice | None = None
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._random = np.random.default_rng(emulation.seed)
        self._created = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="realsense-emulator", daemon=True)
        self._thread.start()

    def set_device(self, device: EmulatedDevice | None) -> None:
        """Feed another device from now on, or none. When this returns, nothing more is sent to the last one."""
        with self._lock:
            self._device = device

    def stop(self) -> None:
        self._stopped.set()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        tick, due = 0, 0.0
        while not self._stopped.is_set():
            if self._update_modes():
                due = time.monotonic()
            if not self.modes:
                tick = 0
                self._stopped.wait(_IDLE)
                continue
            period = 1.0 / max(mode.rate for mode in self.modes.values())
            due += period
            if self._stopped.wait(max(0.0, due - time.monotonic())):
                return
            if time.monotonic() - due > period:
                self.late += 1
                due = time.monotonic()
            tick += 1
            with self._lock:
                if self._device is not None:
                    self._send(self._device, tick, due)

    def _update_modes(self) -> bool:
        """Read which streams are on, and prepare their images; return whether they have changed."""
        with self._lock:
            modes = self._device.streaming() if self._device is not None else {}
        if modes == self.modes:
            return False
        for name, mode in modes.items():
            self.images.prepare(name, mode)
        self.modes = modes
        return True

    def _send(self, device: EmulatedDevice, tick: int, taken: float) -> None:
        """Send the frames of one capture time, those of each sensor together."""
        fastest = max(mode.rate for mode in self.modes.values())
        due = {
            name: tick * mode.rate // fastest
            for name in _ORDER
            if (mode := self.modes.get(name)) and tick * mode.rate // fastest != (tick - 1) * mode.rate // fastest
        }
        due = {name: number for name, number in due.items() if not self._is_lost(name, number)}
        last, delayed = next(reversed(due), None), 0.0
        for name, number in due.items():
            if name in ("color", next(iter(due))) and self.emulation.arrival_jitter:
                delay = max(delayed, self.emulation.arrival_jitter * self._random.random())
                time.sleep(delay - delayed)
                delayed = delay
            mode = self.modes[name]
            image = self.images.prepare(name, mode)[number % PHASES]
            draw_number(image, mode.format, number)
            stamp, domain = self._stamp(device, name, taken)
            number += self.emulation.color_ahead if name == "color" else 0
            if self.emulation.metadata:
                device.set_metadata(name, self._metadata(mode, number, taken))
            if name == last:
                self.sent.append(SentFrames(due[name], stamp / 1e3, time.monotonic()))
            device.push(name, mode, image, number, stamp, domain)

    def _is_lost(self, name: str, number: int) -> bool:
        faults = self.faults
        dropped = faults.drop > 0 and number % faults.drop == 0 and faults.drop_stream in (None, name)
        return faults.freeze or dropped

    def _stamp(self, device: EmulatedDevice, name: str, taken: float) -> tuple[float, str]:
        """Return the stamp of a frame, ms, and its clock."""
        later = self.faults.skew if name == "color" else 0.0
        if self.emulation.clock == "system":
            return 1e3 * (time.time() + later), "system_time"
        if device.uses_global_time(name):
            return 1e3 * (taken + time.time() - time.monotonic() + later), "global_time"
        return 1e3 * self._sensor_time(taken + later), "hardware_clock"

    def _sensor_time(self, t: float) -> float:
        passed = (t - self._created) * (1.0 + 1e-6 * self.emulation.drift_ppm)
        return (self.emulation.clock_at + passed) % _WRAP

    def _metadata(self, mode: StreamMode, number: int, taken: float) -> dict[str, int]:
        microseconds = round(1e6 * self._sensor_time(taken))
        return {
            "frame_counter": number,
            "actual_fps": 1000 * mode.rate,  # the matcher divides by 1000
            "frame_timestamp": microseconds,
            "sensor_timestamp": microseconds,
            "time_of_arrival": round(1e3 * time.time()),
        }
