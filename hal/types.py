"""States of devices: frozen records in SI units, with read-only arrays and quaternions x, y, z, w.

Every driver yields the same records. None means that the driver cannot know a value; unknown values are never filled in
with zeros.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from .errors import CommandError, Fault, NotSupported
from .geometry import Pose

Array = NDArray[np.float64]

STICK_AXES = ("left_x", "left_y", "right_x", "right_y", "l2", "r2", "dpad_x", "dpad_y")
"""Axes of a gamepad with sticks. Right and up are positive."""

CAP_AXES = ("push_x", "push_y", "push_z", "turn_x", "turn_y", "turn_z")
"""Axes of a pad with one cap that moves in all directions (a SpaceMouse): pushed forward, left and up, and
rotated about these directions, right-handed. They match the axes of an arm's base frame for a user who stands behind
it."""

JOINT_AXES = tuple(f"joint_{k}" for k in range(1, 9))
"""Axes that jog one joint of the arm each, in the order of its joints."""

PAGE_AXES = STICK_AXES + JOINT_AXES
"""Axes of the console's page, in the order in which it sends them."""

AXES = STICK_AXES + CAP_AXES + JOINT_AXES
"""All axes that a pad may have. Values are in -1..1, those of :data:`ONE_SIDED` in 0..1. A pad has some of them, and
datasets find theirs by name."""

ONE_SIDED = ("l2", "r2")
"""Axes in 0..1: triggers, levers. One that is a name of :data:`BUTTONS` as well is also a button."""

BUTTONS = ("south", "east", "west", "north", "l1", "r1", "l2", "r2", "select", "start", "l3", "r3", "home", "touchpad")
"""Buttons of a pad, named by position: ``south`` is Cross on a Sony pad and A on an Xbox pad."""


@dataclass(frozen=True, slots=True)
class ImageStream:
    """A kind of images that cameras make: a field of :class:`Frame` and of :class:`hal.driver.RawFrame`."""

    name: str
    dtype: DTypeLike = np.uint8
    shape: tuple[int, ...] = ()
    """Shape of an image after height and width."""
    lowest: float = 0
    highest: float | None = 255
    """Range of the values; None for the camera's range of depth."""
    exact: bool = False
    """Whether a value is a measurement or a name, not a brightness: it is never averaged, and recorded without loss
    instead of in a video. Depth is stored in a unit of length, any other exact stream as 16-bit whole numbers."""
    like: str | None = None
    """Stream of the same sensor, whose values in the camera's model are the defaults of this one's."""
    unaligned: bool = False
    """Whether its images keep their own sensor's view (``CameraInfo.K_infrared``), instead of that of the frame."""
    rendered: bool = False
    """Whether only simulated cameras have it, without options."""


_KINDS = (
    ImageStream("color", shape=(3,)),
    ImageStream("depth", np.float32, highest=None, exact=True),
    ImageStream("infrared", like="depth", unaligned=True),
    ImageStream("infrared_right", like="infrared", unaligned=True),
    ImageStream("segmentation", np.int32, lowest=-1, highest=2**31 - 1, exact=True, rendered=True),
)
STREAMS: Mapping[str, ImageStream] = MappingProxyType({kind.name: kind for kind in _KINDS})
"""Every stream that a camera may have, by its name."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """Time of a measurement."""

    t: float
    """Time on ``rig.clock``, s: the host's monotonic clock, or simulated time in lock-step."""
    t_device: float
    """Time on the device's own clock (the robot's, the sensor's or the simulated world's), s."""
    seq: int
    """Number of the sample; a gap is a lost sample."""


class _Named(IntEnum):
    """An integer enum that prints as its name in lower case."""

    def __str__(self) -> str:
        return self.name.lower()


class RobotStatus(_Named):
    """Status of an arm."""

    IDLE = 0
    """No control session; the device holds by itself."""
    FOLLOWING = 1
    """In a session, and allowed to move."""
    STOPPING = 2
    """Braking, within the limits."""
    HOLDING = 3
    """In a session, at rest: the dead-man is released, or there was no command yet."""
    TRIPPED = 4
    """Braking or at rest after a trip, which is latched (see :class:`Trip`)."""
    FAULT = 5
    """The device reports a fault."""
    LOST = 6
    """The device does not answer."""


