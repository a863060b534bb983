"""One RealSense in its own process: finding it, opening and closing it, and the files that it records to.

Runs in the process of :mod:`.process`, and is the only part that touches librealsense together with
:mod:`.pipeline`, :mod:`.streaming` and :mod:`.options`.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import pyrealsense2 as rs

from hal.errors import ConnectionLost, ControlTaken, DeviceNotFound, NotSupported
from hal.host.ring import FrameRing
from hal.lock import DeviceLock
from hal.specs import CameraSpec

from .options import RealSenseSettings, apply_options, find_sensors, has_auto_exposure, read_options
from .pipeline import FramePipeline, LivePipeline, PlaybackPipeline, choose_profiles, describe_optics
from .streaming import FrameStreamer

_FIRST_SET = 3.0
"""s that a camera may take to send its first frame set after a start."""
_RESTART_WARM_UP = 0.3
"""s of warm-up where the camera was open before: its exposure was settled a moment ago."""


class RealSenseDevice:
    """The library's objects for one camera: a context for as long as the process lives, one pipeline at a time.

    Nothing of the library is shared with another camera: each has its own process and its own context.
    """

    def __init__(self, spec: CameraSpec, ring: FrameRing, notify: Callable[[dict[str, Any]], None]) -> None:
        """Create the context, with the emulated camera in it if the rig selects one; ``notify`` gets the news."""
        self._spec = spec
        self._settings = RealSenseSettings.of(spec)
        self._ring = ring
        self._notify = notify
        self._context, self._emulated = self._create_context(spec)
        self._lock: DeviceLock | None = None
        self._recordings: RecordingFiles | None = None
        if self._settings.record is not None:
            self._recordings = RecordingFiles(self._settings.record, self._settings.overwrite)
        self._pipeline: FramePipeline | None = None
        self._streamer: FrameStreamer | None = None
        self._played = ""
        """The recording that the context holds."""
        self._on_removal: Callable[[Any], None] | None = None
        self._context.set_devices_changed_callback(self._devices_changed)

    def _create_context(self, spec: CameraSpec) -> tuple[Any, Any]:
        """Return the library's context, and the emulated camera in it; None for the latter if the camera is real."""
        if self._settings.emulated is None:
            return rs.context(), None
        from hal_emulators.realsense import SoftwareCamera, emulated_context

        context, emulated = emulated_context(), SoftwareCamera(spec, **self._settings.emulated)
        emulated.attach(context)
        return context, emulated

    @property
    def is_open(self) -> bool:
        """Whether it streams, or did until its camera was lost."""
        return self._streamer is not None

    def open(self, *, before: str | None = None, first: bool = True) -> dict[str, Any]:
        """Find the camera, set its options, start it and wait for a first frame set.

        Args:
            before: Serial number of the camera that was open before, whose exposure has settled: no other one will do.
            first: A recording made now is the first one of the program.

        Returns the camera's description as plain data: the fields of :class:`~hal.driver.CameraInfo`, ``notes`` (what
        was changed beyond the rig file), ``before`` (number of the last frame of an earlier session) and ``residual``
        (pixels, see :class:`.pipeline.LensModel`). Raises HalError as :meth:`hal.driver.CameraDriver.open`; the
        ConnectionLost of a camera that is connected and not in use has the code ``no_frames``.
        """
        self.close()
        try:
            return self._open(before, first)
        except BaseException:
            self.close()
            raise

    def _open(self, before: str | None, first: bool) -> dict[str, Any]:
        camera = self._find(before)
        profiles = choose_profiles(camera.device, self._spec)
        sensors = find_sensors(camera.device)
        notes: tuple[str, ...] = ()
        if not self._played:
            notes = apply_options(sensors, self._settings.options)
        settles = not self._played and has_auto_exposure(sensors)
        option_values = read_options(sensors)
        self._pipeline = self._start(camera, profiles, first)
        warm_up = min(self._settings.warm_up_s, _RESTART_WARM_UP) if before else self._settings.warm_up_s
        self._streamer = FrameStreamer(
            self._spec,
            profiles,
            self._pipeline,
            self._ring,
            self._notify,
            stall=self._settings.stall_s,
            warm_up=warm_up if settles else 0.0,
            every=self._settings.play is not None and not self._settings.paced,
        )
        started = self._streamer.wait_for_start(_FIRST_SET)
        if started is None:
            lost = self._streamer.lost
            if lost is not None or self._played:
                text = f"{camera}: {lost or 'it contains nothing that can be played'}"
                raise ConnectionLost(text, code=lost.code if lost is not None else "unplayable")
            raise ConnectionLost(f"{camera} was started and sent nothing within {_FIRST_SET:g} s", code="no_frames")
        return {
            **{key: getattr(camera, key) for key in ("title", "serial", "firmware", "usb")},
            "clock": started.clock,
            "options": option_values,
            "notes": list(notes),
            "before": started.before,
            **describe_optics(self._spec, camera.device, profiles, self._streamer.cropping),
        }

    def _find(self, before: str | None = None) -> ConnectedCamera:
        settings = self._settings
        if settings.play is not None:
            return self._load(settings.play)
        if self._emulated is not None:
            return find_camera(self._context, before or self._emulated.serial, self._spec.name)
        camera = find_camera(self._context, before or settings.serial, self._spec.name)
        self._lock = lock_camera(camera.serial)
        return camera

    def _load(self, file: str) -> ConnectedCamera:
        if not Path(file).is_file():
            raise NotSupported(f"there is no recording {file}", code="missing_file")
        try:
            device = self._context.load_device(file)
        except RuntimeError as error:
            raise NotSupported(f"{file} is not a recording that can be played: {error}", code="unplayable") from None
        self._played = file
        return _describe(device, _read_info(device, rs.camera_info.serial_number) or "unknown")

    def _start(self, camera: ConnectedCamera, profiles: dict[str, Any], first: bool) -> FramePipeline:
        settings = self._settings
        if self._played:
            return PlaybackPipeline(self._context, self._played, profiles, repeat=settings.repeat, paced=settings.paced)
        record = self._recordings.next_file(first) if self._recordings is not None else None
        pipeline = LivePipeline(self._context, camera.device, camera.serial, profiles, record)
        self._on_removal = pipeline.handle_removal
        return pipeline

    def _devices_changed(self, change: Any) -> None:
        """Runs in a thread of the library."""
        on_removal = self._on_removal
        if on_removal is not None:
            on_removal(change)

    def reset(self) -> str:
        """Reset the camera, as if it were unplugged for some seconds; return a description of the result."""
        self.close()
        camera = self._find()
        try:
            camera.device.hardware_reset()
        except RuntimeError as error:  # "not implemented" by an emulated camera
            return f"{camera} could not be reset: {error}"
        finally:
            self._release()
        return f"{camera} was reset, and will be back in some seconds"

    def inject(self, **faults: Any) -> None:
        """Set faults of an emulated camera. Raises NotSupported for another one, CommandError for a wrong fault."""
        if self._emulated is None:
            raise NotSupported("only an emulated camera takes faults (real: {emulated: true})", code="not_emulated")
        self._emulated.inject(**faults)

    def close(self) -> None:
        """Stop streaming and release the camera. Idempotent; an emulated one stays plugged in."""
        self._on_removal = None
        if self._streamer is not None:
            self._streamer.stop()
            self._streamer = None
        if self._pipeline is not None:
            with suppress(RuntimeError):  # a camera that is unplugged cannot be stopped
                self._pipeline.stop()
            self._pipeline = None
        self._release()

    def _release(self) -> None:
        if self._played:
            with suppress(RuntimeError):
                self._context.unload_device(self._played)
            self._played = ""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        gc.collect()  # the library closes what it holds open with the last of its objects

    def dispose(self) -> None:
        """Close, release the recording files, and unplug the emulated camera. Idempotent."""
        self.close()
        if self._recordings is not None:
            self._recordings.close()
        if self._emulated is not None:
            self._emulated.close()
            self._emulated = None


