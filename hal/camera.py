"""A camera: the driver's abstract class and the public class."""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import ConnectionLost, NotSupported, StaleStateError
from .histogram import Histogram
from .pose import Pose, frozen
from .types import Frame, Stamp

if TYPE_CHECKING:
    from .clock import Clock
    from .specs import CameraSpec

__all__ = ["Camera", "CameraCounts", "CameraDriver", "RawFrame"]

_LOG = logging.getLogger("hal.camera")


class RawFrame(NamedTuple):
    """One capture as a driver hands it over: already at the output's size, colour as RGB, depth in metres."""

    t: float
    """When it was taken, on the host's clock, s: for a simulated frame, the time of the world that it shows."""
    t_device: float
    seq: int
    color: NDArray[np.uint8] | None
    depth: NDArray[np.float32] | None
    infrared: NDArray[np.uint8] | None
    segmentation: NDArray[np.int32] | None
    T_world_camera: Pose | None


class CameraDriver(ABC):
    """One camera. The calls come from one thread, which may be another one than that of ``open``."""

    simulated: ClassVar[bool] = False

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        self.spec = spec
        self.source = source
        """Where a simulated camera gets its pictures from; the rig's clock where nothing draws for it."""

    @abstractmethod
    def open(self) -> None:
        """Connect and start streaming."""

    @abstractmethod
    def grab(self, timeout: float) -> RawFrame | None:
        """The newest frame that was not handed out yet; waits up to ``timeout`` s, then None.

        Raises :class:`~hal.errors.ConnectionLost` when the device is gone.
        """

    def inject(self, **knobs: object) -> None:
        """Switch faults on or off, for tests. Only drivers that simulate have any."""
        raise NotSupported(f"driver {type(self).__name__} has no faults to inject")

    @abstractmethod
    def close(self) -> None:
        """Stop streaming, let go of the device. Idempotent."""


class CameraCounts(NamedTuple):
    """What a camera has done so far."""

    frames: int
    dropped: int
    """Frames that the camera took and this program never saw: gaps in the numbers."""
    fps: float | None
    """Over the whole run; None before two frames."""
    age_p50: float | None
    """Median age of a frame when it arrived, s."""


