"""The samples of a recording: which picture belongs to a row, and the numbers in it.

A :class:`~hal.recording.sample_clock.SampleClock` sets the times of the rows. At each of them
:meth:`RowSampler.read_snapshot` reads what has no history (pads, objects); :meth:`RowSampler.row` adds the states of
the arms at that time, and a :class:`CameraBuffer` for each camera finds its picture.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import CommandError, ConnectionLost, DeviceNotFound, StaleStateError
from ..randomization import list_distractors
from ..types import AXES, BUTTONS, STREAMS, Frame, GripperState, PadState, RobotState, Stamp
from .codecs import depth_unit_for
from .layout import (
    ENVIRONMENT,
    GRID,
    GRIP_FORCE,
    MORE_STREAMS,
    OBJECTS,
    PAD,
    SETPOINT,
    SOURCE,
    SOURCES,
    STATE,
    TAU_EXT,
    TIMES,
    WRENCH_EXT,
    CameraSetup,
    Column,
)

if TYPE_CHECKING:
    from ..camera import Camera
    from ..geometry import Pose
    from ..host.ring import Images
    from ..rig import Rig
    from ..robot import Robot

_KEEP = 0.5
"""Span of pictures that are kept for rows that are made late, s."""
_SILENT = 1.0
"""Age of the newest picture above which a camera counts as lost, s."""
_FIRST_PICTURE = 2.0
"""Longest time that the start of an episode waits for a picture of a late camera, s."""


class CameraBuffer:
    """Keeps the newest pictures of one camera, and finds the one of each row: the newest taken at its time or before.

    In real time the camera's own thread delivers every frame; in lock-step the present is rendered.
    """

    def __init__(self, camera: Camera, *, streams: Collection[str], lock_step: bool) -> None:
        self.camera = camera
        self._lost: tuple[float, ConnectionLost] | None = None
        self.repeated = 0
        """Rows that show the same picture as the row before."""
        self._lock_step = lock_step
        self._lock = threading.Lock()
        self._frames: deque[Frame] = deque(maxlen=max(4, round(_KEEP * camera.spec.rate_hz)))
        self._detach: list[Callable[[], None]] = []
        self._last_seq = -1
        spec, scale = camera.spec, camera.info.depth_scale
        there = [stream for stream in spec.streams if stream in streams]
        keeps = "depth" in there
        self.setup = CameraSetup(
            camera.name,
            spec.width,
            spec.height,
            "color" in there,
            (scale or depth_unit_for(spec.depth_max)) if keeps else None,
            scale is not None,
            -1,
            tuple(stream for stream in MORE_STREAMS if stream in there),
        )

    def start(self) -> None:
        """Start an episode. Waits for a late camera.

        Raises:
            StaleStateError: It has no picture for 2 s.
            ConnectionLost: It does not answer.
        """
        self._lost, self.repeated, self._last_seq = None, 0, -1
        with self._lock:
            self._frames.clear()
        if not self._lock_step:  # before the first picture, so that neither a frame nor a loss is missed
            self._detach = [self.camera.on_frame(self._add_frame), self.camera.on_connection(self._mark_lost)]
        try:
            first = self.camera.read_latest(max_age=_SILENT)
        except StaleStateError:
            first = self.camera.read(timeout=_FIRST_PICTURE, after=self.camera.clock.now() - _SILENT)
        with self._lock:
            if not self._frames or first.stamp.seq < self._frames[0].stamp.seq:
                self._frames.appendleft(first)

    def stop(self) -> None:
        """End an episode. Idempotent."""
        for detach in self._detach:
            detach()
        self._detach = []

    def _add_frame(self, frame: Frame) -> None:
        with self._lock:
            self._frames.append(frame)

    def _mark_lost(self, lost: ConnectionLost | None) -> None:
        if lost is not None and self._lost is None:
            self._lost = self.camera.clock.now(), lost

    def frame(self, t: float) -> Frame:
        """Return the picture of the row that was due at ``t``, s on the rig's clock.

        Raises:
            ConnectionLost: The camera was lost before ``t``.
            StaleStateError: Its newest picture is more than a second older than ``t``.
        """
        if self._lock_step:
            return self.camera.read_latest()
        if self._lost is not None and t > self._lost[0]:
            raise self._lost[1]
        with self._lock:
            known = tuple(self._frames)
        found = next((frame for frame in reversed(known) if frame.stamp.t <= t), known[0])
        if t - found.stamp.t > _SILENT:
            raise StaleStateError(f"camera {self.camera.name} has sent no picture for {t - found.stamp.t:.1f} s")
        return found

    def copy_into(self, frame: Frame, images: Images) -> None:
        """Copy the pictures of ``frame`` into a slot of the queue, unless they are those of the row before.

        Raises:
            ValueError: A picture has another size than the camera's configuration.
        """
        if frame.stamp.seq == self._last_seq:
            self.repeated += 1
            return
        for stream, place in images.items():
            image = getattr(frame, stream)
            if image is None or image.shape != place.shape:
                there = "none" if image is None else image.shape
                raise ValueError(f"camera {self.camera.name} sends pictures of {there}, not {place.shape}")
            np.copyto(place, image)
        self._last_seq = frame.stamp.seq


_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
_WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
_STAMP = ("t", "t_device", "seq")
_UNKNOWN = [math.nan] * 7
_NO_PAD = PadState(Stamp(math.nan, math.nan, 0))
"""State of a pad that the rig has and that is not open."""

_Put = Callable[[str, Iterable[float]], None]


class RowSnapshot(NamedTuple):
    """Values without a history, read at the due time itself: pads and the poses of objects."""

    pads: dict[str, PadState]
    objects: Mapping[str, Pose]
    """Poses in the simulated world, by the object's name; objects that were removed from the world are missing."""
    t_objects: float
    """Time of these poses, s on the rig's clock."""
    source: int
    """Who drives: a place in :data:`~hal.recording.layout.SOURCES`."""