class ConnectedCamera(NamedTuple):
    device: Any
    """``rs2::device``"""
    title: str
    serial: str
    firmware: str | None
    usb: str | None

    def __str__(self) -> str:
        link = f", USB {self.usb}" if self.usb else ""
        return f"{self.title} (serial {self.serial}{link})"


def find_cameras(context: Any) -> list[ConnectedCamera]:
    """Return the cameras of a context (``rs2::context``), without those that report no serial number."""
    found = []
    for device in context.query_devices():
        serial = _read_info(device, rs.camera_info.serial_number)
        if serial:
            found.append(_describe(device, serial))
    return found


def find_camera(context: Any, serial: str | None, name: str = "") -> ConnectedCamera:
    """Return the camera with a serial number, or the only one that is connected; ``name`` is for the error.

    The connected cameras are listed first because the library, if it is to start a camera that is not connected, waits
    for 15 s. Raises DeviceNotFound if there is none, or several for ``serial=None``; lists those that are connected.
    """
    who = f"camera {name}: " if name else ""
    found = find_cameras(context)
    listed = ", ".join(map(str, found)) or "no RealSense"
    if serial is not None:
        for camera in found:
            if camera.serial == serial:
                return camera
        raise DeviceNotFound(f"{who}there is no RealSense with serial {serial}; connected: {listed}")
    if len(found) == 1:
        return found[0]
    if not found:
        raise DeviceNotFound(f"{who}no RealSense is connected; check the cable and use a USB 3 port")
    text = f'{who}several cameras are connected: {listed}; select one with real: {{serial: "{found[0].serial}"}}'
    raise DeviceNotFound(text, code="several_devices")


