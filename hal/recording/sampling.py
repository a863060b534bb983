"""One row: everything that a rig knew at one time, as plain numbers."""

from __future__ import annotations

import json
import math
import operator
import platform
import sys
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..clock import LockStepClock
from ..errors import CommandError, ConnectionLost, DeviceNotFound, StaleStateError
from ..types import AXES, BUTTONS, Frame, GripperState, PadState, RobotState, Stamp
from .codecs import unit_for
from .layout import GRID, MORE_STREAMS, PAD, SETPOINT, STATE, TIMES, CameraSetup, Column

if TYPE_CHECKING:
    from ..camera import Camera
    from ..clock import Clock
    from ..geometry import Pose
    from ..rig import Rig
    from ..robot import Robot
    from .ring import Images

__all__ = [
    "CameraTrack",
    "Grid",
    "LAG",
    "LockStepGrid",
    "Moment",
    "RealTimeGrid",
    "Sampler",
    "about_call",
    "about_rig",
    "about_start",
    "movable",
]

# [grid.py] When rows are due, and who makes them: a thread in real time, the clock itself in lock-step.

LAG = 0.1
"""s after its time that a row is made in real time: by then the picture that was taken at that time has arrived."""
_LATE = 1.0
"""A row that came later than so many periods counts as late. Nothing is missing in it: states have a history."""

Look = Callable[[], "Moment | Exception"]
"""Looks at what has no history; an error is one more thing that was seen."""
Make = Callable[[float, "Moment | Exception"], bool]
"""Makes the row of a time; False where no more are wanted."""


class Grid(ABC):
    """Calls ``look`` at each grid time, and ``make`` once what belongs to that time is known."""

    def __init__(self, clock: Clock, fps: int, look: Look, make: Make) -> None:
        self._clock = clock
        self._period = 1.0 / fps
        self._look = look
        self._make = make
        self.start_time = clock.now()
        """Of the first row, s on the clock."""
        self.late = 0
        """Grid times that were noticed more than a period late."""

    @abstractmethod
    def start(self) -> None:
        """Begin with a row of the present."""

    @abstractmethod
    def end(self) -> None:
        """No further grid times, and nothing is looked at any more once this returns. Idempotent."""

    @abstractmethod
    def stop(self) -> None:
        """The same; returns when all rows are made."""


class RealTimeGrid(Grid):
    """A thread of its own, which nothing that moves ever waits for."""

    def __init__(self, clock: Clock, fps: int, look: Look, make: Make) -> None:
        super().__init__(clock, fps, look, make)
        self._number = 0
        """Of the next row."""
        self._waiting: deque[tuple[float, Moment | Exception]] = deque()
        self._ending = threading.Event()
        self._looking = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="hal-recorder", daemon=True)

    def start(self) -> None:
        self._notice()  # here and now: whatever comes next, there is a first row
        self._thread.start()

    def end(self) -> None:
        self._ending.set()
        with self._looking:  # a look that is under way is let end
            pass

    def stop(self) -> None:
        self.end()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def _due(self) -> float:
        return self.start_time + self._number * self._period

    def _notice(self) -> None:
        """Look, where a row is due."""
        with self._looking:
            now = self._clock.now()
            if self._ending.is_set() or self._due() > now:
                return
            moment = self._look()
        while self._due() <= now:
            self.late += now - self._due() > _LATE * self._period
            self._waiting.append((self._due(), moment))
            self._number += 1

    def _run(self) -> None:
        waiting = self._waiting
        while True:
            self._notice()
            while waiting and waiting[0][0] + LAG <= self._clock.now():
                if not self._make(*waiting.popleft()):
                    return
            if self._ending.is_set():
                if not waiting:
                    return
                self._clock.sleep_until(waiting[0][0] + LAG)
            else:
                next_row = waiting[0][0] + LAG if waiting else self._due()
                self._ending.wait(max(0.0, min(next_row, self._due()) - self._clock.now()))


class LockStepGrid(Grid):
    """Rows exactly at their times: the clock stops there, whoever waits for however long."""

    def __init__(self, clock: Clock, fps: int, look: Look, make: Make) -> None:
        super().__init__(clock, fps, look, make)
        assert isinstance(clock, LockStepClock)
        self._stepped = clock
        self._wanted = True
        self._taking = threading.RLock()
        """Held while a row is made: another thread may end this meanwhile."""
        self._detach: Callable[[], None] = lambda: None

    def start(self) -> None:
        self._take()
        if self._wanted:
            self._detach = self._stepped.every(self._period, self._take)

    def end(self) -> None:
        self._wanted = False
        self._detach()
        with self._taking:  # a row that is under way is made
            pass

    def stop(self) -> None:
        self.end()

    def _take(self) -> None:
        with self._taking:
            if self._wanted and not self._make(self._clock.now(), self._look()):
                self._wanted = False
                self._detach()