def movable_objects(rig: Rig) -> tuple[str, ...]:
    """Return the names of the simulated objects that can move, or that have a random start pose.

    Without distractors, which are not in every episode: their poses at its start are in its metadata.
    """
    if not rig.has_world or rig.plan.world is None:
        return ()
    bodies = rig.plan.world.bodies
    heavy = {body.name for body in bodies if body.urdf is not None or body.mass > 0.0}
    still = {body.name for body in bodies if body.random is None and (body.fixed or body.name not in heavy)}
    still |= {body.name for body in bodies if body.robot is not None}
    still |= {body.name for body in list_distractors(rig.plan.world)}
    return tuple(name for name in rig.world.bodies if name not in still and name not in rig.robots)


class RowSampler:
    """Makes the rows of a rig; :attr:`columns` describes their numbers, in order.

    With several arms, a column holds the joints of one after the other, and their names begin with the arm's. A dataset
    that is continued gets no forces and no controls of pads that its first episodes do not have, and the same objects.
    """

    def __init__(
        self,
        rig: Rig,
        cameras: Iterable[str],
        known: Mapping[str, Sequence[str]] | None = None,
        objects: bool = False,
    ) -> None:
        self._rig = rig
        self.source: Callable[[], str] = str
        """Returns who drives: one of :data:`~hal.recording.layout.SOURCES`."""
        self._cameras = tuple(cameras)
        self._objects = movable_objects(rig)
        self._pads = tuple(spec.name for spec in rig.plan.pads)
        """Pads of the rig, open or not, so that episodes of a policy have the same columns as those of a teleoperator.
        """
        self._parts: dict[str, tuple[str, list[str]]] = {}
        several = len(rig.robots) > 1
        self._add(GRID, ["t"], "float64")
        states = {robot: robot.state() for robot in rig.robots.values()}
        self._efforts = [robot for robot, state in states.items() if state.tau is not None]
        self._external = any(s.tau_ext is not None for s in states.values()) or TAU_EXT in (known or {})
        for robot in rig.robots.values():
            self._add_robot(robot, f"{robot.name}." if several else "")
        for name in self._pads:
            lead = f"{name}." if len(self._pads) > 1 else ""
            names = [*AXES, *(f"button_{button}" for button in BUTTONS), "connected"]
            self._add(PAD, [lead + part for part in names])
            self._add(f"{TIMES}pad.{name}", _STAMP, "float64")
        for name in self._cameras:
            self._add(f"{TIMES}camera.{name}", _STAMP, "float64")
            self._add(f"rig.camera_pose.{name}", _POSE)
        for name in self._objects:
            self._add(f"rig.object.{name}", _POSE)
            if objects or ENVIRONMENT in (known or {}):
                self._add(ENVIRONMENT, [f"{name}.{part}" for part in _POSE])
        if self._objects:
            self._add(f"{TIMES}objects", ["t"], "float64")
        self._add(SOURCE, ["source"], "int64")
        self._pad_places: list[int] | None = None
        """Place of each of the dataset's numbers of pads, -1 for a control that they no longer have; None for all."""
        self.left_out = self._fit(known) if known is not None else []
        """Columns, and numbers of columns, that the dataset does not have."""
        self.columns = tuple(Column(key, dtype, tuple(names)) for key, (dtype, names) in self._parts.items())
        """Key, type and names of the numbers in a row, in order."""
        self.width = sum(len(column.names) for column in self.columns)
        """Numbers in a row."""

    def _fit(self, known: Mapping[str, Sequence[str]]) -> list[str]:
        """Leave out what the dataset does not have; return the names."""
        left = [key for key in (GRIP_FORCE, TAU_EXT, WRENCH_EXT) if key in self._parts and key not in known]
        for key in left:
            del self._parts[key]
        dtype, names = self._parts.get(PAD, ("", []))
        there = list(known.get(PAD, ()))
        if there != names and set(there) & set(names):
            self._pad_places = [names.index(name) if name in names else -1 for name in there]
            self._parts[PAD] = dtype, there
            left += [f"{PAD}: {name}" for name in names if name not in there]
        return left

    def mark_arms(self, recorded: bool) -> None:
        """Note in each arm whether an episode is recorded."""
        for robot in self._rig.robots.values():
            robot.recorded = recorded

    def place_of(self, key: str) -> int:
        """Return the index of a column's first number in a row."""
        keys = [column.key for column in self.columns]
        return sum(len(column.names) for column in self.columns[: keys.index(key)])

    def _add(self, key: str, names: Iterable[str], dtype: str = "float32") -> None:
        self._parts.setdefault(key, (dtype, []))[1].extend(names)

    def _add_robot(self, robot: Robot, lead: str) -> None:
        joints = [lead + joint for joint in robot.joints]
        finger = [f"{lead}gripper"] if robot.gripper is not None else []
        self._add(STATE, joints + finger)
        self._add("observation.velocity", joints)
        if robot in self._efforts:
            self._add("observation.effort", joints)
        self._add(SETPOINT, joints + finger)
        self._add("rig.setpoint_velocity", joints)
        for key in ("observation.tcp", "rig.tcp_set"):
            self._add(key, [lead + name for name in _POSE])
        self._add("observation.twist", [lead + name for name in _TWIST])
        self._add("rig.status", [lead + name for name in ("status", "trip", "limited")], "int64")
        self._add(f"{TIMES}robot.{robot.name}", _STAMP, "float64")
        if self._external:
            self._add(TAU_EXT, joints)
            self._add(WRENCH_EXT, [lead + name for name in _WRENCH])
        if finger:
            self._add(GRIP_FORCE, finger)
            self._add(f"{TIMES}gripper.{robot.name}", _STAMP, "float64")

    def read_snapshot(self) -> RowSnapshot:
        """Read what has no history, now."""
        driver = SOURCES.index(self.source())
        opened = self._rig.gamepads
        pads = {name: opened[name].state() if name in opened else _NO_PAD for name in self._pads}
        if not self._objects:
            return RowSnapshot(pads, {}, math.nan, driver)
        world = self._rig.world
        try:
            seen = world.poses(self._objects)
        except DeviceNotFound:  # one was taken out of the world
            seen = world.poses()
        return RowSnapshot(pads, seen.poses, seen.t, driver)

    def row(self, t: float, snapshot: RowSnapshot, frames: dict[str, Frame]) -> list[float]:
        """Return the numbers of the row that was due at ``t``, s on the rig's clock.

        Returns:
            :attr:`width` numbers, in the order of :attr:`columns`.

        Raises:
            StaleStateError: The state of an arm at that time is not available.
            ConnectionLost: An arm or a gripper is lost.
        """
        found: dict[str, list[float]] = {key: [] for key in self._parts}

        def put(key: str, values: Iterable[float]) -> None:
            if key in found:
                found[key].extend(values)

        put(GRID, [t])
        for robot in self._rig.robots.values():
            self._put_robot(put, robot, robot.state_at(t))
        for name, pad in snapshot.pads.items():
            pressed = [float(button in pad.buttons) for button in BUTTONS]
            put(PAD, [*(pad.axes.get(axis, 0.0) for axis in AXES), *pressed, float(pad.connected)])
            put(f"{TIMES}pad.{name}", _stamp(pad.stamp))
        for name, frame in frames.items():
            put(f"{TIMES}camera.{name}", _stamp(frame.stamp))
            put(f"rig.camera_pose.{name}", _pose(frame.T_world_camera))
        for name in self._objects:
            pose = _pose(snapshot.objects.get(name))
            put(f"rig.object.{name}", pose)
            put(ENVIRONMENT, pose)
        if self._objects:
            put(f"{TIMES}objects", [snapshot.t_objects])
        put(SOURCE, [snapshot.source])
        if self._pad_places is not None:
            found[PAD] = [0.0 if k < 0 else found[PAD][k] for k in self._pad_places]
        return [value for values in found.values() for value in values]

    def _put_robot(self, put: _Put, robot: Robot, state: RobotState) -> None:
        grips = [] if robot.gripper is None else [_gripper_state(robot, state.stamp.t)]
        put(STATE, [*state.q.tolist(), *(grip.width for grip in grips)])
        put("observation.velocity", state.dq.tolist())
        if robot in self._efforts:
            put("observation.effort", [math.nan] * robot.n if state.tau is None else state.tau.tolist())
        put(SETPOINT, [*state.q_set.tolist(), *(grip.width_target for grip in grips)])
        put("rig.setpoint_velocity", state.dq_set.tolist())
        put("observation.tcp", _pose(state.tcp))
        put("rig.tcp_set", _pose(state.tcp_set))
        put("observation.twist", state.tcp_twist.tolist())
        put("rig.status", [float(state.status), float(state.trip), float(state.limited)])
        put(f"{TIMES}robot.{robot.name}", _stamp(state.stamp))
        put(TAU_EXT, [math.nan] * robot.n if state.tau_ext is None else state.tau_ext.tolist())
        put(WRENCH_EXT, [math.nan] * 6 if state.wrench_ext is None else state.wrench_ext.tolist())
        for grip in grips:
            put(GRIP_FORCE, [grip.force_target])
            put(f"{TIMES}gripper.{robot.name}", _stamp(grip.stamp))