def lock_camera(serial: str) -> DeviceLock:
    """Lock the camera with that serial number for this process. Raises ControlTaken, naming the other process."""
    return DeviceLock(f"realsense-{serial}", f"camera {serial}")


def _describe(device: Any, serial: str) -> ConnectedCamera:
    return ConnectedCamera(
        device,
        _read_info(device, rs.camera_info.name) or "a RealSense",
        serial,
        _read_info(device, rs.camera_info.firmware_version),
        _read_info(device, rs.camera_info.usb_type_descriptor),
    )


def _read_info(device: Any, key: Any) -> str | None:
    """Return one text of a device's description; None if it has none."""
    try:
        return str(device.get_info(key)) if device.supports(key) else None
    except RuntimeError:  # it is being unplugged
        return None


class RecordingFiles:
    """Files to record to: the one given for a program's first recording, and numbered ones for those that follow.

    Every file is locked before anything is done to it, until :meth:`close` or the end of the process: two cameras with
    one file would otherwise delete each other's recording.
    """

    def __init__(self, path: str, overwrite: bool) -> None:
        self._path = Path(path)
        self._overwrite = overwrite
        self._locks: dict[Path, DeviceLock] = {}

    def next_file(self, first: bool) -> str:
        """Lock and return the file for a new recording; ``first`` is whether it is the program's first.

        Raises NotSupported if the first file exists and must not be overwritten, or if its folder is missing, and
        ControlTaken while another camera records to it.
        """
        path = self._path
        if not path.parent.is_dir():
            raise NotSupported(f"there is no folder {path.parent} for the recording", code="missing_folder")
        self._acquire(path)
        if first and self._overwrite:
            path.unlink(missing_ok=True)
        elif first and path.exists():
            raise NotSupported(f"{path} exists: move it, or set real: {{overwrite: true}}", code="file_exists")
        number = 2
        while path.exists():
            path = self._path.with_name(f"{self._path.stem}-{number}{self._path.suffix}")
            number += 1
        self._acquire(path)
        return str(path)

    def _acquire(self, path: Path) -> None:
        if path not in self._locks:
            try:
                self._locks[path] = DeviceLock(f"recording-{os.path.realpath(path)}", str(path))
            except ControlTaken as error:
                text = f"{error}: another camera records to it, use two files"
                raise ControlTaken(text, code="recording_in_use") from None

    def close(self) -> None:
        for lock in self._locks.values():
            lock.release()
        self._locks.clear()
