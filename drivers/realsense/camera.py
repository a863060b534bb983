"""The camera driver in the app's process. The vendor's library runs in a process of its own, see :mod:`.process`."""

from __future__ import annotations

import importlib.util
import logging
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from types import MappingProxyType
from typing import Any

from hal.arguments import freeze
from hal.driver import CameraDriver, CameraInfo, CameraTally, RawFrame, StreamInfo
from hal.errors import ConnectionLost, DeviceNotFound
from hal.geometry import Pose
from hal.host.process import Child, SharedMemory, unpack_error
from hal.host.ring import FrameRing
from hal.specs import CameraSpec, to_json

from .options import RealSenseSettings

if importlib.util.find_spec("pyrealsense2") is None:  # this process does without it, the camera's own does not
    raise ModuleNotFoundError("No module named 'pyrealsense2'", name="pyrealsense2")

_LOG = logging.getLogger("hal.realsense")
_OPEN = 12.0
"""s to find a camera, start it and receive its first frames. The library itself gives up after 15 s."""
_SHUT = 2.0
"""s to stop it. A library that takes longer hangs, and is killed with its process."""
_ANSWER = 5.0
"""s for the answer to any other request."""
_FORCE = 0.2
"""s that a process which no longer works gets to end by itself."""
_MARGIN = 2.0
"""s beyond a stall after which the process itself must hang, because it reports every stall."""
_PLAYED_STALL = 10.0
"""s; a recording may contain a pause."""
_ATTEMPTS = 3
"""Number of tries of the first ``open`` to start a camera that is connected and sends nothing."""
_RESET_AFTER = 2
"""Starts in a row without a frame after which the camera is reset, once until frames arrive."""
_RESTART = 10.0
"""s for a camera to come back after a reset."""
_PAUSE = 0.5
"""s between two attempts to start."""
_READY = 30.0
"""s for the process to start and to import the library."""
_SLICE = 0.05
"""s that one thread listens before another one has a turn."""
_PATIENCE = 1.0
"""s for a process to end by itself."""


