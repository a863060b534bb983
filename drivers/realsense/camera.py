"""The driver of a RealSense camera: the app's side. The library itself is in another process, see :mod:`.process`."""

from __future__ import annotations

import importlib.util
import logging
import threading
import time
from contextlib import suppress

from hal.driver import CameraDriver, CameraInfo, CameraTally, RawFrame
from hal.errors import ConnectionLost, DeviceNotFound
from hal.host.process import Child
from hal.specs import CameraSpec

from .about import info_of
from .link import CameraLink
from .settings import RealSenseSettings
from .stamps import SYSTEM

__all__ = ["RealSenseCamera"]

if importlib.util.find_spec("pyrealsense2") is None:  # the app's process does without it, its own does not
    raise ModuleNotFoundError("No module named 'pyrealsense2'", name="pyrealsense2")

_LOG = logging.getLogger("hal.realsense")
_OPEN = 12.0
"""s to find a camera, start it and see its first pictures. The library gives up after 15 s on its own."""
_SHUT = 2.0
"""s to stop it. A library that takes longer hangs, and is ended with its process."""
_ANSWER = 5.0
_FORCE = 0.2
"""s that a process has to end by itself which is not trusted any more."""
_MARGIN = 2.0
"""s beyond a stall after which the process itself must hang, for it tells of every stall."""
_PLAYED_STALL = 10.0
"""s; a recording may hold a pause."""
_ATTEMPTS = 3
"""How often the first ``open`` tries to start a camera that is there and sends nothing."""
_FRUITLESS = 2
"""So many starts without a picture, one after the other, are answered with a reset, once until pictures come."""
_RESTART = 10.0
"""s for a camera to come back after a reset."""
_PAUSE = 0.5