# [cameras.py] The pictures of one camera, kept until the rows that show them are made.

_KEEP = 0.5
"""s of pictures that are kept for rows which are made late."""
_SILENT = 1.0
"""A camera that has sent nothing for so long is as good as lost, s."""


class CameraTrack:
    """Finds the picture of a row: the newest one that was taken at its time or before.

    In real time the camera's own thread brings every frame; in lock-step the present is drawn.
    """

    def __init__(self, camera: Camera, *, streams: Collection[str], lock_step: bool) -> None:
        self.camera = camera
        self._lost: tuple[float, ConnectionLost] | None = None
        self.repeated = 0
        """Rows that show the same picture as the one before."""
        self._lock_step = lock_step
        self._lock = threading.Lock()
        self._frames: deque[Frame] = deque(maxlen=max(4, round(_KEEP * camera.spec.rate_hz)))
        self._detach: list[Callable[[], None]] = []
        self._put = -1
        spec, scale = camera.spec, camera.info.depth_scale
        there = [stream for stream in spec.streams if stream in streams]
        keeps = "depth" in there
        self.setup = CameraSetup(
            camera.name,
            spec.width,
            spec.height,
            "color" in there,
            (scale or unit_for(spec.depth_max)) if keeps else None,
            scale is not None,
            -1,
            tuple(stream for stream in MORE_STREAMS if stream in there),
        )

    def begin(self) -> None:
        """A new episode. StaleStateError, ConnectionLost where the camera has no picture now."""
        self._lost, self.repeated, self._put = None, 0, -1
        with self._lock:
            self._frames.clear()
        if not self._lock_step:  # from here on nothing is missed, also not that it is lost
            self._detach = [self.camera.on_frame(self._keep), self.camera.on_connection(self._hear)]
        first = self.camera.latest(max_age=_SILENT)
        with self._lock:
            if not self._frames or first.stamp.seq < self._frames[0].stamp.seq:
                self._frames.appendleft(first)

    def end(self) -> None:
        """It is over. Idempotent."""
        for detach in self._detach:
            detach()
        self._detach = []

    def _keep(self, frame: Frame) -> None:
        with self._lock:
            self._frames.append(frame)

    def _hear(self, lost: ConnectionLost | None) -> None:
        if lost is not None and self._lost is None:
            self._lost = self.camera.clock.now(), lost

    def frame(self, t: float) -> Frame:
        """The picture of a row that was due at ``t``, s. ConnectionLost, StaleStateError where there is none."""
        if self._lock_step:
            return self.camera.latest()
        if self._lost is not None and t > self._lost[0]:
            raise self._lost[1]
        with self._lock:
            known = tuple(self._frames)
        found = next((frame for frame in reversed(known) if frame.stamp.t <= t), known[0])
        if t - found.stamp.t > _SILENT:
            raise StaleStateError(f"camera {self.camera.name} has sent no picture for {t - found.stamp.t:.1f} s")
        return found

    def fill(self, frame: Frame, images: Images) -> None:
        """Copy what is new into a slot. ValueError for a picture of another size."""
        if frame.stamp.seq == self._put:
            self.repeated += 1
            return
        for stream, place in images.items():
            image = getattr(frame, stream)
            if image is None or image.shape != place.shape:
                there = "none" if image is None else image.shape
                raise ValueError(f"camera {self.camera.name} sends pictures of {there}, not {place.shape}")
            np.copyto(place, image)
        self._put = frame.stamp.seq


_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
_STAMP = ("t", "t_device", "seq")
_UNKNOWN = [math.nan] * 7
_NO_PAD = PadState(Stamp(math.nan, math.nan, 0))
"""One that the rig has, and that is not open."""

Put = Callable[[str, Iterable[float]], None]


class Moment(NamedTuple):
    """What is known only while it is so: asked for at the grid time itself. Of the rest there is a history."""

    pads: dict[str, PadState]
    objects: Mapping[str, Pose]
    """Of the simulated world; without those that were taken out of it."""
    t_objects: float
    """The time that they show, s on the rig's clock."""


def movable(rig: Rig) -> tuple[str, ...]:
    """Objects of the simulated world that can move by themselves, or that episodes begin with elsewhere."""
    if not rig.has_world or rig.plan.world is None:
        return ()
    bodies = rig.plan.world.bodies
    heavy = {body.name for body in bodies if body.urdf is not None or body.mass > 0.0}
    still = {body.name for body in bodies if body.random is None and (body.fixed or body.name not in heavy)}
    still |= {body.name for body in bodies if body.robot is not None}
    return tuple(name for name in rig.world.bodies if name not in still and name not in rig.robots)