class RealSenseCamera(CameraDriver):
    """A RealSense on USB, a recording, or an emulated camera, as ``real:`` of the rig file selects.

    The options are those of :class:`.options.RealSenseSettings`. The faults that ``inject`` takes, for an emulated
    camera, are the fields of ``hal_emulators.realsense.CameraFaults``.
    """

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
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
        """Whether the camera was lost, so that a ``close`` is followed by another ``open``."""
        self._tally_before = CameraTally()
        self._failed_starts = 0
        """Starts in a row without a frame."""
        self._was_reset = False
        self._starts = self._sessions = 0
        self._ended: ConnectionLost | None = None
        """Why no frame will ever come again; None while some may."""

    @classmethod
    def list_plugged(cls) -> tuple[str, ...]:
        """Return the connected cameras, each with title, serial number and USB link. Takes half a second."""
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
        if self._ended is not None:
            raise _copy(self._ended)
        attempts = 1 if self._sessions else _ATTEMPTS
        for attempt in range(attempts):
            try:
                self._start()
                return
            except ConnectionLost as error:
                if error.code != "no_frames":
                    raise
                self._failed_starts += 1
                reset = self._reset_if_due()
                if attempt == attempts - 1:
                    text = f"{error}; {reset}" if reset else str(error)
                    raise ConnectionLost(text, code="no_frames") from None
                _LOG.warning("camera %s: %s; %s", self.spec.name, error, reset or "trying again")
                time.sleep(_PAUSE)
            except DeviceNotFound:
                if self._was_reset and self._await_return():
                    return
                raise

    def _start(self) -> None:
        """Start the camera in its process, and take over its description."""
        link = self._connect()
        began = time.monotonic()
        try:
            before = None if self._info is None else self._info.serial
            opened = link.request("open", _OPEN, before=before, first=self._starts == 0)
            self._starts += 1
        except ConnectionLost as error:
            self._lost = self._sessions > 0
            self._starts += 1
            if error.code != "no_frames":
                self._drop(link)
                if time.monotonic() - began >= _OPEN:
                    error.code = "no_frames"
            raise
        except BaseException:
            self._lost = self._sessions > 0  # it may be connected again later
            raise
        link.start_session(opened["before"])
        self._info = _info_from(opened)
        self._sessions += 1
        self._lost = False
        self._log_opened(opened["notes"], opened["residual"])

    def _connect(self) -> CameraLink:
        """Return the link to the camera's process; start one if there is none.

        Raises ConnectionLost if another thread closes the camera meanwhile; the new process is then ended.
        """
        with self._lock:
            link, closings = self._link, self._closings
        if link is not None and link.is_alive:
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
        link.close(_FORCE)
        raise ConnectionLost(f"camera {self.spec.name} was closed while it was being opened", code="closed")

    def _log_opened(self, notes: list[str], residual: float) -> None:
        """Log what the user should know about the camera that was opened."""
        for note in notes:
            _LOG.info("camera %s: %s", self.spec.name, note)
        assert self._info is not None
        if self._info.usb and self._info.usb.startswith("2"):
            _LOG.warning(
                "camera %s is on USB %s, which has fewer modes and loses frames: use a USB 3 port and cable",
                self.spec.name,
                self._info.usb,
            )
        if self._info.clock == "system" and self._sessions == 1:
            _LOG.warning(
                "camera %s: its frames carry no metadata, as with a kernel without RealSense's patches: frames are "
                "matched by their arrival, and stamps include each frame's transfer time (docs/realsense.md, Clocks)",
                self.spec.name,
            )
        if residual > 0.1:
            _LOG.warning(
                "camera %s: OpenCV's distortion differs from the camera's own by up to %.2f pixels",
                self.spec.name,
                residual,
            )

    def _reset_if_due(self) -> str:
        """Reset a camera that is connected and sends nothing, if it is time; return a description, empty if not."""
        if self._failed_starts < _RESET_AFTER or self._was_reset or not self._settings.is_real:
            return ""
        self._was_reset = True
        with suppress(ConnectionLost, DeviceNotFound):
            return str(self._connect().request("reset", _ANSWER))
        return ""

    def _await_return(self) -> bool:
        """Wait after a reset until the camera is connected again and started; False if it does not come back."""
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
        if self._ended is not None:
            raise _copy(self._ended)
        if link is None:
            raise ConnectionLost(f"camera {self.spec.name} is not open", code="not_open")
        try:
            frame = link.next_frame(timeout, self.on_demand)
        except ConnectionLost:
            self._lost = True
            self._drop(link)
            raise
        self.tally = self._total_tally(link)
        if frame is not None:
            self._failed_starts, self._was_reset = 0, False
            return frame
        if link.lost is not None:
            self._lost = True
            if link.lost.final:
                self._ended = link.lost
            raise _copy(link.lost)
        if link.silence > self._silence:
            self._lost = True
            self._drop(link)
            text = f"the camera's process has been silent for {link.silence:.1f} s: the library hangs in it"
            raise ConnectionLost(text, code="process_silent")
        return None

    def inject(self, **knobs: object) -> None:
        link = self._link
        if link is None:
            raise ConnectionLost(f"camera {self.spec.name} is not open", code="not_open")
        link.request("inject", _ANSWER, **knobs)

    def close(self) -> None:
        """Stop. The process of a lost camera is kept for the next ``open``; a second ``close`` ends it as well."""
        with self._lock:
            self._closings += 1
            again, self._is_closed = self._is_closed, True
            link = self._link
        if link is None:
            return
        if again or not self._lost:
            self._drop(link, _SHUT)
            return
        try:
            link.request("shut", _SHUT)
        except ConnectionLost:
            self._drop(link)

    def _drop(self, link: CameraLink, patience: float = _FORCE) -> None:
        """End the process; kill it if it does not end within ``patience`` s."""
        with self._lock:
            if self._link is not link:
                return
            self._link = None
        self._tally_before = self._total_tally(link)
        link.close(patience)

    def _total_tally(self, link: CameraLink) -> CameraTally:
        tally, before = link.tally, self._tally_before
        return CameraTally(before.repeated + tally.repeated, before.mismatched + tally.mismatched)