class ControlMode(_Named):
    """What makes an arm follow its set-point."""

    POSITION = 0
    """The arm's own position controller."""
    JOINT_IMPEDANCE = 1
    """Torques of :class:`hal.JointImpedance`."""
    OPERATIONAL_SPACE = 2
    """Torques of :class:`hal.OperationalSpace`."""
    TORQUE = 3
    """Nothing: torques of :class:`hal.JointTorque`, or those that brake the arm, drive it, and it has no set-point."""


class Trip(_Named):
    """Reason for which a stop was latched."""

    NONE = 0
    COMMAND_LATE = 1
    """No command came before the deadline of the last one."""
    DEADMAN_SILENT = 2
    """The pad of the dead-man sent nothing within the limit."""
    DEADMAN_LOST = 3
    """The pad of the dead-man was disconnected."""
    STOP = 4
    """``rig.stop()`` was called."""
    APP_SILENT = 5
    """The program does not run: it is stopped, swapped out or in a debugger."""
    FAULT = 6
    """The robot reported a fault."""
    DEVICE_LOST = 7
    """The robot does not answer."""
    BAD_READING = 8
    """The robot reported impossible values."""
    HOST_LATE = 9
    """The process of the servo was stopped, or could not run, for too long."""
    LIMIT = 10
    """In torque mode the arm reached a limit: of speed, of position, of the workspace, of the distance to something, or
    of the time to brake."""

    @property
    def code(self) -> str:
        """Stable identifier, such as ``pad_lost``; the ``MotionStopped`` of this trip has the same ``code``."""
        return _TRIPS[self][0]

    @property
    def text(self) -> str:
        """The reason in words."""
        return _TRIPS[self][1]


_TRIPS = {
    Trip.NONE: ("none", "none"),
    Trip.COMMAND_LATE: ("command_deadline", "the commands stopped coming"),
    Trip.DEADMAN_SILENT: ("pad_silent", "the pad of the dead-man sent nothing"),
    Trip.DEADMAN_LOST: ("pad_lost", "the pad of the dead-man was disconnected"),
    Trip.STOP: ("rig_stop", "rig.stop() was called"),
    Trip.APP_SILENT: ("app_silent", "the program did not run"),
    Trip.FAULT: ("robot_fault", "the robot reported a fault"),
    Trip.DEVICE_LOST: ("device_lost", "the robot does not answer"),
    Trip.BAD_READING: ("bad_reading", "the robot reported impossible values"),
    Trip.HOST_LATE: ("host_late", "the servo's process was stopped, or could not run, for too long"),
    Trip.LIMIT: (
        "torque_limit",
        "in torque mode the arm reached a limit of speed, position or workspace, came too near to something, or did "
        "not come to rest",
    ),
}


class GripperOutcome(_Named):
    """Outcome of a gripper's newest command."""

    NONE = 0
    """No command was sent."""
    RUNNING = 1
    """The fingers are moving."""
    DONE = 2
    """The fingers reached the width or, after a grasp, hold an object of the right width."""
    MISSED = 3
    """The fingers rest at another width, or closed on nothing."""
    STOPPED = 4
    """Ended by ``stop()`` or by a newer command."""
    FAILED = 5
    """Refused by the gripper; its fault has the reason."""


class MotionOutcome(_Named):
    """How a motion of an arm ended."""

    ARRIVED = 1
    """At its end."""
    CANCELLED = 2
    """By ``cancel()``."""
    STOPPED = 3
    """By a trip or a fault, or because the arm was moved away from its path."""


