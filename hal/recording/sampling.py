"""One row: everything that a rig knew at one time, as plain numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

from ..errors import DeviceNotFound, StaleStateError
from ..types import AXES, BUTTONS, Frame, GripperState, PadState, RobotState, Stamp
from .columns import GRID, PAD, SETPOINT, STATE, TIMES, Column

if TYPE_CHECKING:
    from ..geometry import Pose
    from ..rig import Rig
    from ..robot import Robot

__all__ = ["Moment", "Sampler", "movable"]

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
