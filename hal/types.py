"""What devices report: frozen records in SI units, read-only arrays, quaternions xyzw.

The same records come from every driver. ``None`` means that the driver cannot know a value; nothing is ever
filled in with zeros.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import Fault
from .geometry import Pose

__all__ = [
    "AXES",
    "BUTTONS",
    "CAP_AXES",
    "Fault",
    "Frame",
    "GripperOutcome",
    "GripperState",
    "Limited",
    "PadState",
    "Pose",
    "RobotState",
    "RobotStatus",
    "STICK_AXES",
    "Stamp",
    "Trip",
]

Array = NDArray[np.float64]

STICK_AXES = ("left_x", "left_y", "right_x", "right_y", "l2", "r2", "dpad_x", "dpad_y")
"""Names of a gamepad's axes. Sticks and d-pad in -1..1, right and up positive; triggers in 0..1."""

CAP_AXES = ("push_x", "push_y", "push_z", "turn_x", "turn_y", "turn_z")
"""Names of the axes of a pad whose one cap moves in every direction (a SpaceMouse), -1..1: pushed forwards, to the
left and up, and turned about these, right-handed. So they are those of an arm's base frame for whoever stands behind
it."""

AXES = STICK_AXES + CAP_AXES
"""Names of all axes that a pad may have."""

BUTTONS = ("south", "east", "west", "north", "l1", "r1", "l2", "r2", "select", "start", "l3", "r3", "home", "touchpad")
"""Names of a pad's buttons, by place rather than by print: ``south`` is Cross on a Sony pad and A on an Xbox pad."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """When something was measured."""

    t: float
    """Seconds on ``rig.clock``: the host's monotonic clock, or simulated time in lock-step."""
    t_device: float
    """Seconds on the device's own clock (the robot's, the sensor's or the simulated world's)."""
    seq: int
    """Counts samples; a gap is a sample that was lost."""


class _Named(IntEnum):
    """A number on the wire, a name for people."""

    def __str__(self) -> str:
        return self.name.lower()


class RobotStatus(_Named):
    """What the arm is doing."""

    IDLE = 0
    """No control session; the device holds by itself."""
    FOLLOWING = 1
    """A session is open and motion is allowed."""
    STOPPING = 2
    """Braking, within the limits."""
    HOLDING = 3
    """A session is open, the arm is at rest: the dead-man is released, or nothing was commanded yet."""
    TRIPPED = 4
    """At rest or braking after a trip; latched (see :class:`Trip`)."""
    FAULT = 5
    """The device reports a fault."""
    LOST = 6
    """The device does not answer."""


class Trip(_Named):
    """Why a stop was latched."""

    NONE = 0
    COMMAND_LATE = 1
    """No command came before the deadline of the last one."""
    DEADMAN_SILENT = 2
    """The dead-man's pad gave no sign of life within the limit."""
    DEADMAN_LOST = 3
    """The dead-man's pad was disconnected."""
    STOP = 4
    """``rig.stop()`` was called."""
    APP_SILENT = 5
    """The app's process does not answer: stopped, swapped out or in a debugger."""
    FAULT = 6
    """The robot reported a fault."""
    DEVICE_LOST = 7
    """The robot does not answer."""
    BAD_READING = 8
    """The robot reported numbers that cannot be."""
    HOST_LATE = 9
    """The servo's own process was stopped, or could not run, for too long."""
    LIMIT = 10
    """Driven by torques, the arm came to a limit: of speed, of position, of the workspace, or of the time to brake."""

    @property
    def code(self) -> str:
        """Stable identifier of the reason, which the ``MotionStopped`` of this trip carries, such as ``pad_lost``."""
        return _TRIP_CODES[self]


_TRIP_CODES = {
    Trip.NONE: "none",
    Trip.COMMAND_LATE: "command_deadline",
    Trip.DEADMAN_SILENT: "pad_silent",
    Trip.DEADMAN_LOST: "pad_lost",
    Trip.STOP: "rig_stop",
    Trip.APP_SILENT: "app_silent",
    Trip.FAULT: "robot_fault",
    Trip.DEVICE_LOST: "device_lost",
    Trip.BAD_READING: "bad_reading",
    Trip.HOST_LATE: "host_late",
    Trip.LIMIT: "torque_limit",
}


class GripperOutcome(_Named):
    """How a gripper's newest command went."""

    NONE = 0
    """There was none."""
    RUNNING = 1
    """The fingers are on their way."""
    DONE = 2
    """They are where they should be, or, after a grasp, hold something of the right width."""
    MISSED = 3
    """They rest somewhere else, or closed on nothing."""
    STOPPED = 4
    """``stop()`` or a newer command ended it."""
    FAILED = 5
    """The gripper refused it; its fault says why."""