class Camera:
    """One camera of a rig, the same whatever driver it ends in. Made by :func:`hal.open`.

    In real time a thread of its own takes every frame from the driver, so a slow camera never holds up its reader,
    and ``latest`` never waits. In lock-step ``read`` draws the present state of the world.
    """

    def __init__(self, driver: CameraDriver, clock: Clock, *, threaded: bool) -> None:
        self.spec = driver.spec
        self.name = driver.spec.name
        self.clock = clock
        self._driver = driver
        self._threaded = threaded
        self._news = threading.Condition()
        self._newest: Frame | None = None
        self._handed_out = -1
        self._error: ConnectionLost | None = None
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._listeners: dict[object, Callable[[Frame], None]] = {}
        self._ages = Histogram(5e-4, 2000)
        self._first = self._last = 0.0
        self._frames = self._dropped = 0
        self._K = frozen(self.spec.K)
        self._distortion = frozen(self.spec.distortion)

    def open(self) -> None:
        """Connect and start to take frames; :func:`hal.open` does it."""
        self._driver.open()
        if self._threaded:
            self._thread = threading.Thread(target=self._take, name=f"hal-camera-{self.name}", daemon=True)
            self._thread.start()

    @property
    def K(self) -> NDArray[np.float64]:
        """Camera matrix (3, 3), pixels."""
        return self._K

    def read(self, timeout: float = 1.0, after: float | None = None) -> Frame:
        """The next frame that was not handed out yet; with ``after``, the first one taken at that time or later.

        In real time a frame shows what was some ms ago: after a motion, ``read(after=rig.clock.now())`` shows its end.

        Raises StaleStateError when none came within ``timeout`` s, ConnectionLost when the camera is gone.
        """
        if not self._threaded:
            return self._grab(timeout)
        with self._news:
            fresh = self._news.wait_for(lambda: self._error is not None or self._unseen(after), timeout)
            if self._error is not None:
                raise self._error
            if not fresh:
                raise StaleStateError(f"camera {self.name} took no frame within {timeout:g} s")
            return self._hand_out()

    def latest(self, max_age: float = 0.2) -> Frame:
        """The newest frame, handed out before or not; never waits.

        Raises StaleStateError when it is older than ``max_age`` s, ConnectionLost when the camera is gone.
        """
        if not self._threaded:
            newest = self._newest
            return newest if newest is not None and newest.stamp.t == self.clock.now() else self._grab(1.0)
        with self._news:
            if self._error is not None:
                raise self._error
            if self._newest is None:
                raise StaleStateError(f"camera {self.name} has taken no frame yet")
            age = self.clock.now() - self._newest.stamp.t
            if age > max_age:
                raise StaleStateError(f"the newest frame of camera {self.name} is {age:.3f} s old")
            return self._hand_out()

    def on_frame(self, callback: Callable[[Frame], None]) -> Callable[[], None]:
        """In real time, call ``callback`` with every frame, from the camera's thread; what comes back ends that.

        It delays the next frame for as long as it takes. An exception in it ends it,
        and is logged.
        """
        token = object()
        with self._news:
            self._listeners[token] = callback

        def detach() -> None:
            with self._news:
                self._listeners.pop(token, None)

        return detach

    def counts(self) -> CameraCounts:
        """Frames, gaps, rate and age so far."""
        with self._news:
            span = self._last - self._first
            fps = (self._frames - 1) / span if self._frames > 1 and span > 0.0 else None
            return CameraCounts(self._frames, self._dropped, fps, self._ages.percentile(0.5))

    def _unseen(self, after: float | None) -> bool:
        newest = self._newest
        if newest is None or newest.stamp.seq == self._handed_out:
            return False
        return after is None or newest.stamp.t >= after

    def wait_for_first(self, timeout: float) -> bool:
        """Is there a frame to hand out, now or within ``timeout`` s?"""
        if not self._threaded:
            return True
        with self._news:
            return self._news.wait_for(lambda: self._error is not None or self._newest is not None, timeout)

    def _hand_out(self) -> Frame:
        assert self._newest is not None
        self._handed_out = self._newest.stamp.seq
        return self._newest

    def _grab(self, timeout: float) -> Frame:
        raw = self._driver.grab(timeout)
        if raw is None:
            raise StaleStateError(f"camera {self.name} took no frame within {timeout:g} s")
        self._newest = self._frame(raw)
        return self._hand_out()

    def _take(self) -> None:
        while not self._closing.is_set():
            try:
                raw = self._driver.grab(0.1)
                if raw is None:
                    continue
                frame = self._frame(raw)
            except Exception as error:
                lost = error if isinstance(error, ConnectionLost) else ConnectionLost(f"camera {self.name}: {error!r}")
                with self._news:
                    self._error = lost
                    self._news.notify_all()
                self._closing.wait(0.2)
                continue
            with self._news:
                self._error = None
                self._newest = frame
                self._news.notify_all()
                listeners = tuple(self._listeners.items())
            for token, callback in listeners:
                try:
                    callback(frame)
                except Exception:
                    _LOG.exception(
                        "camera %s: what was called with every frame failed, and is called no more", self.name
                    )
                    with self._news:
                        self._listeners.pop(token, None)

    def _frame(self, raw: RawFrame) -> Frame:
        for image in (raw.color, raw.depth, raw.infrared, raw.segmentation):
            if image is not None:
                image.flags.writeable = False
        newest = self._newest
        if newest is None:
            self._first = raw.t
        else:
            self._dropped += max(0, raw.seq - newest.stamp.seq - 1)
        self._last = raw.t
        self._frames += 1
        self._ages.add(self.clock.now() - raw.t)
        return Frame(
            stamp=Stamp(raw.t, raw.t_device, raw.seq),
            color=raw.color,
            depth=raw.depth,
            infrared=raw.infrared,
            segmentation=raw.segmentation,
            K=self._K,
            distortion=self._distortion,
            T_world_camera=raw.T_world_camera,
        )

    def close(self) -> None:
        """Stop taking frames. Idempotent."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
            self._thread = None
        self._driver.close()

    def __repr__(self) -> str:
        spec = self.spec
        return f"<Camera {self.name}: {spec.width}x{spec.height} at {spec.rate_hz:g} Hz, driver {spec.driver}>"
