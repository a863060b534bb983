"""One RealSense, from the search for it to its pictures. Lives in a process of its own (:mod:`.process`)."""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyrealsense2 as rs

from hal.errors import ConnectionLost, NotSupported
from hal.lock import DeviceLock
from hal.specs import CameraSpec

from . import options
from .calibration import calibration_of
from .devices import Found, claim_camera, described, find, said
from .modes import choose
from .recordings import Recordings
from .ring import PictureRing
from .session import Live, Playing, Session
from .settings import RealSenseSettings
from .streaming import Streaming

__all__ = ["Station"]

_FIRST_SET = 3.0
"""s that a camera which was started may take for its first set of pictures."""
_RESTART_WARM_UP = 0.3
"""s of warm-up where the camera was open before: its exposure was right a moment ago."""


class Station:
    """The library's objects for one camera: a context for as long as the process lives, a session at a time.

    Nothing of the library is shared with another camera: each has its own process, and so its own context.
    """

    def __init__(self, spec: CameraSpec, ring: PictureRing, tell: Callable[[dict[str, Any]], None]) -> None:
        """``tell`` is called with news, from the thread that takes the frames: ``frame`` and ``lost``."""
        self._spec = spec
        self._settings = RealSenseSettings.of(spec)
        self._ring = ring
        self._tell = tell
        self._context, self._emulated = self._plug(spec)
        self._claim: DeviceLock | None = None
        self._recordings: Recordings | None = None
        if self._settings.record is not None:
            self._recordings = Recordings(self._settings.record, spec.name, self._settings.overwrite)
        self._session: Session | None = None
        self._streaming: Streaming | None = None
        self._played = ""
        """The recording that the context holds."""
        self._removed: Callable[[Any], None] | None = None
        self._context.set_devices_changed_callback(self._devices_changed)

    def _plug(self, spec: CameraSpec) -> tuple[Any, Any]:
        """The library's context, and the emulated camera in it where the rig wants one."""
        if self._settings.emulated is None:
            return rs.context(), None
        from .emulator import SoftwareCamera, emulated_context

        context, emulated = emulated_context(), SoftwareCamera(spec, **self._settings.emulated)
        emulated.attach(context)
        return context, emulated

    @property
    def is_open(self) -> bool:
        """Does it stream, or did it until its camera was lost?"""
        return self._streaming is not None

    def open(self, *, again: bool = False, first: bool = True) -> dict[str, Any]:
        """Find the camera, set its options, start it and see a first set of pictures; what it is comes back.

        ``again``: it was open before. ``first``: a recording would be the first one of the program.
        Raises what :meth:`hal.driver.CameraDriver.open` raises. A ConnectionLost of a camera that is there,
        and that nobody else has, has an attribute ``fruitless``.
        """
        self.close()
        try:
            return self._open(again, first)
        except BaseException:
            self.close()
            raise

    def _open(self, again: bool, first: bool) -> dict[str, Any]:
        found = self._find()
        chosen = choose(found.device, self._spec)
        sensors = options.sensors_of(found.device)
        notes: tuple[str, ...] = ()
        if not self._played:
            notes = options.apply(sensors, self._settings.options)
        with_exposure = not self._played and options.is_automatic(sensors)
        told = options.present(sensors)
        self._session = self._start(found, chosen, first)
        warm_up = min(self._settings.warm_up_s, _RESTART_WARM_UP) if again else self._settings.warm_up_s
        self._streaming = Streaming(
            self._spec,
            chosen,
            self._session,
            self._ring,
            self._tell,
            stall=self._settings.stall_s,
            warm_up=warm_up if with_exposure else 0.0,
            every=self.takes_every,
        )
        seen = self._streaming.wait_for_first(_FIRST_SET)
        if seen is None:
            if self._streaming.why or self._played:
                raise ConnectionLost(f"{found}: {self._streaming.why or 'nothing in it can be played'}")
            raise _fruitless(f"{found} was started and sent nothing within {_FIRST_SET:g} s")
        return {
            "title": found.title,
            "serial": found.serial,
            "firmware": found.firmware,
            "usb": found.usb,
            "clock": seen.clock,
            "options": told,
            "notes": list(notes),
            "before": seen.before,
            **calibration_of(self._spec, found.device, chosen, self._streaming.cropping),
        }

    @property
    def takes_every(self) -> bool:
        """Does every frame count, however late it is asked for?"""
        return self._settings.play is not None and not self._settings.paced

    def _find(self) -> Found:
        settings = self._settings
        if settings.play is not None:
            return self._load(settings.play)
        if self._emulated is not None:
            return find(self._context, self._emulated.serial, self._spec.name)
        found = find(self._context, settings.serial, self._spec.name)
        self._claim = claim_camera(found.serial)
        return found

    def _load(self, file: str) -> Found:
        if not Path(file).is_file():
            raise NotSupported(f"there is no recording {file}")
        try:
            device = self._context.load_device(file)
        except RuntimeError as error:
            raise NotSupported(f"{file} is no recording that can be played: {error}") from None
        self._played = file
        return described(device, said(device, rs.camera_info.serial_number) or "unknown")

    def _start(self, found: Found, chosen: dict[str, Any], first: bool) -> Session:
        settings = self._settings
        if self._played:
            return Playing(self._context, self._played, chosen, repeat=settings.repeat, paced=settings.paced)
        record = self._recordings.next(first) if self._recordings is not None else None
        try:
            session = Live(self._context, found.device, found.serial, chosen, record)
        except ConnectionLost as error:
            raise _fruitless(str(error)) from None
        self._removed = session.removed
        return session

    def _devices_changed(self, news: Any) -> None:
        """From a thread of the library."""
        removed = self._removed
        if removed is not None:
            removed(news)

    def reset(self) -> str:
        """Have the camera restart, as if it were unplugged for some seconds; what happened comes back in words."""
        self.close()
        found = self._find()
        try:
            found.device.hardware_reset()
        except RuntimeError as error:  # "not implemented" by a camera in software
            return f"{found} could not be reset: {error}"
        finally:
            self._let_go()
        return f"{found} was reset, and will be back in some seconds"

    def inject(self, **knobs: Any) -> None:
        """Faults of an emulated camera (:class:`.emulator.knobs.Knobs`). Raises NotSupported where it is real."""
        if self._emulated is None:
            raise NotSupported("only an emulated camera has faults to inject (real: {emulated: true})")
        self._emulated.inject(**knobs)

    def close(self) -> None:
        """Stop streaming and let go of the camera. Idempotent; an emulated one stays plugged in."""
        self._removed = None
        if self._streaming is not None:
            self._streaming.end()
            self._streaming = None
        if self._session is not None:
            with suppress(RuntimeError):  # a camera that is gone cannot be stopped
                self._session.stop()
            self._session = None
        self._let_go()

    def _let_go(self) -> None:
        if self._played:
            with suppress(RuntimeError):
                self._context.unload_device(self._played)
            self._played = ""
        if self._claim is not None:
            self._claim.release()
            self._claim = None
        gc.collect()  # what the library holds open goes with the last of its objects

    def end(self) -> None:
        """Close, let go of the recordings, and take the emulated camera away. Idempotent."""
        self.close()
        if self._recordings is not None:
            self._recordings.end()
        if self._emulated is not None:
            self._emulated.close()
            self._emulated = None


def _fruitless(text: str) -> ConnectionLost:
    """The error of a camera that is there, and that nobody else has."""
    error = ConnectionLost(text)
    vars(error)["fruitless"] = True
    return error