class RealSenseCamera(CameraDriver):
    """A RealSense: on USB, played from a recording, or in software; ``real:`` says which (:mod:`.settings`).

    Faults of a camera in software: :class:`.emulator.knobs.Knobs`.
    """

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        """Raises ConfigError."""
        super().__init__(spec, source)
        self._settings = RealSenseSettings.of(spec)
        played = self._settings.play is not None
        self.on_demand = played and not self._settings.paced
        self._silence = max(self._settings.stall_s, _PLAYED_STALL if played else 0.0, 3.0 / spec.rate_hz) + _MARGIN
        self._info: CameraInfo | None = None
        self._link: CameraLink | None = None
        self._lock = threading.Lock()
        self._closings = 0
        self._is_closed = False
        self._lost = False
        """Was the camera lost, so that whoever closes it now opens it again?"""
        self._tally_before = CameraTally()
        self._fruitless = 0
        self._was_reset = False
        self._starts = self._sessions = 0
        self._ended = ""
        """Why no more pictures will come, ever."""

    @classmethod
    def plugged(cls) -> tuple[str, ...]:
        """The cameras that are plugged in, each with title, serial number and link. Takes half a second."""
        child = Child("list of cameras", "hal.drivers.realsense.process:list_plugged", {})
        try:
            return tuple(child.wait_ready(_OPEN))
        finally:
            child.close(_SHUT)

    @property
    def info(self) -> CameraInfo:
        return self._info if self._info is not None else super().info

    def open(self) -> None:
        self._is_closed = False
        if self._ended:
            raise self._over(self._ended)
        attempts = 1 if self._sessions else _ATTEMPTS
        for attempt in range(attempts):
            try:
                self._start()
                return
            except ConnectionLost as error:
                if not hasattr(error, "fruitless"):
                    raise
                self._fruitless += 1
                reset = self._reset_if_due()
                if attempt == attempts - 1:
                    raise ConnectionLost(f"{error}; {reset}" if reset else str(error)) from None
                _LOG.warning("camera %s: %s; %s", self.spec.name, error, reset or "trying again")
                time.sleep(_PAUSE)
            except DeviceNotFound:
                if self._was_reset and self._await_return():
                    return
                raise

    def _start(self) -> None:
        link = self._linked()
        began = time.monotonic()
        try:
            said = link.ask("open", _OPEN, again=self._sessions > 0, first=self._starts == 0)
            self._starts += 1
        except ConnectionLost as error:
            self._lost = self._sessions > 0
            self._starts += 1
            if not hasattr(error, "fruitless"):
                self._drop(link)
                if time.monotonic() - began >= _OPEN:
                    vars(error)["fruitless"] = True
            raise
        except BaseException:
            self._lost = self._sessions > 0  # then it may be plugged in again
            raise
        link.begin(said["before"])
        self._info = info_of(said)
        self._sessions += 1
        self._lost = False
        self._say(said["notes"], said["residual"])

    def _linked(self) -> CameraLink:
        """The camera's process. Another thread may close the camera meanwhile: then it is ended, and none is begun."""
        with self._lock:
            link, closings = self._link, self._closings
        if link is not None and link.alive:
            return link
        if link is not None:
            self._drop(link)
            with self._lock:
                closings = self._closings
        link = CameraLink(self.spec)
        with self._lock:
            if closings == self._closings:
                self._link = link
                return link
        link.end(_FORCE)
        raise ConnectionLost(f"camera {self.spec.name} was closed while it was opened")

    def _say(self, notes: list[str], residual: float) -> None:
        for note in notes:
            _LOG.info("camera %s: %s", self.spec.name, note)
        assert self._info is not None
        if self._info.usb and self._info.usb.startswith("2"):
            _LOG.warning(
                "camera %s is on USB %s, where it has fewer modes and loses frames: try a USB 3 port and cable",
                self.spec.name,
                self._info.usb,
            )
        if self._info.clock == SYSTEM and self._sessions == 1:
            _LOG.warning(
                "camera %s: its frames carry no metadata, as with a kernel without RealSense's patches: pictures are "
                "matched by their arrival, and stamps are late by each frame's own way (docs/realsense.md, Clocks)",
                self.spec.name,
            )
        if residual > 0.1:
            _LOG.warning(
                "camera %s: OpenCV's distortion misses the camera's own by up to %.2f pixels", self.spec.name, residual
            )

    def _reset_if_due(self) -> str:
        """Have a camera restart that is there and sends nothing; what was done comes back in words, if anything."""
        if self._fruitless < _FRUITLESS or self._was_reset or not self._settings.is_real:
            return ""
        self._was_reset = True
        with suppress(ConnectionLost, DeviceNotFound):
            return str(self._linked().ask("reset", _ANSWER))
        return ""

    def _await_return(self) -> bool:
        """After a reset: wait until the camera is there again."""
        deadline = time.monotonic() + _RESTART
        while time.monotonic() < deadline:
            time.sleep(_PAUSE)
            try:
                self._start()
                return True
            except DeviceNotFound:
                continue
        return False

    def grab(self, timeout: float) -> RawFrame | None:
        link = self._link
        if self._ended or link is None:
            raise self._over(self._ended or f"camera {self.spec.name} is not open")
        try:
            frame = link.take(timeout, self.on_demand)
        except ConnectionLost:
            self._lost = True
            self._drop(link)
            raise
        tally, before = link.tally, self._tally_before
        self.tally = CameraTally(before.repeated + tally.repeated, before.mismatched + tally.mismatched)
        if frame is not None:
            self._fruitless, self._was_reset = 0, False
            return frame
        if link.lost:
            self._lost = True
            if link.is_final:
                self._ended = f"{link.lost}; open the rig anew to play it again"
            raise self._over(self._ended or link.lost)
        if link.quiet > self._silence:
            self._lost = True
            self._drop(link)
            raise ConnectionLost(f"the process with the library said nothing for {link.quiet:.1f} s: it hangs")
        return None

    def _over(self, text: str) -> ConnectionLost:
        lost = ConnectionLost(text)
        lost.final = bool(self._ended)
        return lost

    def inject(self, **knobs: object) -> None:
        link = self._link
        if link is None:
            raise ConnectionLost(f"camera {self.spec.name} is not open")
        link.ask("inject", _ANSWER, **knobs)

    def close(self) -> None:
        """Stop. The process of a lost camera is kept for the next ``open``; a second ``close`` ends it, too."""
        with self._lock:
            self._closings += 1
            again, self._is_closed = self._is_closed, True
            link = self._link
        if link is None:
            return
        if again or not self._lost:
            self._drop(link, _SHUT)  # for good
            return
        try:
            link.ask("shut", _SHUT)
        except ConnectionLost:
            self._drop(link)

    def _drop(self, link: CameraLink, patience: float = _FORCE) -> None:
        """End the process, by force where it does not end in time."""
        with self._lock:
            if self._link is not link:
                return
            self._link = None
        tally, before = link.tally, self._tally_before
        self._tally_before = CameraTally(before.repeated + tally.repeated, before.mismatched + tally.mismatched)
        link.end(patience)