class Limited(IntFlag):
    """Limits by which the servo reduced the motion in this tick."""

    def __str__(self) -> str:
        names = [flag.name or "" for flag in type(self) if flag and flag in self]
        return ", ".join(names).lower().replace("_", " ") or "nothing"

    NONE = 0
    SPEED = 1
    """The motion was slowed to the session's joint speed."""
    TCP_SPEED = 2
    """The motion was slowed to the tcp speed."""
    POSITION = 4
    """A joint limit is near; the motion towards it was slowed or stopped."""
    WORKSPACE = 8
    """The boundary of the workspace is near; the motion towards it was slowed or stopped."""
    LEAD = 16
    """The goal was too far ahead of the arm and was held back; with a controller, the set-point was."""
    SINGULAR = 32
    """The arm is close to a singularity and does not exactly follow the commanded direction."""
    REANCHORED = 64
    """The device did not take the last set-point; the motion continues from the position that it reports."""
    TORQUE = 128
    """The commanded torques, or those of the controller, were cut to the torque limits."""
    COLLISION = 256
    """The arm is near itself, a box or another arm; the motion towards it was slowed or stopped."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotState:
    """State of an arm with ``n`` joints; poses and twists are in its base frame."""

    stamp: Stamp
    q: Array
    """Measured joint positions (n,), rad."""
    dq: Array
    """Measured joint velocities (n,), rad/s."""
    tau: Array | None
    """Measured joint torques (n,), Nm."""
    q_set: Array
    """Joint set-point (n,) that was last written to the device, rad."""
    dq_set: Array
    """Velocity of the set-point (n,), rad/s."""
    tcp: Pose
    """Pose of the tool centre point: forward kinematics of ``q``."""
    tcp_set: Pose
    """Pose of the tool centre point at ``q_set``."""
    tcp_twist: Array
    """Measured linear velocity in m/s, then angular velocity in rad/s, of the tcp (6,), along the axes of the base."""
    tau_ext: Array | None
    """External joint torques (n,), Nm; None if the device does not estimate them."""
    wrench_ext: Array | None
    """External force and torque at the tcp (6,), N and Nm; None if the device does not estimate them."""
    status: RobotStatus
    trip: Trip
    """Reason for the latched stop; ``Trip.NONE`` if no stop is latched."""
    fault: Fault | None
    """The device's fault; None if it reports none."""
    limited: Limited
    """Limits by which the servo reduced the motion in this tick."""
    target_seq: int
    """Number of the command that the set-point follows; 0 before the first."""
    controller: ControlMode = ControlMode.POSITION
    """What makes the arm follow its set-point."""
    tau_set: Array | None = None
    """Joint torques (n,) that were last written to the device, Nm, on top of those that carry the arm's weight; None
    while the arm's own position controller drives it."""