class Limited(IntFlag):
    """What the servo held back in this tick."""

    def __str__(self) -> str:
        names = [flag.name or "" for flag in type(self) if flag and flag in self]
        return ", ".join(names).lower().replace("_", " ") or "nothing"

    NONE = 0
    SPEED = 1
    """The commanded motion was slowed to the session's joint speed."""
    TCP_SPEED = 2
    """The commanded motion was slowed to the tcp speed."""
    POSITION = 4
    """A joint limit is near; the motion towards it was slowed or stopped."""
    WORKSPACE = 8
    """The workspace's boundary is near; the motion towards it was slowed or stopped."""
    LEAD = 16
    """The goal ran ahead of the arm and was held back."""
    SINGULAR = 32
    """The arm is close to a singularity and does not follow the commanded direction exactly."""
    REANCHORED = 64
    """The device had not taken the last set-point; the motion goes on from where it says it is."""
    TORQUE = 128
    """The commanded torques were cut to the torque limits."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotState:
    """An arm, in its own base frame. ``n`` is the number of joints."""

    stamp: Stamp
    q: Array
    """Measured joint positions (n,), rad."""
    dq: Array
    """Measured joint velocities (n,), rad/s."""
    tau: Array | None
    """Measured joint torques (n,), Nm."""
    q_set: Array
    """Joint set-point (n,), rad: what was last written to the device."""
    dq_set: Array
    """Velocity of the set-point (n,), rad/s."""
    tcp: Pose
    """Tool centre point: forward kinematics of ``q``."""
    tcp_set: Pose
    """Tool centre point of ``q_set``."""
    tcp_twist: Array
    """Measured (6,) linear velocity in m/s and angular velocity in rad/s of the tcp, along the base's axes."""
    tau_ext: Array | None
    """External joint torques (n,), Nm, where the device estimates them."""
    wrench_ext: Array | None
    """External force and torque (6,), N and Nm, at the tcp, where the device estimates them."""
    status: RobotStatus
    trip: Trip
    """Why a stop is latched; ``Trip.NONE`` when none is."""
    fault: Fault | None
    limited: Limited
    """What the servo held back in this tick, and why."""
    target_seq: int
    """Number of the command that the set-point follows; 0 before the first one."""


@dataclass(frozen=True, slots=True)
class GripperState:
    """A parallel gripper."""

    stamp: Stamp
    width: float
    """Distance between the fingers, m."""
    width_target: float
    """Width of the newest command, m."""
    moving: bool
    grasped: bool | None
    """True while the fingers press on something short of the target; None where the driver cannot know."""
    force: float | None
    """Grip force, N, where the driver knows it."""
    outcome: GripperOutcome
    """How the newest command went."""
    fault: Fault | None
    """Why it failed, or why the gripper does not answer, with what to do about it."""
    target_seq: int
    """Number of the newest command that the gripper took; 0 before the first one."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One capture of one camera, upright, in OpenCV's axes (x right, y down, z forward). Arrays are read-only."""

    stamp: Stamp
    color: NDArray[np.uint8] | None
    """(H, W, 3) RGB."""
    depth: NDArray[np.float32] | None
    """(H, W) metres along the optical axis, aligned to colour; 0 where there is no measurement."""
    infrared: NDArray[np.uint8] | None
    """(H, W), of the left imager where there are two; in its own view (``camera.info.K_infrared``), never aligned."""
    segmentation: NDArray[np.int32] | None
    """(H, W) number of the body in ``rig.world.bodies``, -1 for none; simulation only, on request."""
    K: Array
    """(3, 3) camera matrix, pixels; the centre of the upper left pixel is (0, 0)."""
    distortion: Array
    """(5,) k1, k2, p1, p2, k3 (OpenCV's order)."""
    T_world_camera: Pose | None
    """Pose of the camera in the world when the frame was taken, where it is known."""
    infrared_right: NDArray[np.uint8] | None = None
    """(H, W), of the right imager."""
    skew: float | None = None
    """By how much colour was taken later than depth, s; None without both."""


@dataclass(frozen=True, slots=True)
class PadState:
    """A gamepad, whatever its make; dead zone applied."""

    stamp: Stamp
    axes: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Values of :data:`AXES`."""
    buttons: frozenset[str] = frozenset()
    """Names (of :data:`BUTTONS`) that are pressed."""
    connected: bool = False

    def axis(self, name: str) -> float:
        """Value of an axis; 0 when the pad has no such axis. KeyError for a name that no pad has."""
        if name not in AXES:
            raise KeyError(f"{name!r} is no axis; axes: {', '.join(AXES)}")
        return self.axes.get(name, 0.0)

    def pressed(self, name: str) -> bool:
        """Is the button pressed? KeyError for a name that no pad has."""
        if name not in BUTTONS:
            raise KeyError(f"{name!r} is no button; buttons: {', '.join(BUTTONS)}")
        return name in self.buttons


def as_dict(record: Any) -> dict[str, Any]:
    """A record as plain lists and numbers, ready for JSON."""
    from dataclasses import fields, is_dataclass

    def plain(value: Any) -> Any:
        if is_dataclass(value) and not isinstance(value, type):
            return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
        if isinstance(value, np.ndarray):
            return value.tolist()
        if isinstance(value, IntFlag):
            return str(value)
        if isinstance(value, IntEnum):
            return value.name
        if isinstance(value, Mapping):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, (frozenset, set)):
            return sorted(value)
        return value

    return {f.name: plain(getattr(record, f.name)) for f in fields(record)}