def select_devices(
    rig: Rig,
    cameras: Collection[str] | None,
    streams: Collection[str],
    known: Mapping[str, Sequence[str]] | None = None,
) -> tuple[RowSampler, list[CameraBuffer], list[str]]:
    """Return what is recorded of a rig. Without ``cameras`` all are; ``streams`` may have ``objects``, for their poses.

    That is the sampler of all arms and pads, a buffer per camera, and notes for the operator. ``known`` are the names
    of the numbers in each column of the dataset that is continued. Raises as :class:`~hal.recording.Recorder`.
    """
    there = (*STREAMS, OBJECTS)
    if unknown := [stream for stream in streams if stream not in there]:
        raise CommandError(f"there is no stream {unknown[0]!r}; streams: {', '.join(there)}", code="unknown_stream")
    if not rig.robots:
        raise CommandError("this rig has no arm to record", code="no_arm")
    if OBJECTS in streams and not movable_objects(rig):
        raise CommandError(
            "poses of objects can be recorded where a simulation has movable ones; this rig has none", code="no_objects"
        )
    names = tuple(rig.cameras) if cameras is None else tuple(dict.fromkeys(cameras))
    buffers, notes = list[CameraBuffer](), list[str]()
    for name in names:
        buffer = _make_buffer(rig, name, streams)
        if buffer.setup.videos or buffer.setup.depths:
            buffers.append(buffer)
        notes += _describe_streams(name, rig.cameras[name].spec.streams, streams)
    for files in ([buffer.setup.videos for buffer in buffers], [buffer.setup.depths for buffer in buffers]):
        file_names = [name for each in files for name in each]
        if double := [name for name in file_names if file_names.count(name) > 1]:
            raise CommandError(f"two streams would be called {double[0]}: rename a camera", code="duplicate_name")
    sampler = RowSampler(rig, [buffer.camera.name for buffer in buffers], known, OBJECTS in streams)
    if sampler.left_out:
        notes.append(f"not recorded, for the dataset does not have them: {', '.join(sampler.left_out)}")
    for buffer in buffers:
        seq = sampler.place_of(f"{TIMES}camera.{buffer.camera.name}") + 2
        buffer.setup = buffer.setup._replace(seq=seq)
    return sampler, buffers, notes