@dataclass(frozen=True, slots=True)
class GripperState:
    """State of a gripper with two fingers."""

    stamp: Stamp
    width: float
    """Distance between the fingers, m."""
    width_target: float
    """Width that the newest command asked of the fingers, m: the least (mostly 0) after a grasp, which presses
    beyond the object.
    """
    force_target: float
    """Force of the newest command, N; the gripper's default before the first."""
    moving: bool
    grasped: bool | None
    """Whether the fingers press on an object; None if unknown."""
    force: float | None
    """Grip force, N; None if unknown."""
    outcome: GripperOutcome
    """Outcome of the newest command."""
    fault: Fault | None
    """Why the newest command failed, or why the gripper does not answer, with the remedy."""
    target_seq: int
    """Number of the newest command that the gripper took; 0 before the first."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One capture of one camera: upright images in OpenCV's axes (x right, y down, z forward). Arrays are read-only."""

    stamp: Stamp
    color: NDArray[np.uint8] | None
    """(H, W, 3) RGB."""
    depth: NDArray[np.float32] | None
    """(H, W) distance along the optical axis, m, aligned to colour; 0 where nothing was measured."""
    infrared: NDArray[np.uint8] | None
    """(H, W) of the left imager, in its own view (``camera.info.K_infrared``); never aligned."""
    segmentation: NDArray[np.int32] | None
    """(H, W) index into ``rig.world.bodies``, -1 for none; simulation only, if the rig enables it."""
    K: Array
    """(3, 3) camera matrix, pixels; the centre of the upper left pixel is (0, 0)."""
    distortion: Array
    """(5,) k1, k2, p1, p2, k3 (OpenCV's order)."""
    T_world_camera: Pose | None
    """Pose of the camera in the world at the time of the frame; None if unknown."""
    infrared_right: NDArray[np.uint8] | None = None
    """(H, W), of the right imager."""
    skew: float | None = None
    """Time of the colour image minus that of the depth image, s; None without both."""

    def points(
        self, mask: NDArray[np.bool_] | None = None, frame: Literal["camera", "world"] | Pose = "camera"
    ) -> NDArray[np.float32]:
        """Return the points (k, 3), m, that the depth image shows, by rows; pixels without depth have none.

        Args:
            mask: (H, W), for example ``frame.segmentation == rig.world.bodies.index("cube")``; None for all pixels.
            frame: ``"camera"`` (x right, y down, z forward), ``"world"``, or the pose in the world of the frame that
                they are given in: ``arm.base`` for an arm's.

        Raises:
            CommandError: The mask has another shape, or there is no such frame.
            NotSupported: There is no depth (``code`` is ``no_depth``), or the camera's pose is unknown
                (``no_camera_pose``).
        """
        points = self.point_image(frame)
        seen = np.asarray(self.depth) > 0.0
        if mask is not None:
            if np.shape(mask) != seen.shape:
                raise CommandError(f"mask must have shape {seen.shape}, not {np.shape(mask)}", code="bad_mask")
            seen &= np.asarray(mask, bool)
        return points[seen]

    def point_image(self, frame: Literal["camera", "world"] | Pose = "camera") -> NDArray[np.float32]:
        """Return the point (H, W, 3), m, that each pixel of the depth image shows; 0 where nothing was measured.

        Takes and raises the same as :meth:`points`.
        """
        from .images import depth_to_points

        if self.depth is None:
            raise NotSupported("this frame has no depth: give the camera a depth stream", code="no_depth")
        points = depth_to_points(self.depth, self.K, self.distortion)
        if isinstance(frame, str) and frame == "camera":
            return points
        if not isinstance(frame, Pose) and frame != "world":
            raise CommandError(f"frame must be 'camera', 'world' or a hal.Pose, not {frame!r}", code="unknown_frame")
        if self.T_world_camera is None:
            raise NotSupported(
                "the camera's pose in the world is unknown: give the camera a mount, or calibrate it",
                code="no_camera_pose",
            )
        pose = self.T_world_camera if frame == "world" else frame.inverse() @ self.T_world_camera
        matrix = pose.matrix().astype(np.float32)
        moved: NDArray[np.float32] = points @ matrix[:3, :3].T + matrix[:3, 3]
        moved[self.depth <= 0.0] = 0.0
        return moved


@dataclass(frozen=True, slots=True)
class PadState:
    """State of a gamepad of any make, with the dead zone applied."""

    stamp: Stamp
    axes: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Axis -> value; names of :data:`AXES`."""
    buttons: frozenset[str] = frozenset()
    """The buttons that are pressed; names of :data:`BUTTONS`."""
    connected: bool = False
    joints: tuple[float, ...] = ()
    """Joint positions of a leader arm (n,), rad; empty for a gamepad, and while it is not connected."""
    pose: tuple[float, ...] = ()
    """Position (m) and orientation (x, y, z, w) of a tracked hand that holds the dead-man, (7,): x is forward, y left,
    z up for the person; the origin is anywhere. Empty without one."""

    def axis(self, name: str) -> float:
        """Return the value of an axis; 0 if this pad does not have it. KeyError for a name not in :data:`AXES`."""
        if name not in AXES:
            raise KeyError(f"{name!r} is no axis; axes: {', '.join(AXES)}")
        return self.axes.get(name, 0.0)

    def pressed(self, name: str) -> bool:
        """Return whether a button is pressed. KeyError for a name not in :data:`BUTTONS`."""
        if name not in BUTTONS:
            raise KeyError(f"{name!r} is no button; buttons: {', '.join(BUTTONS)}")
        return name in self.buttons
