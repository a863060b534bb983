"""A camera of a rig: the public class."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from numpy.typing import NDArray

from ._moved import names_of
from .driver import CameraDriver, CameraTally, RawFrame
from .errors import ConnectionLost, HalError, StaleStateError
from .geometry import Pose
from .histogram import Histogram
from .specs import CameraSpec, ViewSpec
from .types import Frame, Stamp

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from .clock import Clock
    from .driver import CameraInfo
    from .robot import Robot

__all__ = [
    "Camera",
    "CameraCounts",
    "CameraDriver",
    "CameraTally",
    "Moving",
    "RawFrame",
    "place_of",
]

_LOG = logging.getLogger("hal.camera")
_GRAB = 0.1  # s; how long the camera's thread waits for a frame before it looks whether it is to end
_SOON, _LATER = 0.2, 2.0  # s between two attempts to reach a lost camera, in its first minute and after
_MINUTE = 60.0
GIVE_UP = 1800.0
"""s after which a lost camera is not looked for any more."""

Place = Callable[[float], "Pose | None"]
"""Where the colour sensor is in the world at a time on the rig's clock, s; None where that is not known."""


class CameraCounts(NamedTuple):
    """What a camera has done so far."""

    frames: int
    dropped: int
    """Frames that the camera took and this program never saw: gaps in the numbers."""
    fps: float | None
    """Over the whole run; None before two frames."""
    age_p50: float | None
    """Median age of a frame when it arrived, s."""
    repeated: int = 0
    """Sets of pictures in which nothing was new, and which were not handed out."""
    mismatched: int = 0
    """Sets whose pictures did not belong together, and which were not handed out."""
    reconnects: int = 0
    """How often the camera was lost and came back."""


