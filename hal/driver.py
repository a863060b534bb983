"""TODO: docstring."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import Fault, NotSupported
from .geometry import Pose, frozen
from .specs import CameraSpec
from .types import GripperOutcome

if TYPE_CHECKING:
    from .specs import GripperSpec, PadSpec, RobotSpec

__all__ = [
    "CameraDriver",
    "CameraInfo",
    "CameraTally",
    "GamepadDriver",
    "GripperDriver",
    "GripperReading",
    "PadReading",
    "Plugged",
    "RawFrame",
    "Reading",
    "RobotDriver",
    "Setpoint",
    "StreamInfo",
    "nominal_info",
]

# [camera_info.py] What a camera is, and how it sees: read once when it is opened.

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class StreamInfo:
    """One stream as the sensor takes it: before alignment, crop and scaling."""

    format: str | None
    """Of the device (``bgr8``, ``z16``, ...); None where it has none."""
    width: int
    height: int
    rate_hz: float
    K: Array
    """(3, 3) camera matrix, pixels; the centre of the upper left pixel is (0, 0)."""
    distortion: Array
    """(5,) k1, k2, p1, p2, k3 (OpenCV's order)."""
    T_color_stream: Pose
    """Pose of this sensor's optical frame in that of the colour sensor; no turn and no shift for colour itself."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfo:
    """A camera that is open. A real one reports its own calibration, a simulated one the model's figures."""

    title: str
    """Make and model, for people."""
    K: Array
    """(3, 3) of colour and depth as they are handed out: aligned, cropped and scaled."""
    distortion: Array
    """(5,) of the same, OpenCV's order."""
    K_infrared: Array | None
    """(3, 3) of both infrared pictures as they are handed out; they are never aligned. None without infrared."""
    clock: str
    """What ``Stamp.t_device`` counts: ``hardware`` (the sensor's own clock), ``global`` (that clock, brought by its
    library to the host's time of day), ``system`` (the host's time of day at arrival), ``simulated``."""
    serial: str | None = None
    firmware: str | None = None
    usb: str | None = None
    """The link that was found, for example ``3.2``; ``2.1`` means fewer modes and is worth another cable."""
    depth_scale: float | None = None
    """Metres in one unit of the raw depth picture."""
    streams: Mapping[str, StreamInfo] = field(default_factory=lambda: MappingProxyType({}))
    """Those that are on, by the names of the rig's file."""
    options: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """What the device could be told, with its present values."""


def nominal_info(spec: CameraSpec, clock: str, title: str = "") -> CameraInfo:
    """What a camera that knows no better says of itself: the figures of its spec."""
    streams = {
        name: StreamInfo(
            format=stream.format,
            width=stream.width,
            height=stream.height,
            rate_hz=stream.rate_hz,
            K=frozen(stream.K),
            distortion=frozen(spec.distortion),
            T_color_stream=Pose(stream.position, stream.orientation),
        )
        for name, stream in spec.sensors.items()
    }
    infrared = spec.K_infrared or (spec.K if {"infrared", "infrared_right"} & set(spec.streams) else None)
    return CameraInfo(
        title=title or spec.model,
        K=frozen(spec.K),
        distortion=frozen(spec.distortion),
        K_infrared=frozen(infrared) if infrared is not None else None,
        clock=clock,
        streams=MappingProxyType(streams),
    )


# [camera_driver.py] What a camera's driver is: the abstract class, and the records that it hands over.


class RawFrame(NamedTuple):
    """One capture as a driver hands it over: already at the output's size, colour as RGB, depth in metres."""

    t: float
    """When it was taken, on the host's clock, s: for a simulated frame, the time of the world that it shows."""
    t_device: float
    seq: int
    """Counts captures, from any number on; a gap is a capture that was lost. May start anew after ``open``."""
    color: NDArray[np.uint8] | None
    depth: NDArray[np.float32] | None
    infrared: NDArray[np.uint8] | None
    segmentation: NDArray[np.int32] | None
    T_world_camera: Pose | None
    """None where the driver does not know it; the rig then works it out from its file and the arm's state."""
    infrared_right: NDArray[np.uint8] | None = None
    skew: float | None = None
    """By how much colour was taken later than depth, s."""


class CameraTally(NamedTuple):
    """What a driver kept back since it was made."""

    repeated: int = 0
    """Sets of pictures in which nothing was new."""
    mismatched: int = 0
    """Sets whose pictures do not belong together."""


class CameraDriver(ABC):
    """One camera. The calls come from one thread, which may be another one than that of ``open``.

    When ``grab`` raises ConnectionLost, the public :class:`~hal.camera.Camera` calls ``close`` and then ``open`` again,
    in the background and at bounded intervals, until it works: a driver needs no way back of its own.
    """

    simulated: ClassVar[bool] = False
    on_demand: bool = False
    """True where no capture is missed however late it is asked for (a recording that is not paced): every ``read`` of
    the camera is then a ``grab``, and no thread takes frames ahead of it."""
    tally: CameraTally = CameraTally()

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        self.spec = spec
        self.source = source
        """Where a simulated camera gets its pictures from; the rig's clock where nothing draws for it."""

    @classmethod
    def plugged(cls) -> tuple[str, ...]:
        """What could be opened at the moment, in words, each with what tells it apart. Opens nothing."""
        return ()

    @property
    def info(self) -> CameraInfo:
        """What the camera is; asked for after every ``open``, because another one may have been plugged in."""
        return nominal_info(self.spec, "simulated" if self.simulated else "hardware")

    @abstractmethod
    def open(self) -> None:
        """Connect and start streaming. Raises DeviceNotFound (lists what is there), ConnectionLost, NotSupported.

        Bounded: what cannot be had within some seconds is an error.
        """

    @abstractmethod
    def grab(self, timeout: float) -> RawFrame | None:
        """The newest frame that was not handed out yet; waits up to ``timeout`` s, then None.

        In lock-step, a simulated camera returns the same frame again while nothing in the world has changed.

        Raises :class:`~hal.errors.ConnectionLost` when the device is gone, or so silent that it must be opened anew.
        """

    def inject(self, **knobs: object) -> None:
        """Switch faults on or off, for tests. Only drivers that simulate have any."""
        raise NotSupported(f"driver {type(self).__name__} has no faults to inject")

    @abstractmethod
    def close(self) -> None:
        """Stop streaming, let go of the device. Idempotent, and bounded in time whatever the device does.

        A second call without ``open`` in between means that the camera is closed for good.
        """


Floats = Sequence[float]


class Reading(NamedTuple):
    """What a robot driver reports once per cycle. Plain floats: this is the hot path."""

    t: float
    """When it was measured, on the host's clock, s."""
    t_device: float
    """The same on the device's own clock, s."""
    seq: int
    """Counts the device's samples; gaps are lost samples."""
    q: Floats
    """Joint positions, rad."""
    dq: Floats
    """Joint velocities, rad/s."""
    tau: Floats | None = None
    """Joint torques, Nm."""
    q_commanded: Floats | None = None
    """The set-point that the device says it took last, rad: how the servo notices that one was lost. None where the
    device cannot say."""
    dq_commanded: Floats | None = None
    tau_ext: Floats | None = None
    wrench_ext: Floats | None = None
    fault: Fault | None = None
    """A fault stops and latches the arm."""
    tau_commanded: Floats | None = None
    """In torque mode: the torques that the device says it took last, Nm; none at all before it has changed its mode.
    The servo goes on from these, as it does from ``q_commanded``."""


class Setpoint(NamedTuple):
    """What the servo writes to a driver once per cycle; every value lies inside the limits, continuously.

    A driver may keep the numbers, and report them as ``q_commanded``, but must not change them.
    """

    q: Floats
    """rad"""
    dq: Floats
    """rad/s"""
    ddq: Floats
    """rad/s2"""
    tau: Floats | None = None
    """Nm, in torque mode only: what to apply on top of what carries the arm's own weight. ``q`` and ``dq`` are then
    what was measured."""
    q_from: Floats | None = None
    """Where the device is now, by what the servo knows: the set-point before this one, rad. Only in position mode."""


class RobotDriver(ABC):
    """One arm. It only talks to its device: limits, smoothing, time-outs and stopping stand above it.

    Made by the registry with the arm's :class:`~hal.specs.RobotSpec` and, for a simulated arm, the world it stands
    in. The calls come from one thread. ``open`` connects and reads; it never moves anything. ``close`` is idempotent
    and stops safely first. A device that does not answer raises :class:`~hal.errors.ConnectionLost`.
    """

    modes: ClassVar[frozenset[str]] = frozenset({"position"})
    """Kinds of set-point the device takes: ``position``, ``velocity``, ``torque``."""
    paces_itself: ClassVar[bool] = False
    """True where the device sets the pace: :meth:`wait` blocks until its next cycle (a Franka's state packets)."""
    simulated: ClassVar[bool] = False
    """True where nothing real can move."""
    repeats: ClassVar[bool] = False
    """What the device does when a set-point is lost: True where it repeats the last one, False where it extrapolates at
    constant acceleration (a Franka), or where none can be lost. Only what was extrapolated differs from a late
    report, and is corrected."""

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        self.spec = spec
        self.world = world

    @abstractmethod
    def open(self) -> None:
        """Connect. Nothing moves."""

    def wait(self) -> None:
        """Block until the device's next cycle, for a bounded time. Only of drivers that pace themselves.

        Raises nothing: what went wrong is for :meth:`read` to say.
        """
        raise NotSupported(f"driver {type(self).__name__} does not pace itself")

    @abstractmethod
    def read(self, now: float) -> Reading:
        """The newest state; ``now`` is the host's clock, for devices without one. Does not block."""

    @abstractmethod
    def write(self, setpoint: Setpoint) -> bool | None:
        """Hand over the next set-point.

        Returns:
            False when it was not passed on to the device, for example because a motion has to be started first. The
            servo then starts from where the next reading says that the device is. Anything else means that it was.
        """

    @abstractmethod
    def halt(self) -> None:
        """End streaming: the device stops and holds by its own means. Idempotent."""

    def recover(self) -> None:  # noqa: B027  # most have nothing to do
        """Clear a fault, as the user's own act. A driver without faults has nothing to do."""

    @property
    def wants_loop(self) -> bool:
        """Does the device's library want to own the loop from now on (see :meth:`loop`)?"""
        return False

    def loop(self, turn: Callable[[], None]) -> None:
        """Let the library call ``turn`` (one whole cycle of the group) until the motion is over.

        For libraries that stream set-points only out of a callback of their own: inside a turn, ``wait`` does not
        block, ``read`` gives the state that the callback was called with and ``write`` keeps what it is to return.
        """
        raise NotSupported(f"driver {type(self).__name__} does not own a loop")

    def mass_matrix(self, q: Floats) -> Any:
        """Joint-space inertia (n, n), kg m2, at joint positions ``q``, rad: numbers in rows, or an array.

        Of drivers that take torques: the servo brakes by it, and bounds what it lets through. Three times too much or
        too little is still good enough; that of a URDF whose inertias are invented is not.
        """
        raise NotSupported(f"driver {type(self).__name__} does not know the arm's inertia")

    def own_tcp(self) -> Floats | None:
        """Where the device itself says that its tcp was in the last reading: 4x4 by columns, in the base frame, m.

        None where it does not know. It is compared with ours when the arm is opened, and a mismatch is refused.
        """
        return None

    def statistics(self) -> dict[str, Any]:
        """What the driver knows of its connection, as plain numbers and texts, for reports."""
        return {}

    def reset_statistics(self) -> None:  # noqa: B027
        """Count from zero."""

    def inject(self, **knobs: object) -> None:
        """Switch faults on or off, for tests. Only drivers that simulate have any."""
        raise NotSupported(f"driver {type(self).__name__} has no faults to inject")

    @abstractmethod
    def close(self) -> None:
        """Stop safely and let go of the device. Idempotent."""


class GripperReading(NamedTuple):
    """What a gripper driver reports."""

    t: float
    t_device: float
    seq: int
    width: float
    """Distance between the fingers, m."""
    width_target: float
    """Width of the newest command, m."""
    moving: bool
    grasped: bool | None = None
    force: float | None = None
    outcome: GripperOutcome | None = None
    """How the newest command goes, from the return of its call on; None where the driver cannot know, and it is judged
    by ``moving`` and the width."""
    fault: Fault | None = None
    """Why the last command failed, with what to do about it."""


class GripperDriver(ABC):
    """One gripper. ``move``, ``grasp`` and ``home`` start a motion and return at once: a gripper never blocks the arm.

    The newest command wins; one motion is in flight. Neither ``stop`` nor ``close`` opens the fingers or lets go of
    what they hold. All calls, ``read`` too, come from one thread and return within a few ms.
    """

    simulated: ClassVar[bool] = False

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        self.spec = spec
        self.world = world

    @abstractmethod
    def open(self) -> None:
        """Connect. Nothing moves."""

    @abstractmethod
    def read(self, now: float) -> GripperReading:
        """The newest state."""

    @abstractmethod
    def move(self, width: float, speed: float, force: float) -> None:
        """Start towards ``width`` (m) at ``speed`` (m/s), pressing with at most ``force`` (N)."""

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        """Start to close on something of ``width`` (m) at ``speed`` (m/s) and hold it with ``force`` (N).

        It is held when the fingers end between ``width - inner`` and ``width + outer`` (m). A driver without a grasp of
        its own closes as far as that, and so presses on what is there.
        """
        self.move(max(0.0, width - inner), speed, force)

    def home(self) -> None:  # noqa: B027  # most have nothing to do
        """Start to find out how far the fingers open. Only some grippers need it, once after they are switched on."""

    @abstractmethod
    def stop(self) -> None:
        """Stay where the fingers are, keep the grip force."""

    def inject(self, **knobs: object) -> None:
        """Switch faults on or off, for tests. Only drivers that simulate have any."""
        raise NotSupported(f"driver {type(self).__name__} has no faults to inject")

    @abstractmethod
    def close(self) -> None:
        """Let go of the device, not of the object. Idempotent."""


class PadReading(NamedTuple):
    """What a gamepad driver reports. Canonical names (``hal.types.AXES``, ``BUTTONS``), no dead zone applied yet."""

    t: float
    """Time of the newest event, on the host's clock, s."""
    t_alive: float
    """When the driver last had proof that the pad is there and speaking, s. The dead-man's watchdog looks at this."""
    t_device: float
    seq: int
    """Counts events."""
    axes: Mapping[str, float]
    """Sticks -1..1, right and up positive; triggers 0..1. A trigger that is only a button is 0 or 1, or left out."""
    buttons: frozenset[str]
    connected: bool
    unknown: Collection[str] = ()
    """Axes that the pad has not spoken of yet; they show 0, and nothing counts until they were moved."""


class Plugged(NamedTuple):
    """What a driver could open."""

    pads: tuple[str, ...]
    """Pads that are there, in words."""
    notes: tuple[str, ...] = ()
    """What stands in the way of others, each with the command that mends it."""
    devices: tuple[str, ...] = ()
    """What ``options.device`` of a rig calls each of :attr:`pads`, where the driver has such an option."""


class GamepadDriver(ABC):
    """One pad. ``poll`` is called for as long as the rig is open, from one thread; a pad that is not plugged in is
    not an error but a reading with ``connected=False``, and comes back by itself when it is plugged in again.
    """

    simulated: ClassVar[bool] = False
    proves_liveness: bool = False
    """True where silence means that the pad is gone (unplugging is seen, or the pad streams), so that its buttons
    may serve as a dead-man on a real arm. It may change when another pad is plugged in."""

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        self.spec = spec
        self.source = source
        """Where a pad that lives in another process gets its record from; for ``playback``, the world's time."""
        self.notes: tuple[str, ...] = ()
        """What a person should know about the pad, each with what mends it."""
        self.flat: Mapping[str, float] = MappingProxyType({})
        """Axis -> share of its travel that the pad itself calls neutral."""

    @classmethod
    def plugged(cls) -> Plugged:
        """What could be opened at the moment. Quick, opens nothing, and never raises for what is not there."""
        return Plugged(())

    @abstractmethod
    def open(self) -> None:
        """Look for the pad."""

    @abstractmethod
    def poll(self, now: float, timeout: float) -> PadReading:
        """The present reading; waits up to ``timeout`` s for news. ``now`` is the time on ``rig.clock``."""

    def describe(self) -> str:
        """What drives, in words, for the banner."""
        return type(self).__name__

    def details(self) -> Mapping[str, str]:
        """What is known of the pad that is plugged in, for a person who has trouble with it: what -> in words."""
        return {}

    @property
    def mapping(self) -> str | None:
        """Teleoperation mapping that is meant for the pad that is plugged in; None where any will do."""
        return None

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        """Let the pad's motors shake the hand: shares of what they can (0..1), and how long, s. True where they will.

        Returns at once, from whatever thread it is called.
        """
        return False

    @property
    def can_hold(self) -> bool:
        """Can a control be held down? Where not (a terminal's keys), each press is one small step."""
        return True

    @property
    def finished(self) -> bool:
        """Has it nothing more to say? Only a recording ends."""
        return False

    @abstractmethod
    def close(self) -> None:
        """Let go of the device. Idempotent."""