class Sampler:
    """Makes rows of a rig; :attr:`columns` say what is in them, in this order.

    A second arm's joints follow the first one's in the same column; the names then begin with the arm's.
    """

    def __init__(self, rig: Rig, cameras: Iterable[str]) -> None:
        self._rig = rig
        self._cameras = tuple(cameras)
        self._objects = movable(rig)
        self._pads = tuple(spec.name for spec in rig.plan.pads)
        """Open or not: what a policy does has the columns of what a person does."""
        self._parts: dict[str, tuple[str, list[str]]] = {}
        several = len(rig.robots) > 1
        self._add(GRID, ["t"], "float64")
        self._efforts = [robot for robot in rig.robots.values() if robot.state().tau is not None]
        for robot in rig.robots.values():
            self._add_robot(robot, f"{robot.name}." if several else "")
        for name in self._pads:
            lead = f"{name}." if len(self._pads) > 1 else ""
            names = [*AXES, *(f"button_{button}" for button in BUTTONS), "connected"]
            self._add(PAD, [lead + part for part in names])
            self._add(f"{TIMES}pad.{name}", _STAMP, "float64")
        for name in self._cameras:
            self._add(f"{TIMES}camera.{name}", _STAMP, "float64")
            self._add(f"observation.camera_pose.{name}", _POSE)
        for name in self._objects:
            self._add(f"observation.object.{name}", _POSE)
        if self._objects:
            self._add(f"{TIMES}objects", ["t"], "float64")
        self.columns = tuple(Column(key, dtype, tuple(names)) for key, (dtype, names) in self._parts.items())
        self.width = sum(len(column.names) for column in self.columns)
        """Numbers in a row."""

    def place_of(self, key: str) -> int:
        """Where a column begins in a row."""
        keys = [column.key for column in self.columns]
        return sum(len(column.names) for column in self.columns[: keys.index(key)])

    def _add(self, key: str, names: Iterable[str], dtype: str = "float32") -> None:
        self._parts.setdefault(key, (dtype, []))[1].extend(names)

    def _add_robot(self, robot: Robot, lead: str) -> None:
        joints = [lead + joint for joint in robot.joints]
        hand = [f"{lead}gripper"] if robot.gripper is not None else []
        self._add(STATE, joints + hand)
        self._add("observation.velocity", joints)
        if robot in self._efforts:
            self._add("observation.effort", joints)
        self._add(SETPOINT, joints + hand)
        self._add("observation.setpoint_velocity", joints)
        for key in ("observation.tcp", "observation.tcp_set"):
            self._add(key, [lead + name for name in _POSE])
        self._add("observation.twist", [lead + name for name in _TWIST])
        self._add("observation.status", [lead + name for name in ("status", "trip", "limited")], "int64")
        self._add(f"{TIMES}robot.{robot.name}", _STAMP, "float64")
        if hand:
            self._add(f"{TIMES}gripper.{robot.name}", _STAMP, "float64")

    # At the time itself, and later.

    def look(self) -> Moment:
        """What has no history, now."""
        opened = self._rig.gamepads
        pads = {name: opened[name].state() if name in opened else _NO_PAD for name in self._pads}
        if not self._objects:
            return Moment(pads, {}, math.nan)
        world = self._rig.world
        try:
            seen = world.poses(self._objects)
        except DeviceNotFound:  # one was taken out of the world
            seen = world.poses()
        return Moment(pads, seen.poses, seen.t)

    def row(self, t: float, moment: Moment, frames: dict[str, Frame]) -> list[float]:
        """The numbers of the row that was due at ``t``; all times in it are on the rig's clock, s.

        StaleStateError where a state of that time is not known, ConnectionLost.
        """
        found: dict[str, list[float]] = {key: [] for key in self._parts}

        def put(key: str, values: Iterable[float]) -> None:
            found[key].extend(values)

        put(GRID, [t])
        for robot in self._rig.robots.values():
            self._put_robot(put, robot, robot.state_at(t))
        for name, pad in moment.pads.items():
            pressed = [float(button in pad.buttons) for button in BUTTONS]
            put(PAD, [*(pad.axes.get(axis, 0.0) for axis in AXES), *pressed, float(pad.connected)])
            put(f"{TIMES}pad.{name}", _stamp(pad.stamp))
        for name, frame in frames.items():
            put(f"{TIMES}camera.{name}", _stamp(frame.stamp))
            put(f"observation.camera_pose.{name}", _pose(frame.T_world_camera))
        for name in self._objects:
            put(f"observation.object.{name}", _pose(moment.objects.get(name)))
        if self._objects:
            put(f"{TIMES}objects", [moment.t_objects])
        return [value for values in found.values() for value in values]

    def _put_robot(self, put: Put, robot: Robot, state: RobotState) -> None:
        hand = [] if robot.gripper is None else [_hand(robot, state.stamp.t)]
        put(STATE, [*state.q.tolist(), *(grip.width for grip in hand)])
        put("observation.velocity", state.dq.tolist())
        if robot in self._efforts:
            put("observation.effort", [math.nan] * robot.n if state.tau is None else state.tau.tolist())
        put(SETPOINT, [*state.q_set.tolist(), *(grip.width_target for grip in hand)])
        put("observation.setpoint_velocity", state.dq_set.tolist())
        put("observation.tcp", _pose(state.tcp))
        put("observation.tcp_set", _pose(state.tcp_set))
        put("observation.twist", state.tcp_twist.tolist())
        put("observation.status", [float(state.status), float(state.trip), float(state.limited)])
        put(f"{TIMES}robot.{robot.name}", _stamp(state.stamp))
        for grip in hand:
            put(f"{TIMES}gripper.{robot.name}", _stamp(grip.stamp))