class Camera:
    """One camera of a rig, the same whatever driver it ends in. Made by :func:`hal.open`.

    In real time a thread of its own takes every frame from the driver, so a slow camera never holds up its reader,
    and ``latest`` never waits. In lock-step both return the present state of the world, which is drawn once.

    A camera that is lost (unplugged, reset, silent) raises ConnectionLost from ``read`` and ``latest``, is looked for
    in the background for half an hour, and then works again, the same object.
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
        """What the driver gave for the newest frame."""
        self._handed_out = -1
        self._error: ConnectionLost | None = None
        self._closing = threading.Event()
        self._grabbing = threading.RLock()
        self._thread: threading.Thread | None = None
        self._listeners: dict[object, Callable[[Frame], None]] = {}
        self._watchers: dict[object, Callable[[ConnectionLost | None], None]] = {}
        self._ages = Histogram(5e-4, 2000)
        self._first = self._last = 0.0
        self._frames = self._dropped = self._reconnects = 0
        self._offset: int | None = 0
        """Added to the driver's numbers, which start anew when it is opened again; None until its first one."""
        self._info: CameraInfo = driver.info

    def open(self) -> None:
        """Connect and start to take frames; :func:`hal.open` does it."""
        self._driver.open()
        self._info = self._driver.info
        if self._threaded:
            self._thread = threading.Thread(target=self._run, name=f"hal-camera-{self.name}", daemon=True)
            self._thread.start()

    @property
    def info(self) -> CameraInfo:
        """Serial number, calibration of every stream, link, options: read when the camera was opened."""
        return self._info

    @property
    def K(self) -> NDArray[np.float64]:
        """Camera matrix (3, 3) of colour and depth as they are handed out, pixels."""
        return self._info.K

    @property
    def connected(self) -> bool:
        """False from the moment that the camera is lost until its next frame."""
        return self._error is None

    def read(self, timeout: float = 1.0, after: float | None = None) -> Frame:
        """The next frame that was not handed out yet; with ``after``, the first one taken at that time or later.

        In real time a frame shows what was some ms ago: after a motion, ``read(after=rig.clock.now())`` shows its end.

        Raises StaleStateError when none came within ``timeout`` s, ConnectionLost when the camera is gone.
        """
        if not self._threaded:
            return self._grab(timeout, after)
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
            return self._grab(1.0)
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

    def on_connection(self, callback: Callable[[ConnectionLost | None], None]) -> Callable[[], None]:
        """Call ``callback`` when the camera is lost, with the error, and when it is back, with None.

        From the camera's own thread. An exception in it ends it, and is logged. What comes back ends it, too.
        """
        token = object()
        with self._news:
            self._watchers[token] = callback

        def detach() -> None:
            with self._news:
                self._watchers.pop(token, None)

        return detach

    def inject(self, **knobs: object) -> None:
        """Switch faults on or off, for tests: what there is, the driver says. Raises NotSupported, CommandError."""
        self._driver.inject(**knobs)

    def counts(self) -> CameraCounts:
        """Frames, gaps, rate and age so far."""
        with self._news:
            span = self._last - self._first
            fps = (self._frames - 1) / span if self._frames > 1 and span > 0.0 else None
            tally = self._driver.tally
            return CameraCounts(
                self._frames, self._dropped, fps, self._ages.percentile(0.5), *tally, reconnects=self._reconnects
            )

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

    # Where nothing takes frames ahead: lock-step, and recordings that are not paced.

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
                        raise StaleStateError(f"camera {self.name} took no frame within {timeout:g} s")
                    if raw is self._raw and self._newest is not None:
                        frame = self._newest  # nothing has changed since it was drawn
                    else:
                        frame = self._take(raw)
                        self._call(self._listeners, frame)
                    if after is None or raw.t >= after or not self._driver.on_demand:
                        self._handed_out = frame.stamp.seq
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
                if self._lose(error).final or not self._look_for_it():
                    return
                continue
            if raw is not None:
                self._call(self._listeners, self._take(raw))

    def _look_for_it(self) -> bool:
        """Open the lost camera again, and see a frame of it. False where that is given up, or the camera is closed."""
        since = time.monotonic()
        while (gone := time.monotonic() - since) < GIVE_UP:
            if self._closing.wait(_SOON if gone < _MINUTE else _LATER):
                return False
            try:
                self._reopen()
                raw = None
                while raw is None and not self._closing.is_set():
                    raw = self._driver.grab(_GRAB)  # a driver whose device stays silent says so in time
            except Exception as error:
                if self._lose(error).final:
                    return False
                continue
            if raw is not None:
                self._call(self._listeners, self._take(raw))
                return True
        over = ConnectionLost(f"it did not come back within {GIVE_UP / 60.0:g} minutes, and is looked for no more")
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
        """Note that the camera is gone, tell whoever waits for it; the error to raise comes back."""
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
            self._call(self._watchers, lost)
        return lost

    def _take(self, raw: RawFrame) -> Frame:
        frame = self._frame(raw)
        with self._news:
            back, self._error = self._error is not None, None
            self._newest, self._raw = frame, raw
            self._reconnects += back
            self._news.notify_all()
        if back:
            _LOG.warning("camera %s is back", self.name)
            self._call(self._watchers, None)
        return frame

    def _call(self, listeners: dict[object, Callable[[Any], None]], news: Frame | ConnectionLost | None) -> None:
        with self._news:
            present = tuple(listeners.items())
        for token, callback in present:
            try:
                callback(news)
            except Exception:
                _LOG.exception("camera %s: what was called with its news failed, and is called no more", self.name)
                with self._news:
                    listeners.pop(token, None)

    def _frame(self, raw: RawFrame) -> Frame:
        for image in (raw.color, raw.depth, raw.infrared, raw.infrared_right, raw.segmentation):
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
            color=raw.color,
            depth=raw.depth,
            infrared=raw.infrared,
            segmentation=raw.segmentation,
            K=info.K,
            distortion=info.distortion,
            T_world_camera=where,
            infrared_right=raw.infrared_right,
            skew=raw.skew,
        )

    def close(self) -> None:
        """Stop taking frames. Idempotent."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
            self._thread = None
        self._driver.close()
        self._driver.close()  # the first one may be the end of a loss, after which a driver expects to be opened again

    def __repr__(self) -> str:
        spec = self.spec
        return f"<Camera {self.name}: {spec.width}x{spec.height} at {spec.rate_hz:g} Hz, driver {spec.driver}>"


# [camera_place.py] Where a camera is that cannot know it itself: by the rig's file, and on an arm by that arm's
# state.


def place_of(spec: CameraSpec, robots: Mapping[str, Robot]) -> Place | None:
    """Pose in the world of the colour sensor's optical frame; None where the rig does not say where the camera is."""
    view = spec.view
    if view is None:
        return None
    here = Pose(view.position, view.orientation)
    if view.robot is None:
        return lambda t: here
    return Moving(robots[view.robot], view, here)


def handed_out(spec: CameraSpec) -> Pose:
    """Pose of the optical frame that the frames have, in that of the colour sensor, by the model's figures."""
    sensor = spec.sensors.get(spec.reference)
    return Pose(sensor.position, sensor.orientation) if sensor is not None else Pose()


class Moving:
    """A camera on an arm's link: by the arm's state at the time of the picture."""

    def __init__(self, robot: Robot, view: ViewSpec, pose: Pose) -> None:
        from .kinematics.arm import Kinematics

        self._robot = robot
        self._link = str(view.link)
        self._pose = pose
        self._kinematics = Kinematics(robot.spec.kinematics)  # its own: one for each thread

    def __call__(self, t: float) -> Pose | None:
        try:
            q = self._robot.state_at(t).q
        except HalError:
            return None
        return self._robot.base @ self._kinematics.link_pose(self._link, q) @ self._pose


__getattr__ = names_of(__name__)
