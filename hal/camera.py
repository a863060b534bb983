"""A camera of a rig: frames, callbacks for every frame, and reconnection in the background."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from numpy.typing import NDArray

from .clock import describe_load
from .errors import ConnectionLost, HalError, StaleStateError
from .geometry import Pose
from .histogram import Histogram
from .specs import CameraSpec, ViewSpec
from .types import STREAMS, Frame, Stamp

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from .clock import Clock
    from .driver import CameraDriver, CameraInfo, RawFrame
    from .robot import Robot

_LOG = logging.getLogger("hal.camera")
_GRAB = 0.1
"""Longest wait for a frame in the camera's thread before it checks whether to end, s."""
_SOON, _LATER = 0.2, 2.0
"""Time between two attempts to reopen a lost camera, in its first minute and after that, s."""
_MINUTE = 60.0
GIVE_UP = 1800.0
"""Time after which a lost camera is given up, s."""
_Detach = Callable[[], None]
Place = Callable[[float], "Pose | None"]
"""Returns the pose of the colour sensor in the world at a time on the rig's clock, s; None if unknown."""


class Camera:
    """One camera of a rig, the same for every driver; created by :func:`hal.open`.

    In real time a thread takes every frame from the driver, so ``read_latest`` never waits and a slow reader loses no
    time. In lock-step it returns the present state of the world, as ``read`` does, which is rendered once.

    When the camera is lost (unplugged, reset, silent), both raise ConnectionLost. It is reopened in the background for
    half an hour; the same object then works again.

    Args:
        driver: Driver of the camera.
        clock: The rig's clock.
        threaded: Whether a thread reads ahead.
        place: Pose of a camera whose driver does not report it; see :func:`find_place`.
    """

    def __init__(self, driver: CameraDriver, clock: Clock, *, threaded: bool, place: Place | None = None) -> None:
        self.spec = driver.spec
        self.name = driver.spec.name
        self.clock = clock
        self._driver = driver
        self._threaded = threaded and not driver.on_demand
        self._place = place
        self._news = threading.Condition()
        self._newest: Frame | None = None
        self._raw: RawFrame | None = None
        """The driver's frame for the newest one."""
        self._returned_seq = -1
        self._error: ConnectionLost | None = None
        self._closing = threading.Event()
        self._grabbing = threading.RLock()
        self._thread: threading.Thread | None = None
        self._listeners: dict[object, Callable[[Any], None]] = {}
        self._watchers: dict[object, Callable[[Any], None]] = {}
        self._ages = Histogram(5e-4, 2000)
        self._first = self._last = 0.0
        self._frames = self._dropped = self._reconnects = 0
        self._offset: int | None = 0
        """Added to the driver's frame numbers, which may start again on ``open``; None until the first frame after it.
        """
        self._info: CameraInfo = driver.info

    def open(self) -> None:
        """Connect and start to take frames; called by :func:`hal.open`."""
        self._driver.open()
        self._info = self._driver.info
        if self._threaded:
            self._thread = threading.Thread(target=self._run, name=f"hal-camera-{self.name}", daemon=True)
            self._thread.start()

    def refresh_info(self) -> None:
        """Take over the calibration of the driver, which has changed."""
        with self._news:
            self._info = self._driver.info

    @property
    def info(self) -> CameraInfo:
        """Serial number, calibration of every stream, link and options, read when the camera was opened."""
        return self._info

    @property
    def K(self) -> NDArray[np.float64]:
        """Camera matrix (3, 3) of the colour and depth images, pixels."""
        return self._info.K

    @property
    def connected(self) -> bool:
        """Whether the camera is connected; after a loss, from its next frame on."""
        return self._error is None

    def check(self) -> None:
        """Raise ConnectionLost while the camera does not answer."""
        if self._error is not None:
            raise self._error

    def read(self, timeout: float = 1.0, after: float | None = None) -> Frame:
        """Return the next frame that was not returned yet.

        In real time a frame shows the past by some ms: after a motion, ``read(after=rig.clock.now())`` shows its end.

        Args:
            timeout: Longest time to wait, s.
            after: Earliest time of the frame, s on ``rig.clock``; None for any.

        Raises:
            StaleStateError: No such frame came within ``timeout``.
            ConnectionLost: The camera does not answer.
        """
        if not self._threaded:
            return self._grab(timeout, after)
        with self._news:
            fresh = self._news.wait_for(lambda: self._error is not None or self._find_unseen(after), timeout)
            if self._error is not None:
                raise self._error
            if not fresh:
                raise StaleStateError(f"camera {self.name} took no frame within {timeout:g} s{describe_load()}")
            return self._return_newest()

    def read_latest(self, max_age: float = 0.2) -> Frame:
        """Return the newest frame, whether returned before or not; never waits.

        Args:
            max_age: Greatest age of the frame, s.

        Raises:
            StaleStateError: The newest frame is older, or there is none yet (``code`` is ``no_frame``).
            ConnectionLost: The camera does not answer.
        """
        if not self._threaded:
            return self._grab(1.0)
        with self._news:
            if self._error is not None:
                raise self._error
            if self._newest is None:
                raise StaleStateError(f"camera {self.name} has taken no frame yet", code="no_frame")
            age = self.clock.now() - self._newest.stamp.t
            if age > max_age:
                raise StaleStateError(f"the newest frame of camera {self.name} is {age:.3f} s old{describe_load()}")
            return self._return_newest()

    def on_frame(self, callback: Callable[[Frame], None]) -> Callable[[], None]:
        """Call a function with every frame, from the camera's thread, in real time.

        The next frame waits for it. An exception in it is logged and ends the calls.

        Returns:
            A function that ends the calls.
        """
        return self._attach(self._listeners, callback)

    def on_connection(self, callback: Callable[[ConnectionLost | None], None]) -> Callable[[], None]:
        """Call a function when the camera is lost, with the error, and when it is back, with None.

        It is called from the camera's thread. An exception in it is logged and ends the calls.

        Returns:
            A function that ends the calls.
        """
        return self._attach(self._watchers, callback)

    def _attach(self, listeners: dict[object, Callable[[Any], None]], callback: Callable[[Any], None]) -> _Detach:
        token = object()
        with self._news:
            listeners[token] = callback

        def detach() -> None:
            with self._news:
                listeners.pop(token, None)

        return detach

    def inject(self, **faults: object) -> None:
        """Switch faults on or off, for tests; see the driver's own ``inject``.

        Raises:
            NotSupported: The driver has no faults.
            CommandError: No such fault.
        """
        self._driver.inject(**faults)

    def counts(self) -> CameraCounts:
        """Return the number of frames and gaps, the rate and the age so far."""
        with self._news:
            span = self._last - self._first
            fps = (self._frames - 1) / span if self._frames > 1 and span > 0.0 else None
            tally = self._driver.tally
            return CameraCounts(
                self._frames, self._dropped, fps, self._ages.percentile(0.5), *tally, reconnects=self._reconnects
            )

    def _find_unseen(self, after: float | None) -> bool:
        newest = self._newest
        if newest is None or newest.stamp.seq == self._returned_seq:
            return False
        return after is None or newest.stamp.t >= after

    def wait_for_first(self, timeout: float) -> bool:
        """Return whether there is a frame, now or within ``timeout`` s."""
        if not self._threaded:
            return True
        with self._news:
            return self._news.wait_for(lambda: self._error is not None or self._newest is not None, timeout)

    def _return_newest(self) -> Frame:
        assert self._newest is not None
        self._returned_seq = self._newest.stamp.seq
        return self._newest

    # Without a thread: in lock-step, and for recordings without pace.

    def _grab(self, timeout: float, after: float | None = None) -> Frame:
        deadline = time.monotonic() + timeout
        try:
            with self._grabbing:  # two threads may read one camera
                if self._error is not None:
                    if self._error.final:
                        raise self._error
                    self._reopen()
                while True:
                    rest = deadline - time.monotonic()
                    raw = self._driver.grab(max(0.0, rest))
                    if raw is None or (after is not None and raw.t < after and rest < 0.0):
                        raise StaleStateError(f"camera {self.name} took no frame within {timeout:g} s{describe_load()}")
                    if raw is self._raw and self._newest is not None:
                        frame = self._newest  # nothing has changed since it was rendered
                    else:
                        frame = self._accept_frame(raw)
                        self._notify(self._listeners, frame)
                    if after is None or raw.t >= after or not self._driver.on_demand:
                        self._returned_seq = frame.stamp.seq
                        return frame
        except ConnectionLost as error:
            if error is self._error:
                raise
            raise self._lose(error) from error

    # The camera's own thread.

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                raw = self._driver.grab(_GRAB)
            except Exception as error:
                if self._lose(error).final or not self._retry_until_back():
                    return
                continue
            if raw is not None:
                self._notify(self._listeners, self._accept_frame(raw))

    def _retry_until_back(self) -> bool:
        """Reopen the lost camera until a frame comes. Return False if that is given up, or the camera was closed."""
        since = time.monotonic()
        while (gone := time.monotonic() - since) < GIVE_UP:
            if self._closing.wait(_SOON if gone < _MINUTE else _LATER):
                return False
            try:
                self._reopen()
                raw = None
                while raw is None and not self._closing.is_set():
                    raw = self._driver.grab(_GRAB)  # raises if the device stays silent
            except Exception as error:
                if self._lose(error).final:
                    return False
                continue
            if raw is not None:
                self._notify(self._listeners, self._accept_frame(raw))
                return True
        over = ConnectionLost(f"it did not come back within {GIVE_UP / 60.0:g} minutes and was given up")
        over.final = True
        self._lose(over)
        return False

    def _reopen(self) -> None:
        self._driver.close()
        self._driver.open()
        info = self._driver.info
        with self._news:
            self._info = info
            self._offset = None

    def _lose(self, error: Exception) -> ConnectionLost:
        """Note that the camera is lost, and notify all who wait for it; return the error to raise."""
        newest = self._newest
        seen = "no frame came from it" if newest is None else f"its last frame is of {newest.stamp.t:.3f} s"
        lost = ConnectionLost(f"camera {self.name} is lost ({seen}, now is {self.clock.now():.3f} s): {error}")
        lost.__cause__ = error
        lost.fault = getattr(error, "fault", None)
        lost.final = getattr(error, "final", False)
        lost.code = getattr(error, "code", lost.code)
        with self._news:
            first, self._error = self._error is None, lost
            self._news.notify_all()
        if first:
            _LOG.warning("%s", lost)
            self._notify(self._watchers, lost)
        return lost

    def _accept_frame(self, raw: RawFrame) -> Frame:
        frame = self._make_frame(raw)
        with self._news:
            back, self._error = self._error is not None, None
            self._newest, self._raw = frame, raw
            self._reconnects += back
            self._news.notify_all()
        if back:
            _LOG.warning("camera %s is back", self.name)
            self._notify(self._watchers, None)
        return frame

    def _notify(self, listeners: dict[object, Callable[[Any], None]], argument: Frame | ConnectionLost | None) -> None:
        with self._news:
            present = tuple(listeners.items())
        for token, callback in present:
            try:
                callback(argument)
            except Exception:
                _LOG.exception("camera %s: a callback failed and is called no more", self.name)
                with self._news:
                    listeners.pop(token, None)

    def _make_frame(self, raw: RawFrame) -> Frame:
        images = {stream: getattr(raw, stream) for stream in STREAMS}
        for image in images.values():
            if image is not None:
                image.flags.writeable = False
        newest, info = self._newest, self._info
        if newest is None:
            self._first = raw.t
            self._offset = 0
        elif self._offset is None:
            self._offset = newest.stamp.seq + 1 - raw.seq
        else:
            self._dropped += max(0, raw.seq + self._offset - newest.stamp.seq - 1)
        self._last = raw.t
        self._frames += 1
        self._ages.add(self.clock.now() - raw.t)
        where = raw.T_world_camera
        if where is None and self._place is not None:
            where = self._place(raw.t)
            seen_from = info.streams.get(self.spec.reference)
            if where is not None and seen_from is not None:
                where = where @ seen_from.T_color_stream
        return Frame(
            stamp=Stamp(raw.t, raw.t_device, raw.seq + self._offset),
            K=info.K,
            distortion=info.distortion,
            T_world_camera=where,
            skew=raw.skew,
            **images,
        )

    def close(self) -> None:
        """Stop taking frames and release the device. Idempotent."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
            self._thread = None
        self._driver.close()
        self._driver.close()  # after a loss the driver takes the first call for part of a reconnection

    def __repr__(self) -> str:
        spec = self.spec
        return f"<Camera {self.name}: {spec.width}x{spec.height} at {spec.rate_hz:g} Hz, driver {spec.driver}>"


class CameraCounts(NamedTuple):
    """Figures about a camera since it was opened."""

    frames: int
    dropped: int
    """Frames that the camera took and this program did not get: gaps in their numbers."""
    fps: float | None
    """Mean frame rate, Hz; None before two frames."""
    age_p50: float | None
    """Median age of a frame on arrival, s."""
    repeated: int = 0
    """Sets of images without any new one, which were dropped."""
    mismatched: int = 0
    """Sets whose images did not belong together, which were dropped."""
    reconnects: int = 0
    """Number of times that the camera was lost and came back."""


def find_place(spec: CameraSpec, robots: Mapping[str, Robot]) -> Place | None:
    """Return the pose of the colour sensor's optical frame in the world as a function of time.

    Returns:
        The function, for :class:`Camera`; None if the rig file does not place the camera.
    """
    view = spec.view
    if view is None:
        return None
    here = Pose(view.position, view.orientation)
    if view.robot is None:
        return lambda t: here
    return MovingCamera(robots[view.robot], view, here)


class MovingCamera:
    """Pose of a camera on an arm's link, from the arm's state at the time of the frame.

    Args:
        robot: The arm.
        view: View of the camera, with the link.
        pose: Pose of the colour sensor on that link.
    """

    def __init__(self, robot: Robot, view: ViewSpec, pose: Pose) -> None:
        from .kinematics.arm import Kinematics

        self._robot = robot
        self._link = str(view.link)
        self._pose = pose
        self._kinematics = Kinematics(robot.spec.kinematics)  # not shared: each thread needs its own

    def __call__(self, t: float) -> Pose | None:
        """Return the pose of the colour sensor at time ``t``, s; None if the arm's state then is unknown."""
        try:
            q = self._robot.state_at(t).q
        except HalError:
            return None
        return self._robot.base @ self._kinematics.link_pose(self._link, q) @ self._pose


def frame_from_color(spec: CameraSpec) -> Pose:
    """Return the pose of the frames' optical frame in the colour sensor's, from the figures of the model."""
    sensor = spec.sensors.get(spec.reference)
    return Pose(sensor.position, sensor.orientation) if sensor is not None else Pose()