class CameraLink:
    """The app's end of the process with one camera: requests with time limits, frames, and a bounded ``close``.

    All methods may be called from any thread. Starts the process; raises DriverMissing if the library is missing.
    """

    def __init__(self, spec: CameraSpec) -> None:
        self._memory = SharedMemory(FrameRing.size(spec))
        self._ring = FrameRing(self._memory.buffer, spec)
        self._child = Child(
            f"camera {spec.name}",
            "hal.drivers.realsense.process:main",
            {"spec": to_json(spec)},
            [self._memory],
            self._handle_news,
        )
        self._taking = threading.Lock()
        self._after = 0
        """Number of the last frame that was taken."""
        self.silence = 0.0
        """Time spent waiting for frames since the process last sent anything, s."""
        self.lost: ConnectionLost | None = None
        """The loss of the camera that the process reported; None while the camera works."""
        try:
            self._child.wait_ready(_READY)
        except BaseException:
            self.close()
            raise

    @property
    def is_alive(self) -> bool:
        return self._child.is_alive

    @property
    def tally(self) -> CameraTally:
        """Counts of frame sets that were not handed out since the process started."""
        return self._ring.tally

    def request(self, method: str, timeout: float, **params: Any) -> Any:
        """Send one of the requests that :mod:`.process` serves, and return its answer.

        Raises ConnectionLost if the process has ended, or does not answer within ``timeout`` s (it hangs, and must be
        ended), and the HalError that the request raised in the process.
        """
        return self._child.request(method, params, timeout)

    def start_session(self, before: int) -> None:
        """Skip the frames up to number ``before``, which belong to an earlier session."""
        self._after, self.silence, self.lost = before, 0.0, None

    def next_frame(self, timeout: float, every: bool) -> RawFrame | None:
        """Return the newest frame that was not taken yet; None if none came within ``timeout`` s.

        With ``every``, return each frame in turn. Its time is then the present, because it may have waited in the ring
        for minutes. Raises ConnectionLost if the process has ended.
        """
        deadline = time.monotonic() + timeout
        listened = False
        while True:
            with self._taking:  # otherwise two threads could take one frame, and the slower one step back to it
                taken = self._ring.read(self._after, every)
                if taken is not None:
                    self._after, frame = taken
                    self.silence = 0.0
                    return frame._replace(t=time.monotonic()) if every else frame
            now = time.monotonic()
            if self.lost is not None or (listened and now >= deadline):
                return None
            if self._child.listen(min(_SLICE, max(0.0, deadline - now))):
                self.silence = 0.0
            else:
                self.silence += min(time.monotonic() - now, 2.0 * _SLICE)
            listened = True

    def _handle_news(self, news: dict[str, Any]) -> None:
        if "lost" in news:
            lost = unpack_error(news["lost"])
            assert isinstance(lost, ConnectionLost)
            self.lost = lost

    def close(self, timeout: float = _PATIENCE) -> None:
        self._child.close(timeout)
        self._memory.close()


def _copy(error: ConnectionLost) -> ConnectionLost:
    copied = ConnectionLost(str(error), code=error.code)
    copied.final = error.final
    return copied


def _info_from(opened: Mapping[str, Any]) -> CameraInfo:
    """Return the camera's record, from the plain data of :meth:`.device.RealSenseDevice.open`."""
    streams = {
        name: StreamInfo(**_freeze_arrays({**stream, "T_color_stream": Pose(*stream["T_color_stream"])}))
        for name, stream in opened["streams"].items()
    }
    known = {field.name: opened[field.name] for field in fields(CameraInfo)}
    tables = {"streams": MappingProxyType(streams), "options": MappingProxyType(opened["options"])}
    return CameraInfo(**_freeze_arrays({**known, **tables}))


def _freeze_arrays(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a record, with lists as arrays."""
    return {key: freeze(value) if isinstance(value, list) else value for key, value in record.items()}