def _make_buffer(rig: Rig, name: str, streams: Collection[str]) -> CameraBuffer:
    """Return the buffer of a camera. Raises CommandError if its pictures cannot be a video."""
    buffer = CameraBuffer(rig.cameras[name], streams=streams, lock_step=rig.lock_step)
    setup = buffer.setup
    if setup.videos and (setup.width % 2 or setup.height % 2):
        size = f"{setup.width}x{setup.height}"
        raise CommandError(
            f"the size of a video must be even: change cameras.{name}.output, which is {size}", code="odd_size"
        )
    return buffer


def _describe_streams(camera: str, own: Collection[str], streams: Collection[str]) -> Iterator[str]:
    """Yield which optional streams a camera has that are not recorded, and which it lacks."""
    if left := [stream for stream in own if stream in MORE_STREAMS and stream not in streams]:
        yield f"camera {camera}: {', '.join(left)} not recorded"
    if missing := [stream for stream in streams if stream in MORE_STREAMS and stream not in own]:
        yield f"camera {camera} has no {', '.join(missing)}"


def _gripper_state(robot: Robot, t: float) -> GripperState:
    """Return the gripper's state at ``t``, or its newest one: a slow gripper may not have reported since."""
    assert robot.gripper is not None
    try:
        return robot.gripper.state_at(t)
    except StaleStateError:
        return robot.gripper.state()


def _pose(pose: Pose | None) -> list[float]:
    return _UNKNOWN if pose is None else [*pose.position.tolist(), *pose.orientation.tolist()]


def _stamp(stamp: Stamp) -> list[float]:
    """Return t, t of the device, and the sequence number; times that are not finite become NaN."""
    times = [value if math.isfinite(value) else math.nan for value in (stamp.t, stamp.t_device)]
    return [*times, stamp.seq]