def _hand(robot: Robot, t: float) -> GripperState:
    """The gripper's state at ``t``, or its newest one: a slow gripper may not have spoken since."""
    assert robot.gripper is not None
    try:
        return robot.gripper.state_at(t)
    except StaleStateError:
        return robot.gripper.state()


def _pose(pose: Pose | None) -> list[float]:
    return _UNKNOWN if pose is None else [*pose.position.tolist(), *pose.orientation.tolist()]


def _stamp(stamp: Stamp) -> list[float]:
    """NaN for what never spoke."""
    times = [value if math.isfinite(value) else math.nan for value in (stamp.t, stamp.t_device)]
    return [*times, stamp.seq]


_PACKAGES = (
    "robot-hal",
    "numpy",
    "ruckig",
    "pin",
    "pybullet",
    "pylibfranka",
    "pyrealsense2",
    "pyarrow",
    "av",
    "zstandard",
)


def about_rig(rig: Rig) -> dict[str, Any]:
    """The rig's configuration, as it was written and as it came out, and the versions of what ran it."""
    plan = rig.plan
    resolved = asdict(plan)
    for pad in resolved["pads"]:
        del pad["models"]  # all pads that are known, not those that are here
    written = None
    if Path(plan.source).is_file():
        written = Path(plan.source).read_text(encoding="utf-8")
    return {
        "rig": {"source": plan.source, "written": written, "resolved": resolved, "renderer": rig.renderer},
        "versions": {"python": platform.python_version(), "system": platform.platform(), **_versions()},
        "program": sys.argv[0],
    }


def _versions() -> dict[str, str]:
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def about_start(rig: Rig, tracks: Iterable[CameraTrack]) -> dict[str, Any]:
    """What is so when an episode begins."""
    objects = {}
    if rig.has_world:
        seen = rig.world.poses().poses
        objects = {name: _pose(pose) for name, pose in seen.items() if name not in rig.robots}
    return {
        "started": datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
        "clock": rig.plan.clock,
        "objects_at_start": objects,
        "cameras": {track.camera.name: _camera(track) for track in tracks},
    }


def _camera(track: CameraTrack) -> dict[str, Any]:
    info, setup = track.camera.info, track.setup
    return {
        "title": info.title,
        "serial": info.serial,
        "firmware": info.firmware,
        "clock": info.clock,
        "K": info.K.tolist(),
        "distortion": info.distortion.tolist(),
        "depth_unit_m": setup.depth_unit,
        "streams": [*setup.videos.values(), *setup.depths.values()],
        "depth_lossless": setup.depth_lossless if setup.depth_unit is not None else None,
    }


def about_call(task: str, seed: int | None, info: Mapping[str, Any] | None) -> dict[str, Any]:
    """What a caller wants to have kept with an episode. CommandError for what the files cannot hold."""
    try:
        task.encode()
    except (AttributeError, UnicodeEncodeError) as error:
        raise CommandError(f"the task must be a text, not {task!r}: {error}") from None
    try:
        number = None if seed is None else operator.index(seed)
    except TypeError:
        raise CommandError(f"the seed must be a whole number, not {seed!r}") from None
    try:
        return {"task": task, "seed": number, "info": json.loads(json.dumps(dict(info or {}), allow_nan=False))}
    except (TypeError, ValueError) as error:
        raise CommandError(f"info must be plain numbers, texts, lists and dicts: {error}") from None
